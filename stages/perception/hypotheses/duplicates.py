"""Candidates that show one and the same object, and scenes that are one and the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stages.geometry.arrays import Floats
from stages.messages.scene import ObjectPose

SHARED = 0.6
"""Share of the smaller of two boxes that lies in the other if both frame one object, or a part of it."""
_APART = 0.01
"""Metres between the origins of two poses of one object; only thin ones that lie in each other are nearer."""


def unrepeated(labels: Sequence[str], boxes: Sequence[Floats], places: Sequence[Floats] | None = None) -> list[int]:
    """Indices of those that show no object that one before them shows.

    Two show the same object if they have its label, one's box (x0, y0, x1, y1) lies mostly in the other's and, where
    ``places`` (x, y, z in metres) are known, both stand in one.
    """
    kept: list[int] = []
    for i in range(len(labels)):
        rivals = (k for k in kept if labels[k] == labels[i] and shared(boxes[k], boxes[i]) > SHARED)
        if not any(places is None or _together(places[k], places[i]) for k in rivals):
            kept.append(i)
    return kept


def without_doubles(objects: Sequence[ObjectPose]) -> tuple[ObjectPose, ...]:
    """The objects of a scene, each once: two boxes apart may show the two ends of one, with something before it."""
    kept: list[ObjectPose] = []
    for item in objects:
        if not any(_is_same(other, item) for other in kept):
            kept.append(item)
    return tuple(kept)


def is_same_scene(one: Sequence[ObjectPose], other: Sequence[ObjectPose]) -> bool:
    """Whether two scenes have the same objects in the same places, whichever candidates they came from."""
    left = list(other)
    for item in one:
        found = next((o for o in left if _is_same(o, item)), None)
        if found is None:
            return False
        left.remove(found)
    return not left


def shared(a: Floats, b: Floats) -> float:
    """Share of the smaller box that lies in the other."""
    inside = np.prod(np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None))
    return float(inside / max(min(np.prod(a[2:] - a[:2]), np.prod(b[2:] - b[:2])), 1e-9))


def _is_same(one: ObjectPose, other: ObjectPose) -> bool:
    return one.label == other.label and _together(one.T_camera_object[:3, 3], other.T_camera_object[:3, 3])


def _together(a: Floats, b: Floats) -> bool:
    return bool(np.linalg.norm(a - b) < _APART)
