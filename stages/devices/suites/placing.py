"""Where an object comes to stand that is put down upright."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from runner.contract import Refused
from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, pose
from stages.robots import Table
from stages.scene.catalogue import Catalogue, CatalogueObject, Primitive
from stages.scene.scoring import label_of
from stages.scene.stance import Stances, Standing

_GRID = 0.01
"""Metres between the points at which it is seen what is below an object: nothing is slimmer."""


def upright(entry: CatalogueObject, x: float, y: float, yaw: float, height: float) -> Floats:
    """T_base_object of an upright object whose lowest point is at ``height``."""
    c, s = np.cos(yaw), np.sin(yaw)
    return pose(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([x, y, height - entry.bounds[0, 2]]))


def support_height(entry: CatalogueObject, x: float, y: float) -> float:
    """Height in the object frame on which something rests above (x, y), metres: a tray's floor, a box's top."""
    return max(_tops(entry, x, y), default=float(entry.bounds[1, 2]))


def moved(
    name: str, place: tuple[float, float], layout: Mapping[str, Floats], catalogue: Catalogue, table: Table
) -> Floats:
    """T_base_object of an object that is put down upright at ``place`` (x, y), on whatever is highest below it.

    Raises Refused where there is no table below.
    """
    x, y = place
    low, high = (np.array(table.center) + sign * np.array(table.size) / 2 for sign in (-1, 1))
    if not ((low < place) & (place < high)).all():
        raise Refused(
            f"x={x:g} y={y:g}: beside the table; valid: {low[0]:g} to {high[0]:g} and {low[1]:g} to {high[1]:g}"
        )
    entry = catalogue[label_of(name, catalogue)]
    others = [(catalogue[label_of(other, catalogue)], T) for other, T in layout.items() if other != name]
    yaw = float(np.arctan2(layout[name][1, 0], layout[name][0, 0]))
    outline = Standing.at(name, Stances(entry), upright(entry, x, y, yaw, table.height)).outline
    steps = (np.arange(start, stop, _GRID) for start, stop in zip(outline.min(0), outline.max(0), strict=True))
    grid = np.stack(np.meshgrid(*steps), -1).reshape(-1, 2)
    covered = np.vstack([outline, grid[regions.depth(outline, grid) >= 0]])
    heights = [_height(other, T, *point) for point in covered.tolist() for other, T in others]
    return upright(entry, x, y, yaw, max([table.height, *heights]))


def _height(entry: CatalogueObject, T_base_object: Floats, x: float, y: float) -> float:
    """Height of the highest surface of an object at (x, y) in the base frame, metres; minus infinity beside it."""
    local = inverse(T_base_object) @ [x, y, 0, 1]
    return T_base_object[2, 3] + max(_tops(entry, local[0], local[1]), default=-np.inf)


def _tops(entry: CatalogueObject, x: float, y: float) -> Iterator[float]:
    """Heights of the shapes that cover (x, y) in the object frame, metres."""
    covering = (primitive for primitive in entry.collision if _covers(primitive, x, y))
    return (float(one.T_object_primitive[2, 3] + one.size[-1] / 2) for one in covering)


def _covers(primitive: Primitive, x: float, y: float) -> bool:
    local = inverse(primitive.T_object_primitive) @ [x, y, 0, 1]
    if primitive.kind == "cylinder":
        return bool(np.hypot(local[0], local[1]) <= primitive.size[0])
    return bool((np.abs(local[:2]) <= np.array(primitive.size[:2]) / 2).all())
