"""From the catalogue's grasps to hand poses: the same grasp seen through the symmetries of the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import raised
from stages.scene.catalogue import CatalogueObject, Grasp

_STEP = np.deg2rad(22.5)
"""How finely a continuous symmetry is sampled."""
_STEEPEST = 0.2
"""Largest vertical component of an approach direction: nothing is grasped from below."""


_ABOVE = 0.12
"""Metres above a side grasp from which the open fingers may come down on either side of the object."""


@dataclass(frozen=True)
class HandPose:
    """A hand pose at which the object is held with ``grasp``."""

    grasp: Grasp
    T_base_hand: Floats
    T_base_prehand: Floats
    T_object_hand: Floats
    """4 x 4; equals the catalogue's grasp up to a symmetry of the object."""


def distinct_grasps(entry: CatalogueObject) -> list[Grasp]:
    """The object's grasps in the user's order, without those that a symmetry turns into an earlier one."""
    kept: list[Grasp] = []
    seen: list[Floats] = []
    for grasp in entry.grasps:
        if not any(_alike(grasp.T_object_grasp, T) for T in seen):
            kept.append(grasp)
            seen += [pose.T_object_hand for pose in _all_poses(entry, grasp, np.eye(4))]
    return kept


def hand_poses(entry: CatalogueObject, grasp: Grasp, T_base_object: Floats) -> list[HandPose]:
    """Every way to apply ``grasp`` to the object at ``T_base_object`` (4 x 4), most natural first.

    Two hand poses of one object and grasp differ by a symmetry only: picked with one, the object may be placed
    with any other. Approaches from below are left out, as are those with a finger below the object; the others are
    ordered by how much they point away from the robot, then as the symmetries come.
    """
    low = float((entry.mesh.vertices @ T_base_object[2, :3]).min() + T_base_object[2, 3])
    poses = [pose for pose in _all_poses(entry, grasp, T_base_object) if _is_from_above(pose, low)]
    return _distinct(sorted(poses, key=lambda pose: -_outward(pose)))


def approaches(hand: HandPose) -> list[Floats]:
    """Where the hand may come from in a straight line, 4 x 4 each: as the catalogue says, from nearer, from above."""
    near = hand.T_base_prehand.copy()
    near[:3, 3] = (hand.T_base_prehand[:3, 3] + hand.T_base_hand[:3, 3]) / 2
    above = raised(hand.T_base_hand, _ABOVE)
    return [hand.T_base_prehand, near, above] if hand.grasp.kind == "side" else [hand.T_base_prehand, near]


def _all_poses(entry: CatalogueObject, grasp: Grasp, T_base_object: Floats) -> list[HandPose]:
    symmetries = entry.symmetries.transforms(_STEP)
    return [_hand_pose(grasp, T_base_object, symmetry) for symmetry in symmetries]


def _hand_pose(grasp: Grasp, T_base_object: Floats, symmetry: Floats) -> HandPose:
    T_object_hand = symmetry @ grasp.T_object_grasp
    return HandPose(
        grasp=grasp,
        T_base_hand=T_base_object @ T_object_hand,
        T_base_prehand=T_base_object @ symmetry @ grasp.T_object_pregrasp,
        T_object_hand=T_object_hand,
    )


def _is_from_above(pose: HandPose, low: float) -> bool:
    """Whether the hand does not come from below, and neither finger gets below the height ``low``."""
    x, y, _, origin = pose.T_base_hand[2]
    return x <= _STEEPEST and origin - abs(y) * pose.grasp.width / 2 >= low


def _outward(pose: HandPose) -> float:
    """Horizontal part of the approach along the line from the robot to the object, rounded to keep ties in order."""
    radial = pose.T_base_hand[:2, 3] / np.linalg.norm(pose.T_base_hand[:2, 3])
    return round(float(radial @ pose.T_base_hand[:2, 0]), 2)


def _distinct(poses: list[HandPose]) -> list[HandPose]:
    kept: list[HandPose] = []
    for pose in poses:
        if not any(_alike(pose.T_base_hand, other.T_base_hand) for other in kept):
            kept.append(pose)
    return kept


def _alike(A: Floats, B: Floats) -> bool:
    return bool(np.abs(A - B).max() < 1e-3)
