"""Which side an object shows, told by a label or a handle: as it was shown to the robot, or turned from that."""

from __future__ import annotations

from typing import Literal, get_args

import msgspec
import numpy as np

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages.scene import Assertion, SceneGraph, SceneObject, Side
from stages.scene.stance import yawed

SIDES: tuple[Side, ...] = get_args(Side)
"""In quarter turns to the left, seen from above."""
TOLD = 0.8
"""How likely an estimate must be right about the side for it to count."""
_WITHIN = np.deg2rad(45)
"""Angle up to which it is the same side."""


def is_told(item: SceneObject) -> bool:
    """Whether the image says which side the object shows."""
    return item.facing is not None and item.facing >= TOLD


def sides(goal: SceneGraph) -> dict[str, Side]:
    """The objects of which a goal says which side they show, and which."""
    chosen = (item.arguments for item in goal.assertions if item.predicate == "faces")
    return {name: SIDES[SIDES.index(side)] for name, side in chosen}


def turned_to(T_base_object: Floats, side: Side) -> Floats:
    """The pose (4 x 4) at which an object that was shown at ``T_base_object`` shows ``side``, at the same place."""
    T = T_base_object.copy()
    T[:3, :3] = yawed(SIDES.index(side) * np.pi / 2, np.zeros(3))[:3, :3] @ T[:3, :3]
    return T


def shows(now: SceneObject, T_base_object: Floats) -> bool:
    """Whether an object is seen to show the side that a pose says; symmetries of its shape do not count."""
    R = T_base_object[:3, :3].T @ now.T_base_object[:3, :3]
    return is_told(now) and bool(np.trace(R) > 1 + 2 * np.cos(_WITHIN))


def held(goal: SceneGraph, current: SceneGraph) -> set[tuple[str, tuple[str, ...]]]:
    """Predicate and arguments of what a goal says of sides and is so."""
    shown, now = ({item.name: item for item in scene.objects} for scene in (goal, current))
    return {
        ("faces", (name, side))
        for name, side in sides(goal).items()
        if name in now and shows(now[name], turned_to(shown[name].T_base_object, side))
    }


def faced(scene: SceneGraph, name: str, side: Side | Literal["any"]) -> SceneGraph:
    """A scene that says which side an object shows, or (``any``) does not say it.

    What stands beside the object stays where it was shown: regions are fixed to the object, so they are turned back.
    """
    item = next((item for item in scene.objects if item.name == name and is_told(item)), None)
    if item is None:
        valid = ", ".join(item.name for item in scene.objects if is_told(item)) or "none"
        raise Refused(f"object={name!r}: no object of the goal whose side can be told; valid: {valid}")
    before = turned_to(item.T_base_object, sides(scene).get(name, "shown"))
    after = turned_to(item.T_base_object, "shown" if side == "any" else side)
    back = inverse(after) @ before
    regions = (
        msgspec.structs.replace(one, T_parent_virtual=back @ one.T_parent_virtual) if one.parent == name else one
        for one in scene.virtual_objects
    )
    kept = tuple(one for one in scene.assertions if (one.predicate, one.arguments[0]) != ("faces", name))
    chosen = () if side == "any" else (Assertion(predicate="faces", arguments=(name, side)),)
    return msgspec.structs.replace(scene, virtual_objects=tuple(regions), assertions=(*kept, *chosen))
