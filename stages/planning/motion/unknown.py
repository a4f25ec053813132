"""What stands there and nobody recognised: boxes to keep away from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import trimesh

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages.scene import SceneGraph, UnknownRegion
from stages.planning.motion.collision import CollisionWorld
from stages.robots import Robot, Table
from stages.scene.catalogue import ASYMMETRIC, CatalogueObject, Mesh, Primitive
from stages.scene.naming import region_name

Placed = tuple[CatalogueObject, Floats]
"""An object and where it stands, T_base_object."""
_OFF = 0.01
"""Metres beyond an object's enclosing box within which readings may still be its own."""
_RIM = 0.005
"""Metres by which a region is smaller on each side than what it shows: readings at edges do not count."""
_CONTENT = 0.5
"""Share of a container's footprint up to which something may stand in it."""


def unknown_objects(scene: SceneGraph, objects: Mapping[str, Placed], robot: Robot, table: Table) -> dict[str, Placed]:
    """The scene's unknown regions as boxes down to the table, which nobody can take.

    Those are left out that are part of one of the ``objects``, whose estimate is a little off or which is remembered
    and was not recognised, and those that are the arm's own, where the robot at home touches them.
    """
    regions = {region_name(number): region for number, region in enumerate(scene.unknown)}
    known = [(item, inverse(T) @ scene.T_base_table) for item, T in objects.values()]
    found = {
        name: _box(region, scene.T_base_table)
        for name, region in regions.items()
        if not any(_belongs(region, item, T_object_table) for item, T_object_table in known)
    }
    if not found:
        return {}
    touching = CollisionWorld(robot, table, found).contacts(robot.home)
    return {name: box for name, box in found.items() if not any(name in pair for pair in touching)}


def _belongs(region: UnknownRegion, item: CatalogueObject, T_object_table: Floats) -> bool:
    """Whether a region is part of an object; what is small and in a container is something else."""
    centre = T_object_table[:3, :3] @ region.centre_table + T_object_table[:3, 3]
    low, high = item.bounds
    inside = bool(((centre > low - _OFF) & (centre < high + _OFF)).all())
    larger = np.linalg.norm(region.extent_table) > np.linalg.norm(item.dimensions) + 2 * _OFF
    content = item.concave and np.prod(region.extent_table[:2]) < _CONTENT * np.prod(item.dimensions[:2])
    return inside and not larger and not content


def _box(region: UnknownRegion, T_base_table: Floats) -> Placed:
    """A box from the top of a region down to the table: what hides its lower part is in front of it."""
    top = float(region.centre_table[2] + region.extent_table[2] / 2)
    size = np.array([*(region.extent_table[:2] + 2 * _RIM), top])
    shape = trimesh.creation.box(size)
    item = CatalogueObject(
        name="unknown",
        label=0,
        mesh=Mesh(np.asarray(shape.vertices), np.asarray(shape.faces, np.int32), np.zeros((8, 3), np.uint8)),
        concave=False,
        symmetries=ASYMMETRIC,
        mass=1.0,
        friction=1.0,
        resting=(np.eye(3),),
        grasps=(),
        collision=(Primitive("box", tuple(size.tolist()), np.eye(4)),),
    )
    T_table_box = np.eye(4)
    T_table_box[:3, 3] = *region.centre_table[:2], top / 2
    return item, T_base_table @ T_table_box
