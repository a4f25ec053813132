"""What a triangle and a pixel come to, as functions of scalars: compiled for the CPU here and for CUDA by its kernels.

Every value is a float32 and every name is one that both compilers know, so that both devices compute the same.
"""

# ruff: noqa: PLR0917, PLW3301
# pyright: reportMissingParameterType=false
# Scalars are passed by position, and only nested minima of two values compile to vector instructions.

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy import ceil, floor

NEAR = 0.05
"""Metres: nothing with a corner closer than this is rendered."""

# The cache of compiled functions looks at their own file only, though they contain functions of the others: each state
# of the sources has its own cache.
_SOURCES = [Path(__file__).with_name(f"{name}.py").read_bytes() for name in ("pixel_math", "rasteriser", "kernels")]
_CACHES: Any = numba.config
_CACHES.CACHE_DIR = str(
    Path(_CACHES.CACHE_DIR or Path(__file__).parent / "__pycache__") / sha256(b"".join(_SOURCES)).hexdigest()[:16]
)

# Reassociation lets sums vectorise; NaN and infinity keep their meaning. No parallel reduction anywhere:
# the bytes must not depend on how many threads a machine has.
KERNEL: dict[str, Any] = {
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
    "cache": True,
    "boundscheck": False,
    "error_model": "numpy",
}
# A function that kernels call must vanish into them: otherwise two copies of it exist, compiled in different
# surroundings, and which one runs depends on whether this process compiled the kernel or loaded it from the cache.
INLINED: dict[str, Any] = KERNEL | {"forceinline": True}
THIN = 1e-4
"""Pixels: a triangle thinner than this covers no pixel but by chance, and its weights there are rounding."""

_f = np.float32
_THIN = np.float32(THIN)
_ZERO = np.float32(0)
_ONE = np.float32(1)


@numba.njit(**INLINED)
def screen_matrix(pose, view):
    """Rows of K [R | t], 12 values: homogeneous pixel coordinates of object points."""
    fx, fy, cx, cy = view[0], view[1], view[2], view[3]
    return (
        pose[0, 0] * fx + pose[2, 0] * cx, pose[0, 1] * fx + pose[2, 1] * cx,
        pose[0, 2] * fx + pose[2, 2] * cx, pose[0, 3] * fx + pose[2, 3] * cx,
        pose[1, 0] * fy + pose[2, 0] * cy, pose[1, 1] * fy + pose[2, 1] * cy,
        pose[1, 2] * fy + pose[2, 2] * cy, pose[1, 3] * fy + pose[2, 3] * cy,
        pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3],
    )  # fmt: skip


@numba.njit(**INLINED)
def project(x, y, z, m):
    """Screen coordinates and inverse depth u, v, q of an object's point."""
    m0, m1, m2, m3, m4, m5, m6, m7, m8, m9, m10, m11 = m
    q = _ONE / (m8 * x + m9 * y + m10 * z + m11)
    return (m0 * x + m1 * y + m2 * z + m3) * q, (m4 * x + m5 * y + m6 * z + m7) * q, q


@numba.njit(**INLINED)
def triangle_setup(ax, ay, az, bx, by, bz, cx, cy, cz, m, left, right, top, bottom):
    """Projects a triangle onto the pixels [left, right] x [top, bottom].

    Returns the width, height and first pixel (relative to left, top) of its rectangle, then at that pixel two
    barycentric weights (of the second and third corner) and inverse depth, then the steps in x and y of the
    first weight, the second and inverse depth: 13 values. Width 0 culls.
    """
    ua, va, qa = project(ax, ay, az, m)
    ub, vb, qb = project(bx, by, bz, m)
    ud, vd, qd = project(cx, cy, cz, m)
    ub, vb, qb = ub - ua, vb - va, qb - qa
    ud, vd, qd = ud - ua, vd - va, qd - qa
    x0 = max(left, ceil(ua + min(_ZERO, min(ub, ud))))
    x1 = min(right, floor(ua + max(_ZERO, max(ub, ud))))
    y0 = max(top, ceil(va + min(_ZERO, min(vb, vd))))
    y1 = min(bottom, floor(va + max(_ZERO, max(vb, vd))))
    area = ub * vd - vb * ud
    thinnest = _THIN * (abs(ub) + abs(vb) + abs(ud) + abs(vd))
    inverse_area = _ONE / area
    b_x, b_y = vd * inverse_area, -ud * inverse_area
    d_x, d_y = -vb * inverse_area, ub * inverse_area
    q_x, q_y = b_x * qb + d_x * qd, b_y * qb + d_y * qd
    px, py = x0 - ua, y0 - va
    # Seen from outside, a counter-clockwise face turns clockwise on a screen whose y points down.
    width = x1 - x0 + _ONE if area < -thinnest else _ZERO
    return (width, y1 - y0 + _ONE, x0 - left, y0 - top,
            b_x * px + b_y * py, d_x * px + d_y * py, qa + q_x * px + q_y * py,
            b_x, b_y, d_x, d_y, q_x, q_y)  # fmt: skip


@numba.njit(**INLINED)
def pixel_cost(q, background, observed, factor, credit, truncation, margin, occluder):
    """What a pixel costs with the object at inverse depth ``q`` there, less what it costs without; 0 where hidden.

    Without it costs ``credit``; nothing where that is negative: the object may miss such a reading by as much.
    """
    behind = factor * (_ONE / q - observed)
    cost = max(min(abs(behind), truncation) - abs(credit), min(-credit, _ZERO))
    cost = occluder if behind > margin else cost
    return cost if (q > background and factor > _ZERO) else _ZERO


@numba.njit(**INLINED)
def height_row(pose, plane):
    """a, b, c, d: an object's point x, y, z lies a x + b y + c z + d above the plane, metres."""
    n0, n1, n2, offset = plane[0], plane[1], plane[2], plane[3]
    return (n0 * pose[0, 0] + n1 * pose[1, 0] + n2 * pose[2, 0],
            n0 * pose[0, 1] + n1 * pose[1, 1] + n2 * pose[2, 1],
            n0 * pose[0, 2] + n1 * pose[1, 2] + n2 * pose[2, 2],
            n0 * pose[0, 3] + n1 * pose[1, 3] + n2 * pose[2, 3] + offset)  # fmt: skip
