"""Expands the catalogue's shorthands: symmetries, resting poses, collision geometry and grasps.

docs/perception/catalogue.md has the format.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import is_pose, is_rotation
from stages.scene.catalogue.mesh_shape import axis_rotation, resting_rotations, transform, turned_up, width_between
from stages.scene.catalogue.objects import Grasp, Mesh, Primitive, Symmetries
from stages.scene.catalogue.sections import Section, is_number

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
RESTING = {
    "upright": np.eye(3),
    "inverted": np.diag([1.0, -1.0, -1.0]),
    **{f"{n}-up": turned_up(np.array(v)) for n, v in AXES.items()},
    **{f"{n}-down": turned_up(-np.array(v)) for n, v in AXES.items()},
}
PREGRASP_DISTANCE = 0.10
FINGER_DEPTH = 0.045
"""How far below the top the fingertips of a top grasp reach, metres."""
FINGER_CLEARANCE = 0.02
"""How far above the object's bottom the fingertips of a top grasp stay, metres."""
FINGER_BEYOND = 0.025
"""How far past the object's axis the fingertips of a side grasp reach, metres."""


# --- symmetries -------------------------------------------------------------------------------------------------


def read_symmetries(section: Section, scale: float) -> Symmetries:
    """The three symmetry keys of BOP's ``models_info.json``; ``scale`` turns its lengths into metres."""
    return Symmetries(
        discrete=_discrete(section, "symmetries_discrete", scale),
        continuous=tuple(_continuous(item, scale) for item in section.sections("symmetries_continuous")),
        near=_discrete(section, "near_symmetries_discrete", scale),
    )


def _discrete(section: Section, key: str, scale: float) -> Floats:
    transforms = [_discrete_one(section, key, item, scale) for item in section.items(key)]
    return np.array(transforms, np.float64).reshape(-1, 4, 4)


def _discrete_one(section: Section, key: str, item: Any, scale: float) -> Floats:
    if isinstance(item, Section):
        return _turn(item, scale)
    rows = [x for row in item for x in row] if isinstance(item, list) and _is_nested(item) else item
    if not isinstance(rows, list) or len(rows) != 16 or not all(map(is_number, rows)):
        section.refuse("a symmetry is 16 numbers (4 x 4, row by row) or {axis: z, degrees: 180}", key)
    T = np.array(rows, np.float64).reshape(4, 4)
    if not is_pose(T):
        section.refuse("a symmetry is a rotation and a translation; this 4 x 4 matrix is not", key)
    T[:3, 3] *= scale
    return T


def _is_nested(item: list[Any]) -> bool:
    return all(isinstance(row, list) for row in item)


def _turn(item: Section, scale: float) -> Floats:
    item.only("axis", "degrees", "offset")
    R = axis_rotation(read_axis(item), np.deg2rad(item.number("degrees")))
    offset = scale * item.numbers("offset", 3, np.zeros(3))
    return transform(R, offset - R @ offset)


def _continuous(item: Section, scale: float) -> tuple[Floats, Floats]:
    item.only("axis", "offset")
    return read_axis(item), scale * item.numbers("offset", 3, np.zeros(3))


def read_axis(section: Section) -> Floats:
    """``axis: z`` or ``axis: [0, 0, 1]`` as a unit vector."""
    value = section.value("axis")
    if isinstance(value, str):
        return np.array(AXES[section.choice("axis", tuple(AXES))])
    axis = section.numbers("axis", 3)
    if np.linalg.norm(axis) < 1e-6:
        section.refuse("an axis has a length", "axis")
    return axis / np.linalg.norm(axis)


# --- resting poses ----------------------------------------------------------------------------------------------


def read_resting(section: Section, mesh: Mesh) -> tuple[Floats, ...]:
    """Names of resting poses or 9 numbers of R_table_object; computed from the mesh where the key is missing."""
    if "resting" not in section.values:
        return resting_rotations(mesh)
    rotations = tuple(_resting_one(section, item) for item in section.items("resting"))
    if not rotations:
        section.refuse(f"at least one of {', '.join(RESTING)}", "resting")
    return rotations


def _resting_one(section: Section, item: Any) -> Floats:
    if isinstance(item, str) and item in RESTING:
        return RESTING[item]
    if isinstance(item, list) and len(item) == 9 and all(map(is_number, item)):
        R = np.array(item, np.float64).reshape(3, 3)
        if is_rotation(R):
            return R
    return section.refuse(f"{item!r} is neither one of {', '.join(RESTING)} nor a 3 x 3 rotation", "resting")


# --- collision geometry -----------------------------------------------------------------------------------------


def read_collision(section: Section, mesh: Mesh) -> tuple[Primitive, ...]:
    """Boxes, cylinders and rings; the enclosing box where the key is missing."""
    if "collision" not in section.values:
        return (enclosing_box(mesh),)
    return tuple(piece for item in section.sections("collision") for piece in _primitives(item))


def enclosing_box(mesh: Mesh) -> Primitive:
    """The axis-aligned box around the mesh."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return Primitive("box", tuple((high - low).tolist()), transform(np.eye(3), (low + high) / 2))


def _primitives(item: Section) -> Iterator[Primitive]:
    item.only("box", "cylinder", "ring", "at", "axis", "degrees")
    kinds = [kind for kind in ("box", "cylinder", "ring") if kind in item.values]
    if len(kinds) != 1:
        item.refuse("exactly one of box, cylinder, ring")
    R = axis_rotation(read_axis(item), np.deg2rad(item.number("degrees"))) if "axis" in item.values else np.eye(3)
    T = transform(R, item.numbers("at", 3, np.zeros(3)))
    if kinds[0] == "ring":
        yield from _ring(item.section("ring"), T)
    else:
        size = item.numbers(kinds[0], 3 if kinds[0] == "box" else 2)
        if (size <= 0).any():
            item.refuse("sizes are above zero", kinds[0])
        yield Primitive("box" if kinds[0] == "box" else "cylinder", tuple(size.tolist()), T)


def _ring(ring: Section, T: Floats) -> Iterator[Primitive]:
    """A hollow round vessel about z, centred at its middle height: wall boxes and, where thick, a floor.

    ``radius`` is the outer one, or a pair (bottom, top) where the wall leans.
    """
    ring.only("radius", "height", "wall", "floor", "segments")
    height, wall, floor = ring.number("height", low=0), ring.number("wall", low=0), ring.number("floor", 0.0)
    given = ring.value("radius")
    bottom, top = ring.numbers("radius", 2) if isinstance(given, list) else (ring.number("radius", low=0),) * 2
    count = ring.integer("segments", 12, low=6)
    for index in range(count):
        around = transform(axis_rotation(np.array(AXES["z"]), 2 * np.pi * index / count), np.zeros(3))
        yield _wall((bottom, top), height, wall, T @ around, breadth=2 * max(bottom, top) * np.tan(np.pi / count))
    if floor > 0:
        at = transform(np.eye(3), np.array([0, 0, (floor - height) / 2]))
        yield Primitive("cylinder", (bottom - wall / 2, floor), T @ at)


def _wall(radii: tuple[float, float], height: float, wall: float, T: Floats, *, breadth: float) -> Primitive:
    """The flat piece of a ring's wall on the x axis; it leans outwards by the difference of the radii."""
    bottom, top = radii
    lean = np.arctan2(top - bottom, height)
    R = axis_rotation(np.array(AXES["y"]), lean)
    # The box's outer face, not its middle, follows the cone.
    centre = np.array([(bottom + top) / 2, 0.0, 0.0]) + R @ np.array([-wall / 2, 0.0, 0.0])
    return Primitive("box", (wall, breadth, height / np.cos(lean)), T @ transform(R, centre))


# --- grasps -----------------------------------------------------------------------------------------------------


def read_grasps(section: Section, mesh: Mesh) -> tuple[Grasp, ...]:
    """Expands the list of grasp shorthands in the order given; objects without the key are not grasped."""
    expand = {"top": _top_grasps, "side": _side_grasps, "rim": _rim_grasps, "pose": _posed_grasp}
    grasps: list[Grasp] = []
    for item in section.sections("grasps"):
        item.only(*expand)
        for kind in item.values:
            grasps += expand[kind](item.section(kind), mesh)
    return tuple(grasps)


def _top_grasps(item: Section, mesh: Mesh) -> Iterator[Grasp]:
    """From above: ``yaws`` are degrees from the object's x axis to the closing direction."""
    item.only("yaws", "depth", "at", "width")
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    at = item.numbers("at", 2, (low + high)[:2] / 2)
    depth = item.number("depth", FINGER_DEPTH, low=0)
    tips = max(high[2] - depth, low[2] + FINGER_CLEARANCE)
    for yaw in _angles(item, "yaws"):
        R = _frame(approach=np.array([0, 0, -1.0]), closing=_heading(yaw))
        yield _grasp("top", f"top {yaw:g}", transform(R, np.array([*at, tips])), item, mesh)


def _side_grasps(item: Section, mesh: Mesh) -> Iterator[Grasp]:
    """Level, at ``height`` metres above the bottom: ``azimuths`` are degrees from x to the approach direction."""
    item.only("azimuths", "height", "beyond", "at", "width")
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    at = item.numbers("at", 2, (low + high)[:2] / 2)
    axis_point = np.array([*at, low[2] + item.number("height", low=0)])
    beyond = item.number("beyond", FINGER_BEYOND)
    for azimuth in _angles(item, "azimuths"):
        approach = _heading(azimuth)
        for roll, side in (("", 1.0), (" rolled", -1.0)):
            # The gripper is symmetric: turned half a turn about its approach it holds the same way.
            R = _frame(approach=approach, closing=side * _heading(azimuth + 90))
            T = transform(R, axis_point + beyond * approach)
            yield _grasp("side", f"side {azimuth:g}{roll}", T, item, mesh)


def _rim_grasps(item: Section, mesh: Mesh) -> Iterator[Grasp]:
    """Along the wall of a vessel, from above: one finger inside, one outside; the brim is ``radius`` from the z axis.

    ``lean``: degrees by which the wall widens upwards.
    """
    item.only("azimuths", "radius", "depth", "lean", "at", "width")
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    at = np.array([*item.numbers("at", 2, (low + high)[:2] / 2), high[2]])
    lean, depth = np.deg2rad(item.number("lean", 0.0)), item.number("depth", FINGER_DEPTH, low=0)
    item.number("width", low=0)  # The mesh's own width would span to the opposite wall.
    for azimuth in _angles(item, "azimuths"):
        outward = _heading(azimuth)
        approach = -np.sin(lean) * outward - np.cos(lean) * np.array([0.0, 0.0, 1.0])
        brim = at + item.number("radius", low=0) * outward
        T = transform(_frame(approach=approach, closing=outward), brim + depth * approach)
        yield _grasp("top", f"rim {azimuth:g}", T, item, mesh)


def _posed_grasp(item: Section, mesh: Mesh) -> Iterator[Grasp]:
    """One grasp in full: approach and closing direction and the point between the fingertips."""
    item.only("name", "kind", "approach", "closing", "at", "width")
    kind = "side" if item.choice("kind", ("top", "side")) == "side" else "top"
    approach, closing = (item.numbers(key, 3) for key in ("approach", "closing"))
    if np.linalg.norm(np.cross(approach, closing)) < 1e-6:
        item.refuse("approach and closing are two directions that differ", "closing")
    T = transform(_frame(approach=approach, closing=closing), item.numbers("at", 3))
    yield _grasp(kind, item.text("name"), T, item, mesh)


def _grasp(kind: Any, name: str, T: Floats, item: Section, mesh: Mesh) -> Grasp:
    back = T.copy()
    back[:3, 3] -= PREGRASP_DISTANCE * T[:3, 0]
    width = item.number("width", low=0) if "width" in item.values else width_between(mesh, T)
    return Grasp(name=name, kind=kind, T_object_grasp=T, T_object_pregrasp=back, width=width)


def _angles(item: Section, key: str) -> list[float]:
    """Degrees: a list, or a number of directions spread evenly."""
    if isinstance(item.value(key), list):
        return item.numbers(key).tolist()
    count = item.integer(key, low=1)
    return [round(360.0 * index / count, 6) for index in range(count)]


def _heading(degrees: float) -> Floats:
    """Horizontal unit vector."""
    # Rounded so that right angles give exact zeros.
    return np.round([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees)), 0.0], 12)


def _frame(*, approach: Floats, closing: Floats) -> Floats:
    """3 x 3 with x the approach and y the closing direction (made perpendicular to it)."""
    x = approach / np.linalg.norm(approach)
    y = closing - (closing @ x) * x
    y = y / np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])
