"""Numba kernels over the pixels of one object's window: the cost of poses and their Gauss-Newton refinement."""

# ruff: noqa: PLR0917, PLW3301
# Kernels take plain arrays by position, and only nested minima of two values compile to vector instructions.
# pyright: basic

from __future__ import annotations

import numba
import numpy as np

from stages.perception.rendering.pixel_math import INLINED, KERNEL, height_row, pixel_cost, screen_matrix
from stages.perception.rendering.rasteriser import (
    LANES,
    SIDE,
    rasterise,
    screen_window,
    tiled,
    tiles_of,
    untile,
    working_memory,
)

IMPOSSIBLE = 1e6
"""Cost of a pose that reaches into the camera, in metres times pixels."""
_f = np.float32
_u = np.uintp


@numba.njit(**KERNEL)
def evidence(background, observed, factor, credit, view):
    """The four images (H x W, flat) that poses are weighed against, in tiles, 4 x N; overhang is no reading."""
    images = np.zeros((4, tiles_of(view) * LANES), np.float32)
    tiled(background, view, images[0])
    tiled(observed, view, images[1])
    tiled(factor, view, images[2])
    tiled(credit, view, images[3])
    return images


@numba.njit(**KERNEL)
def change_of_cost(lanes, blocks, corners, support, poses, view, images, plane, limits, out):
    """Writes for each pose what its visible pixels cost less what the background costs there, plus sinking.

    ``images`` is what ``evidence`` made of the view's images.
    """
    Z, scratch, survivors = working_memory(blocks, view)
    pitch = (int(view[4]) + SIDE - 1) // SIDE
    area = view[4] * view[5]
    for p in range(poses.shape[0]):
        m = screen_matrix(poses[p], view)
        window, inside, too_near = screen_window(corners, m, view)
        sunk = _depth_below(support, poses[p], plane) - limits[3]
        out[p] = _f(IMPOSSIBLE) if too_near else max(_f(0), sunk) * area
        if inside:
            rasterise(lanes, blocks, m, window, scratch, survivors, Z)
            out[p] += _scan(Z, window, pitch, images[0], images[1], images[2], images[3], limits)


@numba.njit(**INLINED)
def _scan(Z, window, pitch, background, observed, factor, credit, limits):
    """Sums the change of cost over the object's visible pixels and leaves the z-buffer zeroed."""
    left, top, across, down = window[0], window[1], window[2], window[3]
    truncation, margin, occluder = limits[0], limits[1], limits[2]
    total = _f(0)
    for row in range(_u(down)):
        z = row * _u(across * LANES)
        o = ((_u(top) + row) * _u(pitch) + _u(left)) * _u(LANES)
        for x in range(_u(across * LANES)):
            i = o + x
            total += pixel_cost(
                Z[z + x], background[i], observed[i], factor[i], credit[i], truncation, margin, occluder
            )
            Z[z + x] = _f(0)
    return total


@numba.njit(**INLINED)
def _depth_below(support, pose, plane):
    """How far the lowest point lies below the plane, metres (negative above)."""
    a, b, c, d = height_row(pose, plane)
    lowest = _f(1e9)
    for i in range(support.shape[0]):
        lowest = min(lowest, a * support[i, 0] + b * support[i, 1] + c * support[i, 2] + d)
    return -lowest


@numba.njit(**KERNEL)
def gauss_newton(lanes, blocks, corners, centre, poses, steps, gate, view, background, observed, factor, directions):
    """Moves each pose, in place, by steps of projective point-to-plane ICP."""
    tiles, scratch, survivors = working_memory(blocks, view)
    image = np.zeros(tiles.shape[0], np.float32)
    degrees = directions.shape[1]
    A = np.zeros((degrees, degrees))
    b = np.zeros(degrees)
    row = np.zeros(degrees)
    middle = np.zeros(3)
    twist = np.zeros(6)
    for p in range(poses.shape[0]):
        reach = gate
        for _ in range(steps):
            m = screen_matrix(poses[p].astype(np.float32), view)
            window, inside, _ = screen_window(corners, m, view)
            if not inside:
                break
            rasterise(lanes, blocks, m, window, scratch, survivors, tiles)
            left, top = SIDE * window[0], SIDE * window[1]
            columns, rows = min(SIDE * window[2], int(view[4]) - left), min(SIDE * window[3], int(view[5]) - top)
            untile(tiles, window, image[: columns * rows].reshape(rows, columns))
            for i in range(3):
                middle[i] = poses[p, i, 3]
                for j in range(3):
                    middle[i] += poses[p, i, j] * centre[j]
            used = _normal_equations(image, left, top, columns, rows, view, background,
                                     observed, factor, middle, reach, directions, A, b, row)  # fmt: skip
            if used < 12:
                break
            solve(A, b)
            for i in range(6):
                twist[i] = 0.0
                for j in range(degrees):
                    twist[i] += directions[i, j] * b[j]
            move(poses[p], middle, twist)
            reach = max(0.8 * reach, 0.005)


@numba.njit(**INLINED)
def _normal_equations(Z, x0, y0, columns, rows, view, background, observed, factor, middle, gate, directions, A, b,
                      row):  # fmt: skip
    """Accumulates A x = b over visible pixels near their reading; returns how many took part.

    Inverse depth is linear on a plane, so its image gradient is the rendered surface's normal.
    """
    A[:] = 0.0
    b[:] = 0.0
    used = 0
    for v in range(1, rows - 1):
        for u in range(1, columns - 1):
            i = v * columns + u
            q, left, right, up, down = Z[i], Z[i - 1], Z[i + 1], Z[i - columns], Z[i + columns]
            k = (y0 + v) * int(view[4]) + x0 + u
            if not takes_part(q, left, right, up, down, background[k], observed[k], factor[k], gate):
                continue
            jx, jy, jz, nx, ny, nz, residual, weight = point_to_plane(
                q, left, right, up, down, x0 + u, y0 + v, observed[k], view, middle
            )
            for j in range(row.shape[0]):
                row[j] = (directions[0, j] * jx + directions[1, j] * jy + directions[2, j] * jz
                          + directions[3, j] * nx + directions[4, j] * ny + directions[5, j] * nz)  # fmt: skip
            for j in range(row.shape[0]):
                b[j] += weight * row[j] * residual
                for n in range(j + 1):
                    A[j, n] += weight * row[j] * row[n]
            used += 1
    return used


@numba.njit(**INLINED)
def takes_part(q, left, right, up, down, background, observed, factor, gate):
    """Whether a pixel shows a smooth piece of the surface near its reading; q and its neighbours are inverse depths."""
    if q <= background or factor == 0 or min(min(left, right), min(up, down)) <= 0:
        return False
    bend = max(abs(left + right - 2 * q), abs(up + down - 2 * q))
    return not (bend > 0.01 * q or abs(observed - 1.0 / q) > gate)


@numba.njit(**INLINED)
def point_to_plane(q, left, right, up, down, u, v, observed, view, middle):
    """Derivative of a pixel's distance from the rendered plane by a twist about ``middle`` (6 values), the distance and
    its robust weight."""
    offset = observed - 1.0 / q
    x, y = (u - view[2]) / view[0], (v - view[3]) / view[1]
    nx, ny = 0.5 * (right - left) * view[0], 0.5 * (down - up) * view[1]
    nz = q - x * nx - y * ny
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / length, ny / length, nz / length
    residual = (nx * x + ny * y + nz) * offset
    px, py, pz = x / q - middle[0], y / q - middle[1], 1.0 / q - middle[2]
    jx, jy, jz = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
    return jx, jy, jz, nx, ny, nz, residual, 1.0 / (1.0 + (residual / 0.004) ** 2)


@numba.njit(**INLINED)
def solve(A, b):
    """Solves A x = b in place by a damped Cholesky factorisation; A holds the lower triangle."""
    n = b.shape[0]
    for j in range(n):
        A[j, j] = A[j, j] * 1.001 + 1e-6
    for j in range(n):
        for k in range(j):
            A[j, j] -= A[j, k] * A[j, k]
        A[j, j] = np.sqrt(max(A[j, j], 1e-12))
        for i in range(j + 1, n):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] /= A[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for r in range(n):
        i = n - 1 - r
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]


@numba.njit(**INLINED)
def move(pose, middle, twist):
    """Turns a pose by twist[:3] about ``middle`` and shifts it by twist[3:], in place."""
    angle = np.sqrt(twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2) + 1e-12
    x, y, z = twist[0] / angle, twist[1] / angle, twist[2] / angle
    s, c = np.sin(angle), np.cos(angle)
    d = 1.0 - c
    for j in range(4):
        shift = 1.0 if j == 3 else 0.0
        a0, a1, a2 = (pose[0, j] - shift * middle[0], pose[1, j] - shift * middle[1], pose[2, j] - shift * middle[2])
        pose[0, j] = (c + x * x * d) * a0 + (x * y * d - z * s) * a1 + (x * z * d + y * s) * a2
        pose[1, j] = (x * y * d + z * s) * a0 + (c + y * y * d) * a1 + (y * z * d - x * s) * a2
        pose[2, j] = (x * z * d - y * s) * a0 + (y * z * d + x * s) * a1 + (c + z * z * d) * a2
        for i in range(3):
            pose[i, j] += shift * (middle[i] + twist[3 + i])
