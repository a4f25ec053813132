"""Reads descriptions of robots (docs/robots.md) and checks them against the model that they name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.robots.model import Model, Part, Servo
from stages.robots.robot import Camera, Gripper, Robot, Table
from stages.scene.catalogue.sections import Section, is_number, read_section

_KINDS = ("body", "joint", "geom")
_WIDEST_HAND = 0.5
"""Metres: what is more between two fingers is no metres."""


@cache
def read_robot(path: Path) -> Robot:
    """The robot of a YAML file, read once for all stages of this process and of those that are forked from it.

    Raises:
        Refused: naming file, line, key and valid choices.
    """
    root = _whole(path)
    root.only(
        "model", "remove", "change", "touching", "joints", "views", "still", "gripper", "camera", "table", "floor",
        "workspace",
    )  # fmt: skip
    joints, gripper, workspace = root.section("joints"), root.section("gripper"), root.section("workspace")
    workspace.only("x", "y", "shoulder", "reach")
    each = [joints.section(name) for name in joints.values]
    for joint in each:
        joint.only("home", "velocity", "acceleration", "servo")
    robot = Robot(
        model=_model(root),
        joints=tuple(joints.values),
        velocity=np.array([joint.number("velocity", low=0) for joint in each]),
        acceleration=np.array([joint.number("acceleration", low=0) for joint in each]),
        home=np.array([joint.number("home") for joint in each]),
        views=tuple(_view(section, joints) for section in root.sections("views")),
        still={joint.path.split(".")[-1]: joint.number("home") for joint in _still(root)},
        gripper=_gripper(gripper),
        hand=gripper.text("near"),
        camera=_camera(root.section("camera")),
        table=_table(root.section("table")),
        floor=root.number("floor", 0.0),
        x=_range(workspace, "x"),
        y=_range(workspace, "y"),
        shoulder=_pair(workspace, "shoulder"),
        reach=workspace.number("reach", low=0),
    )
    if robot.views and not robot.camera.link:
        root.refuse("the camera is on no link of the robot: no posture gives it another view", "views")
    _check(root, robot)
    return robot


def _whole(path: Path, before: tuple[Path, ...] = ()) -> Section:
    """The file's outermost mapping; keys that it does not have are those of the file that it is ``like``.

    ``before`` are those that are like this one.
    """
    root, chain = read_section(path), (*before, path.resolve())
    if "like" not in root.values:
        return root
    model = _located(root, "like")
    if model.resolve() in chain:
        root.refuse(f"{model} is like itself: {' is like '.join(each.name for each in (*chain, model))}", "like")
    other = _whole(model, chain)
    del root.values["like"]
    return replace(root, values=other.values | root.values, lines=other.lines | root.lines)


# --- The model --------------------------------------------------------------------------------------------------


def _model(root: Section) -> Model:
    parts = tuple(_part(section) for section in root.sections("model"))
    if not parts:
        root.refuse("at least one MJCF or URDF file is needed", "model")
    gripper = root.section("gripper")
    joints = [*(root.section("joints").section(name) for name in root.section("joints").values), *_still(root)]
    return Model(
        parts=parts,
        removed=tuple(root.texts("remove")),
        changed=_changes(root),
        touching=_touching(root),
        servos={joint.path.split(".")[-1]: servo for joint in joints if (servo := _servo(joint))},
        fingers=_fingers(gripper),
        finger_servo=_servo(gripper),
        pads=tuple(gripper.texts("pads")),
    )


def _part(section: Section) -> Part:
    section.only("file", "folder", "mjcf", "without", "on", "prefix", "packages")
    text = section.text("mjcf", "")
    key = "folder" if text else "file"
    return Part(
        file=_located(section, key) if key in section.values or not text else section.file.parent,
        text=text,
        without=section.text("without", ""),
        on=section.text("on", ""),
        prefix=section.text("prefix", ""),
        packages=_located(section, "packages") if "packages" in section.values else section.file.parent,
    )


def _located(section: Section, key: str) -> Path:
    """What lies beside the description or, where nothing is there, in an installed package of that name."""
    name = Path(section.text(key))
    near = section.file.parent / name
    if near.exists():
        return near
    package = find_spec(name.parts[0]) if name.parts and name.parts[0].isidentifier() else None
    places = list(package.submodule_search_locations or ()) if package else []
    if not places:
        section.refuse(f"{near}: no such file, and the Python package '{name.parts[0]}' is not installed", key)
    far = Path(places[0]).joinpath(*name.parts[1:])
    return far if far.exists() else section.refuse(f"neither {near} nor {far} is there", key)


def _changes(root: Section) -> dict[str, dict[str, dict[str, Any]]]:
    if "change" not in root.values:
        return {}
    changes = root.section("change")
    changes.only(*_KINDS)
    kinds = {kind: changes.section(kind) for kind in changes.values}
    return {kind: {name: dict(named.section(name).values) for name in named.values} for kind, named in kinds.items()}


def _touching(root: Section) -> tuple[tuple[str, str], ...]:
    pairs = root.items("touching")
    for pair in pairs:
        if not (isinstance(pair, list) and len(pair) == 2 and all(isinstance(name, str) for name in pair)):
            root.refuse(f"{pair!r} is not a pair of links, [one, other]", "touching")
    return tuple((first, second) for first, second in pairs)


def _view(view: Section, joints: Section) -> Floats:
    """Joint positions (J); those that are not named are as at home."""
    view.only(*joints.values)
    return np.array([view.number(name, joints.section(name).number("home")) for name in joints.values])


def _still(root: Section) -> list[Section]:
    if "still" not in root.values:
        return []
    still = root.section("still")
    joints = [still.section(name) for name in still.values]
    for joint in joints:
        joint.only("home", "servo")
    return joints


def _servo(joint: Section) -> Servo | None:
    if "servo" not in joint.values:
        return None
    servo = joint.section("servo")
    servo.only("kp", "kv", "effort", "armature", "damping")
    return Servo(
        kp=servo.number("kp", low=0),
        kv=servo.number("kv", low=0),
        effort=servo.number("effort", low=0),
        armature=servo.number("armature", 0.0),
        damping=servo.number("damping", 0.0),
    )


# --- What is on it, and where it stands -----------------------------------------------------------------------------


def _gripper(section: Section) -> Gripper:
    section.only(
        "link", "position", "rotation", "near", "fingers", "followers", "widths", "closed_width", "open_width",
        "widest", "pads", "servo",
    )  # fmt: skip
    followers = section.section("followers") if "followers" in section.values else None
    widths = _widths(section)
    closed_width, open_width = section.number("closed_width", 0.0), section.number("open_width", low=0)
    largest, widest = widths[:, 1].max(), section.number("widest", low=0)
    if closed_width >= open_width:
        section.refuse(f"{closed_width:g} m is not below open_width, {open_width:g} m", "closed_width")
    if open_width > largest:
        section.refuse(f"{open_width:g} m is more than the largest of widths, {largest:g} m", "open_width")
    if widest > open_width:
        section.refuse(f"{widest:g} m is more than open_width, {open_width:g} m", "widest")
    return Gripper(
        link=section.text("link"),
        T_link_hand=_mounting(section),
        fingers=_fingers(section),
        followers={name: followers.number(name) for name in followers.values} if followers else {},
        joint_positions=widths[:, 0],
        widths=widths[:, 1],
        closed_width=closed_width,
        open_width=open_width,
        widest=widest,
    )


def _widths(section: Section) -> Floats:
    """N x 2: positions of a finger joint, rising, and metres between the fingers there."""
    table = section.items("widths")
    if len(table) < 2 or not all(
        isinstance(pair, list) and len(pair) == 2 and all(map(is_number, pair)) for pair in table
    ):
        section.refuse(
            f"{table!r}: at least two pairs [position of a finger joint, metres between the fingers] are needed",
            "widths",
        )
    widths = np.array(sorted(table), float)
    steps = np.diff(widths, axis=0)
    if not ((steps[:, 0] > 0).all() and ((steps[:, 1] > 0).all() or (steps[:, 1] < 0).all())):
        section.refuse(f"{widths.tolist()}: with the positions the widths must rise, or fall, at every step", "widths")
    if not widths[:, 1].max() < _WIDEST_HAND:
        section.refuse(
            f"{widths[:, 1].max():g} m between the fingers; metres below {_WIDEST_HAND:g} are valid", "widths"
        )
    return widths


def _fingers(gripper: Section) -> tuple[str, str]:
    fingers = gripper.texts("fingers")
    return (fingers[0], fingers[1]) if len(fingers) == 2 else gripper.refuse("two joints are needed", "fingers")


def _camera(section: Section) -> Camera:
    section.only("link", "position", "rotation", "focal", "size", "calibrated")
    link, mounted = section.text("link", ""), {"position", "rotation"} & set(section.values)
    size = section.numbers("size", 2)
    if (size < 1).any() or (size % 1).any():
        section.refuse(f"{size.tolist()} is not [width, height], whole numbers of pixels from 1", "size")
    width, height = size.astype(int).tolist()
    return Camera(
        link=link,
        T_link_camera=_mounting(section) if mounted or not link else None,
        focal=section.number("focal", low=0),
        size=(width, height),
        calibrated=section.text("calibrated", ""),
    )


def _table(section: Section) -> Table:
    section.only("center", "size", "height")
    return Table(center=_pair(section, "center"), size=_pair(section, "size"), height=section.number("height"))


def _mounting(section: Section) -> Floats:
    """4 x 4 of ``position`` (metres) and ``rotation`` (roll, pitch and yaw in degrees about fixed x, y and z)."""
    turn = section.numbers("rotation", 3, np.zeros(3))
    R = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    return pose(R if turn.any() else np.eye(3), section.numbers("position", 3, np.zeros(3)))


def _pair(section: Section, key: str) -> tuple[float, float]:
    first, second = section.numbers(key, 2).tolist()
    return first, second


def _range(section: Section, key: str) -> tuple[float, float]:
    low, high = _pair(section, key)
    return (low, high) if low < high else section.refuse(f"{[low, high]} is not [lowest, highest]", key)


# --- Checks -----------------------------------------------------------------------------------------------------


def _check(root: Section, robot: Robot) -> None:
    """Refuses names that the model does not have."""
    from stages.robots.assembly import assembled

    spec = assembled(robot.model)
    joints, links = [joint.name for joint in spec.joints], [body.name for body in spec.bodies]
    geoms = [geom.name for geom in spec.geoms]
    gripper = root.section("gripper")
    _known(root.section("joints"), robot.joints, joints)
    if "still" in root.values:
        _known(root.section("still"), robot.still, joints)
    _known(gripper, robot.gripper.fingers, joints, "fingers")
    _known(gripper, robot.gripper.followers, joints, "followers")
    _known(gripper, (robot.gripper.link,), links, "link")
    _known(gripper, (robot.hand,), links, "near")
    _known(gripper, robot.model.pads, geoms, "pads")
    way = [name for name in _joints_to(spec.body(robot.gripper.link)) if name not in robot.posture]
    if way:
        root.refuse(f"{', '.join(way)} on the way to the hand: name each here or under still", "joints")
    if robot.camera.link:
        _known(root.section("camera"), (robot.camera.link,), links, "link")
    _known(root, (name for pair in robot.model.touching for name in pair), links, "touching")
    driven = {actuator.target for actuator in spec.actuators} | set(robot.model.servos)
    for name in robot.posture.keys() - driven:
        root.refuse(f"the model has no actuator for '{name}'; give it a servo", "joints")
    if not robot.model.finger_servo and not driven - set(robot.posture):
        gripper.refuse("the model has no actuator for the fingers; give them a servo")
    for kind, valid in zip(_KINDS, (links, joints, geoms), strict=True):
        _known(root, robot.model.changed.get(kind, ()), valid, "change")
        for name, attributes in robot.model.changed.get(kind, {}).items():
            _check_changes(root.section("change").section(kind).section(name), getattr(spec, kind)(name), attributes)
    try:
        robot.specification(seen=False).compile()
    except ValueError as error:
        root.refuse(f"MuJoCo cannot build it: {error}", "model")


def _check_changes(section: Section, element: Any, attributes: Mapping[str, Any]) -> None:
    """Refuses what an element of MuJoCo's specification does not take."""
    from stages.robots.assembly import change

    for key, value in attributes.items():
        if not hasattr(element, key):
            valid = (name for name in dir(element) if name[0] != "_" and not callable(getattr(element, name)))
            section.refuse(f"unknown attribute; valid are {', '.join(valid)}", key)
        try:
            change(element, {key: value})
        except (AttributeError, TypeError, ValueError) as error:
            section.refuse(f"{value!r} cannot be set: {str(error).splitlines()[0]}", key)


def _joints_to(body: Any) -> list[str]:
    """The joints between the world and a body of MuJoCo's specification."""
    return [*_joints_to(body.parent), *(joint.name for joint in body.joints)] if body.parent else []


def _known(section: Section, names: Iterable[str], valid: list[str], key: str = "") -> None:
    for name in names:
        if name not in valid:
            section.refuse(f"'{name}' is not in the model, which has {', '.join(filter(None, valid))}", key or name)
