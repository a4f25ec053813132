"""CUDA kernel of the particle filter's cost: one block per particle, its z-buffer in shared memory.

A particle's rectangle on the screen is drawn in horizontal bands, as many rows at a time as shared memory holds. Each
triangle belongs to a team of threads that share its rows. Positive floats order as integers, so an integer atomic
maximum on the bits of 1/z is the depth test. Every value of a pixel comes from the triangle's first pixel by one
product per axis, and pixels go to threads by their place in the rectangle, and sums run in one fixed order: neither
the bands, nor the teams, nor the order in which threads run change a byte.
"""

# ruff: noqa: PLR0917, PLW3301
# Kernels take plain arrays by position; the test of coverage reads as the CPU's.
# pyright: basic

from __future__ import annotations

import operator

import numba
import numpy as np

from stages.perception.cuda.scalars import (
    ceil,
    cuda,
    floor,
    height_row,
    pixel_cost,
    project,
    screen_matrix,
    triangle_setup,
)
from stages.perception.rendering.kernels import IMPOSSIBLE
from stages.perception.rendering.pixel_math import NEAR
from stages.perception.rendering.rasteriser import LANES

_f = np.float32
_i = np.int32
_ZERO = np.float32(0)
_ONE = np.float32(1)
_FAR = np.float32(1e9)
_NEAR = np.float32(NEAR)
_IMPOSSIBLE = np.float32(IMPOSSIBLE)
_BLOCK = 9 * LANES
"""Values per block of triangles."""

NOTHING = -1
FIRST_BLOCK, BLOCKS, FIRST_SUPPORT, SUPPORTS, TEAM = range(5)
"""Columns of the table of meshes."""


def _reduction(combine):
    """A device function that combines a value of every thread, by halves: the same order in every run."""

    @cuda.jit(device=True)
    def reduced(value):
        shared = cuda.shared.array(0, numba.float32)
        shared[cuda.threadIdx.x] = value
        half = cuda.blockDim.x // 2
        while half > 0:
            cuda.syncthreads()
            if cuda.threadIdx.x < half:
                shared[cuda.threadIdx.x] = combine(shared[cuda.threadIdx.x], shared[cuda.threadIdx.x + half])
            half //= 2
        cuda.syncthreads()
        result = shared[0]
        cuda.syncthreads()
        return result

    return reduced


block_sum = _reduction(operator.add)
block_greatest = _reduction(max)


@cuda.jit
def evaluate(lanes, meshes, corners, support, views, firsts, pixels, planes, limits, poses, objects, windows, out):
    """Writes for each particle what ``change_of_cost`` writes on the CPU: block p weighs pose p of mesh
    ``objects[p]`` in window ``windows[p]``. Places whose object is ``NOTHING`` are passed over."""
    p = cuda.blockIdx.x
    if objects[p] == NOTHING:
        return
    mesh, view = meshes[objects[p]], views[windows[p]]
    bound = limits[windows[p]]
    m = screen_matrix(poses[p], view)
    x0, y0, x1, y1, nearest = rectangle(corners[objects[p]], m, view)
    if nearest < _NEAR:
        if cuda.threadIdx.x == 0:
            out[p] = _IMPOSSIBLE
        return
    lowest = _lowest(support, mesh, poses[p], planes[windows[p]])
    total = _ZERO
    if x1 >= x0 and y1 >= y0:
        total = _visible(lanes, mesh, m, (x0, y0, x1, y1), view, firsts[windows[p]], pixels, bound)
    total = block_sum(total)
    if cuda.threadIdx.x == 0:
        out[p] = max(_ZERO, -lowest - bound[3]) * view[4] * view[5] + total


@cuda.jit(device=True)
def rectangle(corners, m, view):
    """First and last pixel x0, y0, x1, y1 that the enclosing box may touch, and the depth of its nearest corner."""
    u0 = v0 = nearest = _FAR
    u1 = v1 = -_FAR
    for i in range(8):
        u, v, q = project(corners[i, 0], corners[i, 1], corners[i, 2], m)
        u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
        nearest = min(nearest, _ONE / q)
    return (max(_ZERO, ceil(u0)), max(_ZERO, ceil(v0)),
            min(view[4] - _ONE, floor(u1)), min(view[5] - _ONE, floor(v1)), nearest)  # fmt: skip


@cuda.jit(device=True)
def _lowest(support, mesh, pose, plane):
    """Height of the lowest point above the plane, metres; the same in every thread."""
    a, b, c, d = height_row(pose, plane)
    lowest = _FAR
    first = mesh[FIRST_SUPPORT]
    for i in range(first + cuda.threadIdx.x, first + mesh[SUPPORTS], cuda.blockDim.x):
        lowest = min(lowest, a * support[i, 0] + b * support[i, 1] + c * support[i, 2] + d)
    return -block_greatest(-lowest)


@cuda.jit(device=True)
def _visible(lanes, mesh, m, box, view, first_pixel, pixels, bound):
    """This thread's share of the change of cost over the object's visible pixels."""
    z_buffer = cuda.shared.array(0, numba.int32)
    reserved = cuda.blockDim.x
    columns, rows = _i(box[2] - box[0]) + 1, _i(box[3] - box[1]) + 1
    band = (z_buffer.size - reserved) // columns
    total = _ZERO
    for top in range(0, rows, band):
        bottom = min(top + band, rows)
        for i in range(cuda.threadIdx.x, (bottom - top) * columns, cuda.blockDim.x):
            z_buffer[reserved + i] = 0
        cuda.syncthreads()
        draw(lanes, mesh, m, box, top, bottom, columns)
        cuda.syncthreads()
        total = _scan(total, box, top, bottom, columns, view, first_pixel, pixels, bound)
        cuda.syncthreads()
    return total


@cuda.jit(device=True)
def draw(lanes, mesh, m, box, top, bottom, columns):
    """Writes the greatest inverse depth of the triangles into rows [top, bottom) of the rectangle."""
    team = mesh[TEAM]
    for triangle in range(cuda.threadIdx.x // team, mesh[BLOCKS] * LANES, cuda.blockDim.x // team):
        s = (mesh[FIRST_BLOCK] + triangle // LANES) * _BLOCK + triangle % LANES
        shape = triangle_setup(
            lanes[s], lanes[s + LANES], lanes[s + 2 * LANES], lanes[s + 3 * LANES], lanes[s + 4 * LANES],
            lanes[s + 5 * LANES], lanes[s + 6 * LANES], lanes[s + 7 * LANES], lanes[s + 8 * LANES],
            m, box[0], box[2], box[1], box[3],
        )  # fmt: skip
        if shape[0] > _ZERO and shape[1] > _ZERO:
            _fill(shape, top, bottom, columns, cuda.threadIdx.x % team, team)


@cuda.jit(device=True)
def _fill(shape, top, bottom, columns, member, team):
    """Draws every ``team``-th row of one triangle from ``member`` on, as far as the band has it."""
    width, height, x, y, b0, d0, q0, b_x, b_y, d_x, d_y, q_x, q_y = shape
    first = _i(y)
    last = min(first + _i(height), bottom)
    z_buffer = cuda.shared.array(0, numba.int32)
    for row in range(max(first, top) + member, last, team):
        down = _f(row - first)
        start = cuda.blockDim.x + (row - top) * columns + _i(x)
        for column in range(_i(width)):
            right = _f(column)
            b, d = b0 + b_y * down + b_x * right, d0 + d_y * down + d_x * right
            if min(min(b, d), _ONE - b - d) >= _ZERO:
                bits = _f(q0 + q_y * down + q_x * right).view(np.int32)
                if bits > z_buffer[start + column]:
                    cuda.atomic.max(z_buffer, start + column, bits)


@cuda.jit(device=True)
def _scan(total, box, top, bottom, columns, view, first_pixel, pixels, bound):
    """Adds this thread's pixels of the band to its total: those whose index in the rectangle it divides."""
    z_values = cuda.shared.array(0, numba.float32)
    threads = cuda.blockDim.x
    begin, end = top * columns, bottom * columns
    first = begin + (cuda.threadIdx.x - begin) % threads
    row, column = first // columns, first % columns
    down, right = threads // columns, threads % columns
    width = _i(view[4])
    corner = first_pixel + _i(box[1]) * width + _i(box[0])
    for i in range(first, end, threads):
        k = corner + row * width + column
        total += pixel_cost(z_values[threads + i - begin], pixels[0, k], pixels[1, k], pixels[2, k], pixels[3, k],
                            bound[0], bound[1], bound[2])  # fmt: skip
        # A division per pixel would cost more than the rest.
        row, column = row + down, column + right
        if column >= columns:
            row, column = row + 1, column - columns
    return total
