"""From a description to a MuJoCo model: files put together, changed where they must be, joints with servos."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from runner.contract import Refused
from stages.robots.model import Model, Part, Servo

_PACKAGE = "package://"


def specification(model: Model, *, seen: bool = True) -> mujoco.MjSpec:
    """The robot alone; its controllers compensate its own weight.

    Raises:
        Refused: a file is missing or MuJoCo cannot read it.
    """
    spec = assembled(model)
    for body in spec.bodies:
        body.gravcomp = 0.0 if body.name == "world" else 1.0
    for name, servo in model.servos.items():
        joint = _move(spec, name, servo)
        joint.stiffness, joint.ref = _first(joint.stiffness, 0.0), 0
    if model.finger_servo:
        _couple(spec, *model.fingers, model.finger_servo)
    for kind, named in model.changed.items():
        for name, attributes in named.items():
            change(getattr(spec, kind)(name), attributes)
    for name in model.pads:
        _make_grippy(spec.geom(name))
    for first, second in model.touching:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    for geom in spec.geoms:
        geom.margin = 0
    if not seen:
        _leave_out_unfelt(spec)
    return spec


def _leave_out_unfelt(spec: mujoco.MjSpec) -> None:
    for geom in list(spec.geoms):
        if not geom.contype and not geom.conaffinity:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)


def assembled(model: Model) -> mujoco.MjSpec:
    """The parts put together, without what is removed.

    Raises:
        Refused: a file is missing, MuJoCo cannot read it, or parts do not fit together.
    """
    spec, *others = (_read(part) for part in model.parts)
    for part, other in zip(model.parts[1:], others, strict=True):
        # The simulated world sets the options; where parts differ in them MuJoCo would warn.
        other.option = spec.option
        if not part.on:
            spec.attach(other, prefix=part.prefix, frame=spec.worldbody.add_frame())
            continue
        if (site := spec.site(part.on)) is not None:
            spec.attach(other, prefix=part.prefix, site=site)
        elif (link := spec.body(part.on)) is not None:
            spec.attach(other, prefix=part.prefix, frame=link.add_frame())
        else:
            valid = ", ".join(place.name for place in (*spec.sites, *spec.bodies))
            raise Refused(f"{part.file}: no site and no link '{part.on}' to mount it on; valid: {valid}")
    for name in model.removed:
        element = spec.body(name) or spec.joint(name)
        if element is None:
            raise Refused(f"{model.parts[0].file}: no body and no joint '{name}' to remove")
        spec.delete(element)
    return spec


def _read(part: Part) -> mujoco.MjSpec:
    try:
        spec = mujoco.MjSpec.from_string(_text(part)) if part.text else mujoco.MjSpec.from_file(str(part.file))
    except (OSError, ValueError, ElementTree.ParseError) as error:
        raise Refused(f"{part.file}: MuJoCo cannot read the model: {error}") from error
    # Frames that a URDF fixes to others keep their names.
    spec.compiler.fusestatic = False
    for mesh in spec.meshes:
        if mesh.file.startswith(_PACKAGE):
            mesh.file = str(part.packages / mesh.file.removeprefix(_PACKAGE))
    return spec


def _text(part: Part) -> str:
    """The MJCF with what it includes; files are looked for in the part's folder."""
    root = ElementTree.fromstring(part.text)
    for parent in list(root.iter()):
        for element in [child for child in parent if child.tag == "include"]:
            place = list(parent).index(element)
            parent[place : place + 1] = list(ElementTree.parse(part.file / element.attrib["file"]).getroot())
    for compiler in root.iter("compiler"):
        for key in {"meshdir", "texturedir"} & set(compiler.attrib):
            compiler.set(key, str(part.file / compiler.attrib[key]))
    return ElementTree.tostring(root, encoding="unicode").replace(part.without, "")


def change(element: Any, attributes: Mapping[str, Any]) -> None:
    """Sets attributes of a body, joint or geom."""
    for key, value in attributes.items():
        now = getattr(element, key)
        if np.ndim(now):
            now[: np.size(value)] = value
        else:
            setattr(element, key, value)


def _move(spec: mujoco.MjSpec, name: str, servo: Servo) -> Any:
    joint = spec.joint(name)
    joint.damping, joint.armature, joint.frictionloss = _first(joint.damping, servo.damping), servo.armature, 0
    actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=servo.kp, kv=servo.kv)
    actuator.forcelimited, actuator.forcerange = 1, [-servo.effort, servo.effort]
    return joint


def _couple(spec: mujoco.MjSpec, first: str, second: str, servo: Servo) -> None:
    """Two fingers that are driven alike and cannot move apart from each other."""
    for name in (first, second):
        _move(spec, name, servo)
    coupling = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=first, name2=second)
    coupling.data[:5] = [0, 1, 0, 0, 0]
    # The default constraint is so soft that a held object drifts 5 mm sideways.
    coupling.solref, coupling.solimp[:3] = [0.005, 1], [0.99, 0.999, 0.0001]


def _make_grippy(pad: Any) -> None:
    pad.friction, pad.condim, pad.priority = [1.0, 0.02, 0.001], 6, 1
    pad.solref, pad.solimp[:3] = [0.004, 1], [0.95, 0.99, 0.001]


def _first(value: Any, new: float) -> Any:
    """``new`` in the shape of ``value``: MuJoCo versions differ in whether a joint's damping is a polynomial."""
    return [new, 0, 0] if np.ndim(value) else new
