"""CUDA kernel of the filter's polish: Gauss-Newton steps of point-to-plane ICP, one block per particle.

The surface is drawn by the cost's own functions into shared memory, in bands that overlap by a row on either side.
What a pixel contributes and how the equations are solved are the CPU's own functions, in double precision as there:
few particles are polished, and steps that agree keep both devices at the same poses.
"""

# ruff: noqa: PLR0917
# Kernels take plain arrays by position.
# pyright: basic

from __future__ import annotations

import math

import numba
import numpy as np

from stages.perception.cuda.cost_kernel import NOTHING, block_sum, draw, rectangle
from stages.perception.cuda.scalars import cuda, on_device, screen_matrix
from stages.perception.rendering import kernels
from stages.perception.rendering.pixel_math import NEAR

_i = np.int32
_NEAR = np.float32(NEAR)
_LEAST_GATE = 0.005
"""Metres, as on the CPU."""
_LEAST_PIXELS = 12
_SUMS = 28
"""Six right-hand sides, the 21 values of the symmetric matrix and the number of pixels."""

# numba-cuda has no lowering of numpy.sqrt and its like for scalars.
_takes_part = on_device(kernels.takes_part)
_point_to_plane = on_device(kernels.point_to_plane, np=math)
_solve = on_device(kernels.solve, np=math)
_move = on_device(kernels.move, np=math)


@cuda.jit
def refine(lanes, meshes, corners, middles, views, firsts, pixels, directions, poses, objects, windows, counts, steps,
           gate):  # fmt: skip
    """Moves in place the first ``counts[h]`` particles of each population h as ``gauss_newton`` does on the CPU.

    The grid is particles times populations; a population's particles lie together.
    """
    h = cuda.blockIdx.y
    p = h * (poses.shape[0] // cuda.gridDim.y) + cuda.blockIdx.x
    if cuda.blockIdx.x >= counts[h] or objects[p] == NOTHING:
        return
    pose = cuda.local.array((3, 4), numba.float64)
    for row in range(3):
        for column in range(4):
            pose[row, column] = poses[p, row, column]
    who, where = objects[p], windows[p]
    reach = gate
    for _ in range(steps):
        moved = _step(lanes, meshes[who], corners[who], middles[who], views[where], firsts[where], pixels,
                      directions[h], pose, reach)  # fmt: skip
        if not moved:
            break
        reach = max(0.8 * reach, _LEAST_GATE)
    if cuda.threadIdx.x == 0:
        for row in range(3):
            for column in range(4):
                poses[p, row, column] = pose[row, column]


@cuda.jit(device=True)
def _step(lanes, mesh, corners, middle, view, first_pixel, pixels, directions, pose, gate):
    """One step of one pose, the same in every thread; whether there was anything to go by."""
    rounded = cuda.local.array((3, 4), numba.float32)
    for row in range(3):
        for column in range(4):
            rounded[row, column] = pose[row, column]
    m = screen_matrix(rounded, view)
    x0, y0, x1, y1, nearest = rectangle(corners, m, view)
    if nearest < _NEAR or x1 < x0 or y1 < y0:
        return False
    centre = cuda.local.array(3, numba.float64)
    for row in range(3):
        centre[row] = pose[row, 3]
        for column in range(3):
            centre[row] += pose[row, column] * middle[column]
    sums = cuda.local.array(_SUMS, numba.float64)
    _equations(lanes, mesh, m, (x0, y0, x1, y1), view, first_pixel, pixels, centre, gate, directions, sums)
    for k in range(_SUMS):
        sums[k] = block_sum(np.float32(sums[k]))
    if sums[_SUMS - 1] < _LEAST_PIXELS:
        return False
    twist = cuda.local.array(6, numba.float64)
    _solved(sums, directions, twist)
    _move(pose, centre, twist)
    return True


@cuda.jit(device=True)
def _equations(lanes, mesh, m, box, view, first_pixel, pixels, centre, gate, directions, sums):
    """This thread's share of the normal equations, over the pixels that have neighbours on all sides."""
    for k in range(_SUMS):
        sums[k] = 0.0
    z_buffer = cuda.shared.array(0, numba.int32)
    reserved = cuda.blockDim.x
    columns, rows = _i(box[2] - box[0]) + 1, _i(box[3] - box[1]) + 1
    room = min((z_buffer.size - reserved) // columns, rows)
    for top in range(1, rows - 1, max(room - 2, 1)):
        bottom = min(top + room - 2, rows - 1)
        for i in range(cuda.threadIdx.x, (bottom - top + 2) * columns, cuda.blockDim.x):
            z_buffer[reserved + i] = 0
        cuda.syncthreads()
        draw(lanes, mesh, m, box, top - 1, bottom + 1, columns)
        cuda.syncthreads()
        _gather(box, top, bottom, columns, view, first_pixel, pixels, centre, gate, directions, sums)
        cuda.syncthreads()


@cuda.jit(device=True)
def _gather(box, top, bottom, columns, view, first_pixel, pixels, centre, gate, directions, sums):
    """Adds this thread's pixels of a band."""
    z_values = cuda.shared.array(0, numba.float32)
    inner, width = columns - 2, _i(view[4])
    row = cuda.local.array(6, numba.float64)
    for i in range(cuda.threadIdx.x, (bottom - top) * inner, cuda.blockDim.x):
        down, right = i // inner, i % inner + 1
        z = cuda.blockDim.x + (down + 1) * columns + right
        u, v = _i(box[0]) + right, _i(box[1]) + top + down
        k = first_pixel + v * width + u
        q, before, after = z_values[z], z_values[z - 1], z_values[z + 1]
        above, below = z_values[z - columns], z_values[z + columns]
        if _takes_part(q, before, after, above, below, pixels[0, k], pixels[1, k], pixels[2, k], gate):
            equation = _point_to_plane(q, before, after, above, below, u, v, pixels[1, k], view, centre)
            _add(equation, directions, row, sums)


@cuda.jit(device=True)
def _add(equation, directions, row, sums):
    """Adds a pixel's equation to the sums."""
    jx, jy, jz, nx, ny, nz, residual, weight = equation
    for j in range(directions.shape[1]):
        row[j] = (directions[0, j] * jx + directions[1, j] * jy + directions[2, j] * jz
                  + directions[3, j] * nx + directions[4, j] * ny + directions[5, j] * nz)  # fmt: skip
    for j in range(directions.shape[1]):
        sums[j] += weight * row[j] * residual
        for n in range(j + 1):
            sums[6 + j * (j + 1) // 2 + n] += weight * row[j] * row[n]
    sums[_SUMS - 1] += 1.0


@cuda.jit(device=True)
def _solved(sums, directions, twist):
    """The twist that solves the summed equations."""
    degrees = directions.shape[1]
    A = cuda.local.array((6, 6), numba.float64)
    b = cuda.local.array(6, numba.float64)
    for j in range(degrees):
        b[j] = sums[j]
        for n in range(j + 1):
            A[j, n] = sums[6 + j * (j + 1) // 2 + n]
    _solve(A, b[:degrees])
    for row in range(6):
        twist[row] = 0.0
        for j in range(degrees):
            twist[row] += directions[row, j] * b[j]
