"""Pose errors as BOP and the paper measure them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, pose, rotation_angle, symmetry_angle
from stages.messages.arrays import Intrinsics
from stages.scene.catalogue import Symmetries

Image = NDArray[np.floating]
"""H x W metres along the optical axis, 0 where there is nothing."""

BOP_SHARES: Floats = np.linspace(0.05, 0.5, 10)
"""5 to 50 %: misalignment tolerances and correctness thresholds of the BOP Challenge, as shares of a diameter."""
BOP_SYMMETRY_STEP = 0.02
"""Radians: with it a continuous symmetry is sampled 315 times, as in the BOP Challenge."""
VSD_DELTA = 0.015
"""Metres by which a visible surface may lie behind what was observed."""
AUC_LIMIT = 0.1
"""Metres: the area under the curve of ADD-S is taken from 0 to here (PoseCNN, Xiang et al., 2018)."""


def add(T_estimate: Floats, T_true: Floats, points: Floats) -> float:
    """ADD (Hinterstoisser et al., 2012): mean distance of corresponding points, metres.

    Poses are 4 x 4, ``points`` V x 3 in the object frame.
    """
    return float(np.linalg.norm(_moved(T_estimate, points) - _moved(T_true, points), axis=1).mean())


def add_s(T_estimate: Floats, T_true: Floats, points: Floats) -> float:
    """ADD-S: mean distance from each point at the true pose to the nearest point at the estimate, metres."""
    distances, _ = KDTree(_moved(T_estimate, points)).query(_moved(T_true, points))
    return float(np.mean(distances))


def mssd(T_estimate: Floats, T_true: Floats, points: Floats, symmetries: Floats) -> float:
    """MSSD (Hodan et al., 2020): the largest distance of corresponding points, least over symmetries, metres.

    ``symmetries`` is S x 4 x 4, identity first. The corners of the points' convex hull suffice as ``points``
    (V x 3): the distance is convex in the point.
    """
    estimate = _moved(T_estimate, points)
    return float(min(_farthest(estimate, _moved(T_true @ symmetry, points)) for symmetry in symmetries))


def _farthest(A: Floats, B: Floats) -> float:
    return float(np.sqrt(((A - B) ** 2).sum(1).max()))


def vsd(
    estimate: Image, truth: Image, observed: Image, K: Intrinsics, taus: Floats, *, delta: float = VSD_DELTA
) -> Floats:
    """VSD (Hodan et al., 2018): the share of visible pixels at which two rendered poses disagree, one per ``taus``.

    The images are depths of the object alone at both poses and of the scene. Visibility is that of the BOP
    Challenge since 2019: a surface is visible up to ``delta`` behind the observed one and where nothing was
    observed, and an estimate wherever the true object is. Distances are along the ray, as the definition has them.
    """
    slant = _slant(estimate.shape, K)
    far, far_true, far_observed = (slant * image.astype(np.float64) for image in (estimate, truth, observed))
    true_visible = _visible(far_true, far_observed, delta)
    visible = _visible(far, far_observed, delta) | (true_visible & (far > 0))
    both = true_visible & visible
    total = int((true_visible | visible).sum())
    if total == 0:
        return np.ones(len(taus))
    differences = np.abs(far[both] - far_true[both])
    wrong = (differences[None] >= taus[:, None]).sum(1)
    return (wrong + total - int(both.sum())) / total


def _visible(rendered: Floats, observed: Floats, delta: float) -> NDArray[np.bool_]:
    return (rendered > 0) & ((rendered - observed <= delta) | (observed <= 0))


def _slant(shape: tuple[int, ...], K: Intrinsics) -> Floats:
    """Length of each pixel's ray per unit of depth."""
    v, u = np.indices(shape)
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    return np.sqrt(x * x + y * y + 1.0)


def average_recall(errors: Floats, thresholds: Floats = BOP_SHARES) -> float:
    """AR of BOP: the share of errors below a threshold, averaged over ``thresholds``; errors of any shape."""
    return float(np.mean([np.mean(np.asarray(errors) < threshold) for threshold in thresholds]))


def area_under_curve(errors: Floats, limit: float = AUC_LIMIT) -> float:
    """The area under the share of errors below a threshold, as the threshold goes from 0 to ``limit``; 0 to 1."""
    return float(np.mean(np.maximum(1.0 - np.asarray(errors) / limit, 0.0)))


def pose_errors(T_estimate: Floats, T_true: Floats, symmetries: Floats) -> tuple[float, float]:
    """Translation (metres) and rotation error (radians) modulo ``symmetries`` (S x 4 x 4, identity first).

    Both are those of the equivalent true pose that is nearest in rotation; where rotations tie, in translation.
    """
    equivalents = T_true @ symmetries
    angles = rotation_angle(T_estimate[None, :3, :3], equivalents[:, :3, :3])
    offsets = np.linalg.norm(equivalents[:, :3, 3] - T_estimate[:3, 3], axis=1)
    best = int(np.lexsort((offsets, np.round(angles, 9)))[0])
    return float(offsets[best]), float(angles[best])


def nearest_symmetries(T_estimate: Floats, T_true: Floats, symmetries: Symmetries) -> Floats:
    """The symmetry transforms that matter for a pair of 4 x 4 poses, identity first, S x 4 x 4.

    They are the discrete ones and, about every continuous axis, each of these with the turn that brings the true
    pose nearest to the estimate. A sampled axis would add up to half of its step to every rotation error.
    """
    discrete = np.concatenate([np.eye(4)[None], symmetries.discrete.reshape(-1, 4, 4)])
    turned = [
        symmetry @ _turn_towards(T_estimate[:3, :3], (T_true @ symmetry)[:3, :3], axis, offset)
        for axis, offset in symmetries.continuous
        for symmetry in discrete
    ]
    return np.concatenate([discrete, np.reshape(turned, (-1, 4, 4))])


def _turn_towards(R_estimate: Floats, R_true: Floats, axis: Floats, offset: Floats) -> Floats:
    """The turn about a line of the object frame that brings one rotation nearest to another (swing and twist)."""
    R = R_true.T @ R_estimate
    # The trace of turn^T R is largest, so the angle between them least, at this angle.
    sine = float(axis @ [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    cosine = float(np.trace(R) - axis @ R @ axis)
    turn = exp_so3(np.arctan2(sine, cosine) * axis)
    return pose(turn, offset - turn @ offset)


def is_near_flip(T_estimate: Floats, T_true: Floats, symmetries: Symmetries, *, tolerance: float) -> bool:
    """True where the rotation is wrong but right, within ``tolerance`` radians, after a near symmetry."""
    exact = symmetries.transforms()
    R, R_true = T_estimate[:3, :3], T_true[:3, :3]
    if symmetry_angle(R, R_true, exact) <= tolerance:
        return False
    return any(symmetry_angle(R, R_true @ near[:3, :3], exact) <= tolerance for near in symmetries.near)


def _moved(T: Floats, points: Floats) -> Floats:
    return points @ T[:3, :3].T + T[:3, 3]
