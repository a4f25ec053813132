"""Pose errors as BOP and the paper measure them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from stages.perception.poses import rotation_angle, symmetry_angle
from stages.scene.catalogue import Floats, Symmetries


def add(T_estimate: Floats, T_true: Floats, points: Floats) -> float:
    """ADD (Hinterstoisser et al., 2012): mean distance of corresponding points, metres.

    Poses are 4 x 4, ``points`` V x 3 in the object frame.
    """
    return float(np.linalg.norm(_moved(T_estimate, points) - _moved(T_true, points), axis=1).mean())


def add_s(T_estimate: Floats, T_true: Floats, points: Floats) -> float:
    """ADD-S: mean distance from each point at the true pose to the nearest point at the estimate, metres."""
    distances, _ = KDTree(_moved(T_estimate, points)).query(_moved(T_true, points))
    return float(np.mean(distances))


def pose_errors(T_estimate: Floats, T_true: Floats, symmetries: Floats) -> tuple[float, float]:
    """Translation (metres) and rotation error (radians) modulo ``symmetries`` (S x 4 x 4, identity first).

    Both are those of the equivalent true pose that is nearest in rotation; where rotations tie, in translation.
    """
    equivalents = T_true @ symmetries
    angles = rotation_angle(T_estimate[None, :3, :3], equivalents[:, :3, :3])
    offsets = np.linalg.norm(equivalents[:, :3, 3] - T_estimate[:3, 3], axis=1)
    best = int(np.lexsort((offsets, np.round(angles, 9)))[0])
    return float(offsets[best]), float(angles[best])


def is_near_flip(T_estimate: Floats, T_true: Floats, symmetries: Symmetries, *, tolerance: float) -> bool:
    """True where the rotation is wrong but right, within ``tolerance`` radians, after a near symmetry."""
    exact = symmetries.transforms()
    R, R_true = T_estimate[:3, :3], T_true[:3, :3]
    if symmetry_angle(R, R_true, exact) <= tolerance:
        return False
    return any(symmetry_angle(R, R_true @ near[:3, :3], exact) <= tolerance for near in symmetries.near)


def _moved(T: Floats, points: Floats) -> Floats:
    return points @ T[:3, :3].T + T[:3, 3]
