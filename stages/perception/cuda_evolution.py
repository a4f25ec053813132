"""CUDA kernel of the filter's other half: weights, resampling and transition, one block per population.

Together with ``evaluate`` it is a whole iteration: what one launch writes the next reads, and the schedule's step is
kept on the device, so the host queues iterations without waiting for any of them. Sums run in one fixed order and
random numbers come from counters: equal seeds give equal bytes on the same kind of device.
"""

# ruff: noqa: PLR0917
# Kernels take plain arrays by position.
# pyright: basic

from __future__ import annotations

import math

import numba
import numpy as np

from stages.perception.cuda_kernels import block_greatest, block_sum
from stages.perception.cuda_math import cuda
from stages.perception.cuda_random import normals, uniforms
from stages.perception.likelihood import _SLACK, _STRAY

_f = np.float32
_i = np.int32
_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_NEAR = np.float32(0.05)
_PI = np.float32(np.pi)
_TINY = np.float32(1e-12)
_SLACK32, _STRAY32 = np.float32(_SLACK), np.float32(_STRAY)
_BISECTIONS = 24

MESH, WINDOW, FIRST_FLIP, FLIPS = range(4)
"""Columns of the table of populations."""
BOX, REACH, BASE, PRIOR = 0, 4, 6, 7
"""Columns of the table of windows: box (4), depths (2), cost without the object, whether the box is a prior."""
METRES, RADIANS, RENEWED = range(3)
"""Columns of the schedule, one row per iteration."""
EFFECTIVE, SCALE, FLIPPED, ELITISM = range(4)
"""Places of the settings; a scale of 0 is chosen in each iteration."""
_OFFSET, _KIND, _TURNS, _SHIFTS = range(4)
"""Purposes of random numbers."""


@cuda.jit
def evolve(changes, poses, following, populations, middles, views, windows, flips, directions, pools, schedule,
           settings, seed, steps, history):  # fmt: skip
    """Writes the next generation of each population and the energy of its best particle."""
    h = cuda.blockIdx.x
    count = poses.shape[0] // populations.shape[0]
    first, step, who = h * count, steps[h], populations[h]
    stage = schedule[min(step, schedule.shape[0] - 1)]
    middle = middles[who[MESH]]
    least = _energies(changes, poses, first, count, middle, views[who[WINDOW]], windows[who[WINDOW]])
    champion = _champion(least, count)
    total = _accumulate(least, _scale(least, count, settings), count)
    offset, _, _, _ = uniforms(0, step, h, _OFFSET, seed)
    for i in range(cuda.threadIdx.x, count, cuda.blockDim.x):
        source = poses[first + _drawn((offset + _f(i)) / _f(count) * total, count)]
        target = following[first + i]
        kind, which, angle, _ = uniforms(i, step, h, _KIND, seed)
        if settings[ELITISM] > _ZERO and i == count - 1:
            _copy(poses[first + champion], target)
        elif kind < settings[FLIPPED] * _HALF:
            _flip(source, target, middle, flips[who[FIRST_FLIP] + _i(which * _f(who[FLIPS]))])
        elif kind < settings[FLIPPED]:
            _spin(source, target, middle, _i(which * _f(3)), (angle * _f(2) - _ONE) * _PI)
        elif kind < settings[FLIPPED] + stage[RENEWED]:
            _copy(pools[h, _i(which * _f(pools.shape[1]))], target)
        else:
            _diffuse(source, target, middle, directions[h], stage, i, step, h, seed)
    cuda.syncthreads()
    if cuda.threadIdx.x == 0:
        history[h, min(step, history.shape[1] - 1)] = least
        steps[h] = step + 1


@cuda.jit(device=True)
def _energies(changes, poses, first, count, middle, view, window):
    """Keeps each particle's energy in shared memory, after the words for sums; returns the least."""
    energies = cuda.shared.array(0, numba.float32)
    least = _f(np.inf)
    for i in range(cuda.threadIdx.x, count, cuda.blockDim.x):
        energy = changes[first + i]
        if window[PRIOR] > _ZERO:
            unseen = _ONE if energy == _ZERO else _ZERO
            energy += window[BASE] * (_STRAY32 * _stray(poses[first + i], middle, view, window) + unseen)
        energies[cuda.blockDim.x + i] = energy
        least = min(least, energy)
    return -block_greatest(-least)


@cuda.jit(device=True)
def _stray(pose, middle, view, window):
    """``ObjectLikelihood``'s prior: how far the centre is from where box and readings allow it, in diameters."""
    x, y, z = _rotated(pose, middle[0], middle[1], middle[2])
    x, y, z = x + pose[0, 3], y + pose[1, 3], max(z + pose[2, 3], _NEAR)
    apparent = middle[3] * view[0] / z
    beside = _outside(x / z * view[0] + view[2], window[0], window[2], apparent)
    below = _outside(y / z * view[1] + view[3], window[1], window[3], apparent)
    half = middle[3] * _HALF
    beyond = max(window[REACH] - half - z, z - window[REACH + 1] - half) / middle[3] - _SLACK32
    return _share(beside) + _share(below) + _share(beyond)


@cuda.jit(device=True)
def _outside(at, low, high, apparent):
    """How far a centre lies beyond the places from which an object of that size touches both sides of the box."""
    a, b = high - apparent * _HALF, low + apparent * _HALF
    return max(min(a, b) - at, at - max(a, b)) / apparent - _SLACK32


@cuda.jit(device=True)
def _share(value):
    return min(max(value, _ZERO), _ONE)


@cuda.jit(device=True)
def _champion(least, count):
    """The first particle of least energy."""
    energies = cuda.shared.array(0, numba.float32)
    found = count
    for i in range(cuda.threadIdx.x, count, cuda.blockDim.x):
        if energies[cuda.blockDim.x + i] == least:
            found = min(found, i)
    return _i(-block_greatest(_f(-found)))


@cuda.jit(device=True)
def _scale(least, count, settings):
    """lambda_r of equation 8: as given, or by bisection for the wished effective sample size."""
    if settings[SCALE] > _ZERO:
        return settings[SCALE]
    low, high = _f(-12), _f(12)
    for _ in range(_BISECTIONS):
        middle = (low + high) * _HALF
        total, squares = _weight_sums(least, _f(math.exp(middle)), count)
        if total * total > settings[EFFECTIVE] * _f(count) * squares:
            low = middle
        else:
            high = middle
    return _f(math.exp(low))


@cuda.jit(device=True)
def _weight_sums(least, scale, count):
    """Sums of the weights exp(-scale excess) and of their squares."""
    energies = cuda.shared.array(0, numba.float32)
    total, squares = _ZERO, _ZERO
    for i in range(cuda.threadIdx.x, count, cuda.blockDim.x):
        weight = _f(math.exp(-scale * (energies[cuda.blockDim.x + i] - least)))
        total += weight
        squares += weight * weight
    return block_sum(total), block_sum(squares)


@cuda.jit(device=True)
def _accumulate(least, scale, count):
    """Replaces energies by running sums of their weights and returns the whole; each thread has its own stretch."""
    sums = cuda.shared.array(0, numba.float32)
    threads = cuda.blockDim.x
    stretch = (count + threads - 1) // threads
    first = min(count, cuda.threadIdx.x * stretch)
    last = min(count, first + stretch)
    running = _ZERO
    for i in range(first, last):
        running += _f(math.exp(-scale * (sums[threads + i] - least)))
        sums[threads + i] = running
    sums[cuda.threadIdx.x] = running
    cuda.syncthreads()
    before = _ZERO
    for t in range(cuda.threadIdx.x):
        before += sums[t]
    for i in range(first, last):
        sums[threads + i] += before
    cuda.syncthreads()
    return sums[threads + count - 1]


@cuda.jit(device=True)
def _drawn(position, count):
    """The first particle whose running sum exceeds a position."""
    sums = cuda.shared.array(0, numba.float32)
    low, high = 0, count - 1
    while low < high:
        middle = (low + high) // 2
        if sums[cuda.blockDim.x + middle] > position:
            high = middle
        else:
            low = middle + 1
    return low


@cuda.jit(device=True)
def _copy(source, target):
    for row in range(3):
        for column in range(4):
            target[row, column] = source[row, column]


@cuda.jit(device=True)
def _flip(source, target, middle, flip):
    """Turns an object about its centre by a rotation in its own frame."""
    for row in range(3):
        for column in range(3):
            target[row, column] = (source[row, 0] * flip[0, column] + source[row, 1] * flip[1, column]
                                   + source[row, 2] * flip[2, column])  # fmt: skip
    _centre(source, target, middle, _ZERO, _ZERO, _ZERO)


@cuda.jit(device=True)
def _spin(source, target, middle, axis, angle):
    """Turns an object about its centre and one of its axes."""
    _turn(source, target, angle * source[0, axis], angle * source[1, axis], angle * source[2, axis])
    _centre(source, target, middle, _ZERO, _ZERO, _ZERO)


@cuda.jit(device=True)
def _diffuse(source, target, middle, directions, stage, particle, step, population, seed):
    """Gaussian noise in every direction of freedom: the transition of Iterated Likelihood Weighting."""
    noise = cuda.local.array(8, numba.float32)
    noise[0], noise[1], noise[2], noise[3] = normals(particle, step, population, _TURNS, seed)
    noise[4], noise[5], noise[6], noise[7] = normals(particle, step, population, _SHIFTS, seed)
    twist = cuda.local.array(6, numba.float32)
    for row in range(6):
        twist[row] = _ZERO
    for k in range(directions.shape[1]):
        turning = abs(directions[0, k]) + abs(directions[1, k]) + abs(directions[2, k]) > _ZERO
        size = noise[k] * (stage[RADIANS] if turning else stage[METRES])
        for row in range(6):
            twist[row] += directions[row, k] * size
    _turn(source, target, twist[0], twist[1], twist[2])
    _centre(source, target, middle, twist[3], twist[4], twist[5])


@cuda.jit(device=True)
def _turn(source, target, x, y, z):
    """Rotates the rotation by a rotation vector in the camera frame (Rodrigues), column by column."""
    angle = _f(math.sqrt(x * x + y * y + z * z)) + _TINY
    x, y, z = x / angle, y / angle, z / angle
    sine, cosine = _f(math.sin(angle)), _f(math.cos(angle))
    for k in range(3):
        a, b, c = source[0, k], source[1, k], source[2, k]
        along = (x * a + y * b + z * c) * (_ONE - cosine)
        target[0, k] = a * cosine + (y * c - z * b) * sine + x * along
        target[1, k] = b * cosine + (z * a - x * c) * sine + y * along
        target[2, k] = c * cosine + (x * b - y * a) * sine + z * along


@cuda.jit(device=True)
def _centre(source, target, middle, x, y, z):
    """Puts the centre of a turned object where it was, and shifts it."""
    before = _rotated(source, middle[0], middle[1], middle[2])
    after = _rotated(target, middle[0], middle[1], middle[2])
    target[0, 3] = source[0, 3] + before[0] - after[0] + x
    target[1, 3] = source[1, 3] + before[1] - after[1] + y
    target[2, 3] = source[2, 3] + before[2] - after[2] + z


@cuda.jit(device=True)
def _rotated(pose, x, y, z):
    return (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z,
            pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z,
            pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z)  # fmt: skip
