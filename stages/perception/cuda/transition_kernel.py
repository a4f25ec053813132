"""CUDA kernel of the filter's other half: weights, resampling and transition, one block per population.

With ``evaluate`` before it and ``refine`` after it, it is a whole iteration: what one launch writes the next reads,
and the schedule's step, the number of particles and whether a population has settled are kept on the device, so the
host queues iterations without waiting for any of them. Sums run in one fixed order and random numbers come from
counters and each population's own seed: equal seeds give equal bytes on the same kind of device, alone or in company.
"""

# ruff: noqa: PLR0917
# Kernels take plain arrays by position.
# pyright: basic

from __future__ import annotations

import math

import numba
import numpy as np

from stages.perception.cuda.cost_kernel import NOTHING, block_greatest, block_sum
from stages.perception.cuda.random_numbers import normals, uniforms
from stages.perception.cuda.scalars import cuda
from stages.perception.filter.iterations import PROGRESS, THINNED
from stages.perception.filter.likelihood import _SLACK, _STRAY

_f = np.float32
_i = np.int32
_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_NEAR = np.float32(0.05)
_PI = np.float32(np.pi)
_TINY = np.float32(1e-12)
_SLACK32, _STRAY32 = np.float32(_SLACK), np.float32(_STRAY)
_PROGRESS = np.float32(PROGRESS)
_BISECTIONS = 24

MESH, WINDOW, FIRST_FLIP, FLIPS = range(4)
"""Columns of the table of populations."""
VIEW, BOX, REACH, BASE, PRIOR = 0, 6, 10, 12, 13
"""Columns of the table of windows: view (6), box (4), depths (2), cost without the object, whether a box is a prior."""
METRES, RADIANS = range(2)
"""Columns of the schedule's spreads, one row per iteration."""
COUNT, STRIDE, FLIPPED, RENEWED, FIRST_FRESH, POLISHED = range(6)
"""Columns of the schedule's numbers, one row per iteration: particles of the next generation, how far apart in the
order of resampling its neighbours are (coprime to COUNT), and how many are flipped, renewed (from which place of the
pool on) and polished."""
EFFECTIVE, SCALE, ELITISM, PATIENCE, SPINS = range(5)
"""Places of the settings; a scale of 0 is chosen in each iteration."""
SIZE, STEP, STALE, DONE = range(4)
"""Columns of the populations' state: particles, iterations done, those without progress, whether it has settled."""
_OFFSET, _KIND, _TURNS, _SHIFTS = range(4)
"""Purposes of random numbers."""


@cuda.jit
def evolve(changes, poses, following, objects, populations, middles, axes, windows, flips, directions, pools, spreads,
           numbers, settings, seeds, state, polished, history, traces):  # fmt: skip
    """Writes the next generation of each population, and keeps of this one the least cost and some positions.

    A population that has settled stays as it is, and its places are marked so that nothing more is weighed.
    """
    h = cuda.blockIdx.x
    capacity = poses.shape[0] // populations.shape[0]
    first, size, step, who = h * capacity, state[h, SIZE], state[h, STEP], populations[h]
    if state[h, DONE] > 0:
        _rest(poses, following, objects, first, size, polished, h)
        return
    middle, window, plan = middles[who[MESH]], windows[who[WINDOW]], numbers[step]
    count = plan[COUNT]
    least = _energies(changes, poses, first, size, middle, window)
    champion = _champion(least, size)
    total = _accumulate(least, _scale(least, size, settings[EFFECTIVE] * _f(count), settings[SCALE]), size)
    offset, turn, _, _ = uniforms(0, step, 0, _OFFSET, seeds[h])
    for i in range(cuda.threadIdx.x, size, cuda.blockDim.x):
        if i % THINNED == 0:
            for row in range(3):
                traces[h, step, i // THINNED, row] = poses[first + i, row, 3]
    for i in range(cuda.threadIdx.x, capacity, cuda.blockDim.x):
        objects[first + i] = who[MESH] if i < count else NOTHING
        if i >= count:
            continue
        # Neighbours in the order of resampling are copies of each other: to flip the first few places would flip few.
        place = (i * plan[STRIDE] + _i(turn * _f(count))) % count
        source = poses[first + _drawn((offset + _f(place)) / _f(count) * total, size)]
        target = following[first + i]
        if settings[ELITISM] > _ZERO and i == count - 1:
            _copy(poses[first + champion], target)
        elif i >= count - plan[RENEWED]:
            _copy(pools[h, plan[FIRST_FRESH] + i - (count - plan[RENEWED])], target)
        else:
            _diffuse(source, target, middle, directions[h], spreads[step], i, step, seeds[h])
            if i < plan[FLIPPED]:
                _flip_or_spin(target, middle, axes[h], flips, who, settings, i, step, seeds[h])
    cuda.syncthreads()
    if cuda.threadIdx.x == 0:
        _record(h, window[BASE], least, plan, settings, state, polished, history)


@cuda.jit(device=True)
def _rest(poses, following, objects, first, size, polished, h):
    """Takes a population that has settled over as it is."""
    for i in range(cuda.threadIdx.x, size, cuda.blockDim.x):
        _copy(poses[first + i], following[first + i])
        objects[first + i] = NOTHING
    if cuda.threadIdx.x == 0:
        polished[h] = 0


@cuda.jit(device=True)
def _record(h, base, least, plan, settings, state, polished, history):
    """Ends a population's iteration: the least cost, whether that was progress, and whether more is to come of it."""
    step, cost, best = state[h, STEP], base + least, _f(np.inf)
    for i in range(step):
        best = min(best, history[h, i])
    stale = 0 if cost < _PROGRESS * best else state[h, STALE] + 1
    history[h, step] = cost
    polished[h] = plan[POLISHED]
    state[h, SIZE], state[h, STEP], state[h, STALE] = plan[COUNT], step + 1, stale
    state[h, DONE] = 1 if min(best, cost) < base and _f(stale) >= settings[PATIENCE] else 0


@cuda.jit(device=True)
def _energies(changes, poses, first, count, middle, window):
    """Keeps each particle's energy in shared memory, after the words for sums; returns the least."""
    energies = cuda.shared.array(0, numba.float32)
    least = _f(np.inf)
    for i in range(cuda.threadIdx.x, count, cuda.blockDim.x):
        energy = changes[first + i]
        if window[PRIOR] > _ZERO:
            unseen = _ONE if energy == _ZERO else _ZERO
            energy += window[BASE] * (_STRAY32 * _stray(poses[first + i], middle, window) + unseen)
        energies[cuda.blockDim.x + i] = energy
        least = min(least, energy)
    return -block_greatest(-least)


@cuda.jit(device=True)
def _stray(pose, middle, window):
    """``ObjectLikelihood``'s prior: how far the centre is from where box and readings allow it, in diameters."""
    x, y, z = _rotated(pose, middle[0], middle[1], middle[2])
    x, y, z = x + pose[0, 3], y + pose[1, 3], max(z + pose[2, 3], _NEAR)
    apparent = middle[3] * window[VIEW] / z
    beside = _outside(x / z * window[VIEW] + window[VIEW + 2], window[BOX], window[BOX + 2], apparent)
    below = _outside(y / z * window[VIEW + 1] + window[VIEW + 3], window[BOX + 1], window[BOX + 3], apparent)
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
def _scale(least, count, effective, given):
    """lambda_r of equation 8: as given, or by bisection for the wished effective sample size."""
    if given > _ZERO:
        return given
    low, high = _f(-12), _f(12)
    for _ in range(_BISECTIONS):
        middle = (low + high) * _HALF
        total, squares = _weight_sums(least, _f(math.exp(middle)), count)
        if total * total > effective * squares:
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
def _flip_or_spin(pose, middle, axes, flips, who, settings, particle, step, seed):
    """One flip, in place; every second particle is turned by any angle about one of the object's axes instead, where
    objects are free to."""
    which, angle, _, _ = uniforms(particle, step, 0, _KIND, seed)
    if settings[SPINS] > _ZERO and particle % 2 == 1:
        _spin(pose, middle, axes, _i(which * _f(3)), (angle * _f(2) - _ONE) * _PI)
    else:
        _flip(pose, middle, flips[who[FIRST_FLIP] + _i(which * _f(who[FLIPS]))])


@cuda.jit(device=True)
def _flip(pose, middle, flip):
    """Turns an object about its centre by a rotation in its own frame, in place."""
    before = _rotated(pose, middle[0], middle[1], middle[2])
    for row in range(3):
        a, b, c = pose[row, 0], pose[row, 1], pose[row, 2]
        for column in range(3):
            pose[row, column] = a * flip[0, column] + b * flip[1, column] + c * flip[2, column]
    _centre(pose, pose, before, middle, _ZERO, _ZERO, _ZERO)


@cuda.jit(device=True)
def _spin(pose, middle, axes, axis, angle):
    """Turns an object about its centre and one of its axes, in place."""
    before = _rotated(pose, middle[0], middle[1], middle[2])
    x, y, z = _rotated(pose, axes[0, axis], axes[1, axis], axes[2, axis])
    _turn(pose, pose, angle * x, angle * y, angle * z)
    _centre(pose, pose, before, middle, _ZERO, _ZERO, _ZERO)


@cuda.jit(device=True)
def _diffuse(source, target, middle, directions, spread, particle, step, seed):
    """Gaussian noise in every direction of freedom: the transition of Iterated Likelihood Weighting."""
    noise = cuda.local.array(8, numba.float32)
    noise[0], noise[1], noise[2], noise[3] = normals(particle, step, 0, _TURNS, seed)
    noise[4], noise[5], noise[6], noise[7] = normals(particle, step, 0, _SHIFTS, seed)
    twist = cuda.local.array(6, numba.float32)
    for row in range(6):
        twist[row] = _ZERO
    for k in range(directions.shape[1]):
        turning = abs(directions[0, k]) + abs(directions[1, k]) + abs(directions[2, k]) > _ZERO
        size = noise[k] * (spread[RADIANS] if turning else spread[METRES])
        for row in range(6):
            twist[row] += directions[row, k] * size
    before = _rotated(source, middle[0], middle[1], middle[2])
    _turn(source, target, twist[0], twist[1], twist[2])
    _centre(source, target, before, middle, twist[3], twist[4], twist[5])


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
def _centre(source, target, before, middle, x, y, z):
    """Puts the centre of a turned object where it was, ``before`` from its origin, and shifts it."""
    after = _rotated(target, middle[0], middle[1], middle[2])
    target[0, 3] = source[0, 3] + before[0] - after[0] + x
    target[1, 3] = source[1, 3] + before[1] - after[1] + y
    target[2, 3] = source[2, 3] + before[2] - after[2] + z


@cuda.jit(device=True)
def _rotated(pose, x, y, z):
    return (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z,
            pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z,
            pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z)  # fmt: skip
