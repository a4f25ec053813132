"""Random numbers that a GPU thread computes from who it is: Philox 4x32-10 (Salmon et al., 2011), no state to keep."""

# ruff: noqa: PLR0917
# Kernels pass scalars by position.
# pyright: basic

from __future__ import annotations

import math

import numpy as np

from stages.perception.cuda.scalars import cuda

_f = np.float32
# Products of 32-bit words need 64 bits; mixing in a signed integer would turn everything into floats.
_u = np.uint64
_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_WORD = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_EIGHT = np.uint64(8)
_UNIT = np.float32(2.0**-24)
_BELOW_ONE = np.float32(1.0 - 2.0**-24)
_TURN = np.float32(2.0 * np.pi)


@cuda.jit(device=True)
def philox(a, b, c, d, key0, key1):
    """Four random words from a counter of four words and a key of two; all uint64 below 2^32."""
    for _ in range(10):
        p, q = _M0 * a, _M1 * c
        a, b, c, d = (q >> _HALF) ^ b ^ key0, q & _WORD, (p >> _HALF) ^ d ^ key1, p & _WORD
        key0, key1 = (key0 + _W0) & _WORD, (key1 + _W1) & _WORD
    return a, b, c, d


@cuda.jit(device=True)
def uniforms(particle, step, population, purpose, seed):
    """Four numbers uniform in (0, 1), float32."""
    key = _u(seed)
    a, b, c, d = philox(_u(particle), _u(step), _u(population), _u(purpose), key & _WORD, key >> _HALF)
    return _uniform(a), _uniform(b), _uniform(c), _uniform(d)


@cuda.jit(device=True)
def _uniform(word):
    return min((_f(word >> _EIGHT) + _f(0.5)) * _UNIT, _BELOW_ONE)


@cuda.jit(device=True)
def normals(particle, step, population, purpose, seed):
    """Four independent standard normal numbers (Box and Muller), float32."""
    a, b, c, d = uniforms(particle, step, population, purpose, seed)
    r, s = _f(math.sqrt(_f(-2) * _f(math.log(a)))), _f(math.sqrt(_f(-2) * _f(math.log(c))))
    x, y = _TURN * b, _TURN * d
    return r * _f(math.cos(x)), r * _f(math.sin(x)), s * _f(math.cos(y)), s * _f(math.sin(y))
