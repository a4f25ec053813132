"""Perceived scenes against the simulator's truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from stages.geometry.arrays import Floats
from stages.messages.scene import SceneObject
from stages.scene.catalogue import Catalogue
from stages.scene.metrics import nearest_symmetries, pose_errors


@dataclass(frozen=True, slots=True)
class ObjectError:
    """How far an object of the simulator's truth was perceived from where it is."""

    name: str
    found: bool
    """False where the scene shows no object of this label for it."""
    position: float = float("nan")
    """Metres."""
    rotation: float = float("nan")
    """Radians, modulo the object's symmetries."""


def errors(
    names: Sequence[str], T_base_objects: Floats, perceived: Sequence[SceneObject], catalogue: Catalogue
) -> tuple[ObjectError, ...]:
    """One error per true object (``names``, N x 4 x 4 poses), against the nearest perceived object of its label.

    No perceived object answers for two true ones.
    """
    found = matched(names, T_base_objects, perceived, catalogue)
    return tuple(
        _error(name, T_base_objects[k], found[k], catalogue) if k in found else ObjectError(name, found=False)
        for k, name in enumerate(names)
    )


def matched(
    names: Sequence[str], T_base_objects: Floats, perceived: Sequence[SceneObject], catalogue: Catalogue
) -> dict[int, SceneObject]:
    """The perceived object of every true one, by the true one's number; the nearest of its label, each once."""
    labels = [label_of(name, catalogue) for name in names]
    matched: dict[int, SceneObject] = {}
    for label in dict.fromkeys(labels):
        truth = [k for k, other in enumerate(labels) if other == label]
        seen = [item for item in perceived if item.label == label]
        distances = [[np.linalg.norm(_offset(T_base_objects[k], item.T_base_object)) for item in seen] for k in truth]
        rows, columns = linear_sum_assignment(np.reshape(distances, (len(truth), len(seen))))
        matched |= {truth[row]: seen[column] for row, column in zip(rows, columns, strict=True)}
    return matched


def label_of(name: str, catalogue: Catalogue) -> str:
    """The catalogue's name of a scene's object: ``cup`` for ``cup_2``."""
    return name if name in catalogue.objects else name.rpartition("_")[0]


def _error(name: str, T_base_object: Floats, perceived: SceneObject, catalogue: Catalogue) -> ObjectError:
    symmetries = nearest_symmetries(perceived.T_base_object, T_base_object, catalogue[perceived.label].symmetries)
    position, rotation = pose_errors(perceived.T_base_object, T_base_object, symmetries)
    return ObjectError(name, found=True, position=position, rotation=rotation)


def _offset(A: Floats, B: Floats) -> Floats:
    return B[:3, 3] - A[:3, 3]
