"""What a look leaves open, as questions that a person can answer, and what the answers say of the scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import msgspec

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages import ObjectPose, SceneEstimate, SceneGraph
from stages.messages.scene import Doubt, SceneObject, Stance
from stages.scene import virtual
from stages.scene.catalogue import Catalogue, CatalogueObject

SURE, UNSURE = 0.9, 0.5
"""Probabilities from which what is said of an object is called sure, and below which it is called doubtful."""
LIKELY = 0.15
"""Probability from which on another stance is asked about."""
UPRIGHT = 0.8
"""Cosine of an object's z axis to the vertical from which on it stands."""
Relate = Callable[[SceneGraph, tuple[SceneObject, ...]], SceneGraph]
"""The same scene with other objects, their relations found anew."""


def is_below(item: SceneObject | ObjectPose, least: float) -> bool:
    """Whether a pose is less probable than that; one that nobody has judged is not."""
    return item.probability is not None and item.probability < least


def doubts(estimate: SceneEstimate, catalogue: Catalogue) -> tuple[Doubt, ...]:
    """What an estimate leaves open: objects that may stand otherwise, and whether something is unknown."""
    T_base_camera = estimate.T_base_camera
    to_base = inverse(estimate.T_camera_table) if T_base_camera is None else T_base_camera
    found = [_otherwise(item, catalogue[item.label], estimate.T_camera_table, to_base) for item in estimate.objects]
    unknown = (Doubt(kind="unknown", object="", choices=("leave", "again")),) if estimate.unknown else ()
    return (*filter(None, found), *unknown)


def _otherwise(item: ObjectPose, entry: CatalogueObject, T_camera_table: Floats, to_base: Floats) -> Doubt | None:
    """The doubt how an object stands; None where another stance is unlikely, or looks the same."""
    symmetries = entry.symmetries
    turns = [*symmetries.transforms(), *symmetries.near.reshape(-1, 4, 4)]
    if item.contradicted or any(T[2, 2] < -UPRIGHT for T in turns):
        return None
    taken = partial(stance, T_camera_table)
    for other in item.alternatives:
        if other.probability >= LIKELY and taken(other.T_camera_object) != taken(item.T_camera_object):
            return Doubt(
                kind="stance",
                object=item.name,
                stance=taken(item.T_camera_object),
                T_base_other=to_base @ other.T_camera_object,
            )
    return None


def stance(T_camera_table: Floats, T_camera_object: Floats) -> Stance:
    """How an object stands on the table."""
    height = float(T_camera_table[:3, 2] @ T_camera_object[:3, 2])
    return "lying" if abs(height) < UPRIGHT else "upright" if height > 0 else "upside down"


def open_doubt(scene: SceneGraph, goal: SceneGraph | None, answers: Mapping[str, str]) -> Doubt | None:
    """The first doubt of a scene that nobody has settled; ``goal`` is what is to be restored."""
    found = [*which(scene, goal), *scene.doubts] if goal else scene.doubts
    return next((doubt for doubt in found if doubt.key not in answers), None)


def which(scene: SceneGraph, goal: SceneGraph) -> Sequence[Doubt]:
    """Objects of which the goal has one of a kind, and the scene several."""
    wanted, there = _by_label(goal), _by_label(scene)
    return [
        Doubt(kind="which", object=names[0], choices=(*there[label], "again"))
        for label, names in wanted.items()
        if len(names) == 1 and len(there.get(label, ())) > 1
    ]


def _by_label(scene: SceneGraph) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for item in scene.objects:
        found.setdefault(item.label, []).append(item.name)
    return found


def meant(answers: Mapping[str, str]) -> dict[str, str]:
    """The names that objects have for those who have answered which one is meant, by the names they had."""
    names = dict[str, str]()
    for key, chosen in answers.items():
        kind, _, wanted = key.partition(" ")
        if kind == "which":
            names |= {chosen: wanted, wanted: chosen}
    return names


def corrected(scene: SceneGraph, answers: Mapping[str, str], relate: Relate) -> SceneGraph:
    """A scene as those see it who have answered: what stands otherwise is turned, what is meant has its name."""
    turned = {
        doubt.object: doubt.T_base_other
        for doubt in scene.doubts
        if answers.get(doubt.key) == "no" and doubt.T_base_other is not None
    }
    names = meant(answers)
    if not turned and all(a == b for a, b in names.items()):
        return scene
    named = tuple(msgspec.structs.replace(item, name=names.get(item.name, item.name)) for item in scene.objects)
    objects = tuple(
        msgspec.structs.replace(now, T_base_object=turned.get(item.name, item.T_base_object))
        for item, now in zip(scene.objects, named, strict=True)
    )
    beside = virtual.renamed(scene.virtual_objects, names)
    return relate(msgspec.structs.replace(scene, objects=named, virtual_objects=beside), objects)
