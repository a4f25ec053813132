"""Rotations and rigid poses as arrays: exponential map, sampling, angles modulo symmetry."""

from __future__ import annotations

from functools import cache, reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats

_TINY = 1e-12


def skew(vectors: Floats) -> Floats:
    """Cross-product matrices, ... x 3 -> ... x 3 x 3."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)


def exp_so3(rotation_vectors: Floats) -> Floats:
    """Rotation matrices of rotation vectors (Rodrigues), ... x 3 radians -> ... x 3 x 3."""
    angle = np.sqrt((rotation_vectors**2).sum(-1))[..., None, None]
    K = skew(rotation_vectors) / (angle + _TINY)
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * compose(K, K)


def log_so3(rotations: Floats) -> Floats:
    """Rotation vectors of rotation matrices, ... x 3 x 3 -> ... x 3 radians, length in [0, pi]."""
    quaternion = _quaternion(rotations)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quaternion[..., :1])
    return quaternion[..., 1:] * np.where(sine > _TINY, angle / np.maximum(sine, _TINY), 2.0)


def _quaternion(R: Floats) -> Floats:
    """Unit quaternions w, x, y, z with w >= 0: the best conditioned of four equivalent columns."""
    trace = np.trace(R, axis1=-2, axis2=-1)[..., None, None]
    vector = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    outer = np.zeros((*R.shape[:-2], 4, 4))
    outer[..., :1, :1] = 1.0 + trace
    outer[..., 1:, 0] = outer[..., 0, 1:] = vector
    outer[..., 1:, 1:] = R + np.swapaxes(R, -1, -2) + (1.0 - trace) * np.eye(3)
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), -1)
    q = np.take_along_axis(outer, best[..., None, None], -1)[..., 0]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def random_rotations(count: int, rng: np.random.Generator) -> Floats:
    """Rotations uniform over SO(3), count x 3 x 3."""
    q = rng.normal(size=(count, 4))
    w, x, y, z = (q / np.sqrt((q**2).sum(1, keepdims=True))).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def random_direction(rng: np.random.Generator) -> Floats:
    """A unit vector uniform over the sphere, 3."""
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def compose(A: Floats, B: Floats) -> Floats:
    """Products of stacked square matrices without BLAS, whose rounding may depend on its number of threads."""
    # Terms are added one after the other: NumPy is slow at sums along short axes.
    return reduce(add, (A[..., :, k, None] * B[..., k, None, :] for k in range(A.shape[-1])))


def rotate(R: Floats, points: Floats) -> Floats:
    """Rotates vectors, ... x 3 x 3 and ... x 3 -> ... x 3, without BLAS."""
    return reduce(add, (R[..., k] * points[..., k, None] for k in range(3)))


def turned_within(poses: Floats, turns: Floats) -> Floats:
    """Poses A x 3 x 4 after turns S x 3 x 4 (or S x 4 x 4) in the object's own frame, A x S x 3 x 4."""
    R, t = poses[:, None, :, :3], poses[:, None, :, 3]
    return np.concatenate([compose(R, turns[:, :3, :3]), (rotate(R, turns[:, :3, 3]) + t)[..., None]], -1)


def along(vectors: Floats, direction: Floats) -> Floats:
    """Inner products of vectors, ... x 3 and ... x 3 -> ..., without BLAS."""
    return reduce(add, (vectors[..., k] * direction[..., k] for k in range(3)))


def pose(R: Floats, t: Floats) -> Floats:
    """4 x 4 homogeneous matrix."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def small_motion(change: Floats) -> Floats:
    """A small motion (4 x 4) of a rotation vector and a translation, 6."""
    return pose(exp_so3(change[:3]), change[3:])


def is_rotation(R: Floats) -> bool:
    """Whether a 3 x 3 matrix turns things and does nothing else to them."""
    return bool(np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0)


def is_pose(T: Floats) -> bool:
    """Whether a 4 x 4 matrix is a rotation and a translation."""
    return is_rotation(T[:3, :3]) and bool(np.isfinite(T).all()) and np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0])


def inverse(T: Floats) -> Floats:
    """Inverse of a 4 x 4 rigid transform."""
    return pose(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])


def rotation_angle(A: Floats, B: Floats) -> Floats:
    """Angles between rotations, ... x 3 x 3 each, radians."""
    # The chord stays exact where the arc cosine of the trace loses half of its digits.
    chord = np.sqrt(((A - B) ** 2).sum((-2, -1)))
    return 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0))


def symmetry_angle(A: Floats, B: Floats, symmetries: Floats) -> Floats:
    """Smallest angles between rotations A and B (... x 3 x 3) modulo ``symmetries`` (S x 4 x 4), radians."""
    equivalents = compose(B[..., None, :, :], symmetries[:, :3, :3])
    return rotation_angle(A[..., None, :, :], equivalents).min(-1)


@cache
def cube_rotations() -> Floats:
    """The 24 rotations of a cube, identity first, 24 x 3 x 3."""
    found: list[NDArray[np.float64]] = [np.eye(3)]
    turns = [np.round(exp_so3(np.pi / 2 * axis)) for axis in np.eye(3)]
    for rotation in found:
        for turn in turns:
            candidate = turn @ rotation
            if not any(np.array_equal(candidate, known) for known in found):
                found.append(candidate)
    return np.stack(found)


def raised(T: Floats, height: float) -> Floats:
    """The same pose ``height`` metres higher."""
    result = T.copy()
    result[2, 3] += height
    return result
