"""The Fetch robot: its MuJoCo model, joints, gripper, home posture and head camera.

The meshes and kinematics come from the installed ``gymnasium-robotics`` package and are edited in memory: its
mocap weld (which drags the hand about) and sliding base are removed, and joints get actuators with the effort
limits of Fetch's URDF. The base frame (``base_link`` on the floor) is the world frame.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.planning.robot import Gripper, RobotModel
from stages.scene.catalogue import Mesh


@dataclass(frozen=True)
class Joint:
    """Limits and servo gains of one joint (URDF effort and velocity; armature includes the gear train)."""

    effort: float
    velocity: float
    acceleration: float
    kp: float
    kv: float
    armature: float


ARM_JOINTS: dict[str, Joint] = {
    # The torso's servo carries the weight of the whole upper body.
    "torso_lift_joint": Joint(1500.0, 0.10, 0.50, 40000.0, 4000.0, 5.0),
    "shoulder_pan_joint": Joint(33.8, 1.256, 1.5, 1500.0, 120.0, 0.3),
    "shoulder_lift_joint": Joint(131.8, 1.0, 1.0, 3000.0, 240.0, 0.3),
    "upperarm_roll_joint": Joint(76.9, 1.57, 1.5, 1500.0, 120.0, 0.3),
    "elbow_flex_joint": Joint(66.2, 1.5, 1.5, 1500.0, 120.0, 0.3),
    "forearm_roll_joint": Joint(29.4, 1.57, 1.5, 800.0, 60.0, 0.1),
    "wrist_flex_joint": Joint(25.7, 2.26, 2.5, 800.0, 60.0, 0.1),
    "wrist_roll_joint": Joint(7.36, 2.26, 2.5, 300.0, 20.0, 0.05),
}
HEAD_JOINTS: dict[str, Joint] = {
    "head_pan_joint": Joint(3.2, 1.57, 1.5, 60.0, 6.0, 0.05),
    "head_tilt_joint": Joint(6.8, 1.57, 1.5, 60.0, 6.0, 0.05),
}
FINGER_JOINTS = ("r_gripper_finger_joint", "l_gripper_finger_joint")
JOINT_NAMES = (*ARM_JOINTS, *HEAD_JOINTS, *FINGER_JOINTS)

GRIPPER = Gripper(
    link="gripper_link", joints=FINGER_JOINTS, open_width=0.1018, closed_width=0.0018, force=60.0, reach=0.0385
)

SHOULDER = (0.033, 0.0)
"""Where the shoulder-pan axis stands in the base frame, metres."""
CAMERA_FOCAL, CAMERA_SIZE = 540.0, (640, 480)
"""Of the head camera, pixels: 61 degrees across, as Fetch's PrimeSense Carmine."""

HOME: dict[str, float] = {
    "torso_lift_joint": 0.38,
    "shoulder_pan_joint": -1.2,
    "shoulder_lift_joint": -0.6,
    "upperarm_roll_joint": 0.0,
    "elbow_flex_joint": 1.9,
    "forearm_roll_joint": 0.0,
    "wrist_flex_joint": 0.8,
    "wrist_roll_joint": 0.0,
    "head_pan_joint": 0.0,
    "head_tilt_joint": 1.0,
}
"""Arm folded beside the table, outside the head camera's view; head looking at the table."""

_CAMERA_LINK = "head_camera_rgb_optical_frame"
_TORSO_RANGE = (0.0, 0.38615)
_NEVER_TOUCH = (
    ("base_link", "torso_fixed_link"),
    ("base_link", "torso_lift_link"),
    ("base_link", "estop_link"),
    ("base_link", "laser_link"),
    ("torso_fixed_link", "estop_link"),
    ("torso_fixed_link", "shoulder_pan_link"),
    ("torso_fixed_link", "laser_link"),
    ("torso_lift_link", "head_tilt_link"),
    ("torso_lift_link", "shoulder_lift_link"),
    ("head_pan_link", "shoulder_pan_link"),
    ("shoulder_pan_link", "upperarm_roll_link"),
    ("shoulder_lift_link", "elbow_flex_link"),
    ("upperarm_roll_link", "forearm_roll_link"),
    ("elbow_flex_link", "wrist_flex_link"),
    ("forearm_roll_link", "wrist_roll_link"),
    ("wrist_flex_link", "gripper_link"),
    ("wrist_roll_link", "r_gripper_finger_link"),
    ("wrist_roll_link", "l_gripper_finger_link"),
    ("gripper_link", "r_gripper_finger_link"),
    ("gripper_link", "l_gripper_finger_link"),
)
"""Pairs of links whose collision meshes overlap in every posture."""


def specification() -> mujoco.MjSpec:
    """The robot alone, with actuators named like their joints.

    Raises:
        Refused: ``gymnasium-robotics`` is not installed.
    """
    spec = mujoco.MjSpec.from_string(_description())
    _free_from_mocap(spec)
    for name, joint in {**ARM_JOINTS, **HEAD_JOINTS}.items():
        _actuate(spec, name, joint)
    _build_gripper(spec)
    for first, second in _NEVER_TOUCH:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    for geom in spec.geoms:
        geom.margin = 0
    return spec


def robot_model() -> RobotModel:
    """What motion planning has to know of the robot."""
    return RobotModel(
        specification=specification,
        joints=tuple(ARM_JOINTS),
        velocity=np.array([joint.velocity for joint in ARM_JOINTS.values()]),
        acceleration=np.array([joint.acceleration for joint in ARM_JOINTS.values()]),
        home=np.array([HOME[name] for name in ARM_JOINTS]),
        head={name: HOME[name] for name in HEAD_JOINTS},
        gripper=GRIPPER,
    )


def link_poses(joint_names: Sequence[str], positions: Floats) -> dict[str, Floats]:
    """Forward kinematics: T_base_link (4 x 4) of every link; joints that are not named stay at zero."""
    model, data = _kinematics()
    data.qpos[:] = model.qpos0
    for name, position in zip(joint_names, positions, strict=True):
        data.joint(name).qpos[0] = position
    mujoco.mj_kinematics(model, data)
    return {model.body(i).name: pose(data.xmat[i].reshape(3, 3), data.xpos[i]) for i in range(1, model.nbody)}


def camera_pose(joint_names: Sequence[str], positions: Floats) -> Floats:
    """T_base_camera (4 x 4) of the head camera's optical frame (x right, y down, z forward)."""
    return link_poses(joint_names, positions)[_CAMERA_LINK]


@lru_cache(maxsize=1)
def robot_meshes() -> tuple[tuple[str, Mesh], ...]:
    """(link, mesh in the link's frame) for every link that has a shape."""
    model, _ = _kinematics()
    return tuple((model.body(model.geom_bodyid[i]).name, _geom_mesh(model, i)) for i in range(model.ngeom))


def _description() -> str:
    """MJCF of the robot without the name prefix that the package uses."""
    package = importlib.util.find_spec("gymnasium_robotics")
    if package is None or not package.submodule_search_locations:
        raise Refused("the robot's meshes are missing: install the Python package gymnasium-robotics")
    assets = Path(package.submodule_search_locations[0]) / "envs" / "assets"
    root = ElementTree.Element("mujoco", model="fetch")
    compiler = {"angle": "radian", "autolimits": "true"}
    directories = {"meshdir": str(assets / "stls" / "fetch"), "texturedir": str(assets / "textures")}
    ElementTree.SubElement(root, "compiler", compiler | directories)
    root.extend(ElementTree.parse(assets / "fetch" / "shared.xml").getroot())
    ElementTree.SubElement(root, "worldbody").extend(ElementTree.parse(assets / "fetch" / "robot.xml").getroot())
    return ElementTree.tostring(root, encoding="unicode").replace("robot0:", "")


def _free_from_mocap(spec: mujoco.MjSpec) -> None:
    for weld in list(spec.equalities):
        spec.delete(weld)
    spec.delete(spec.body("mocap"))
    for name in ("slide0", "slide1", "slide2"):
        spec.delete(spec.joint(name))
    spec.body("base_link").pos = [0, 0, 0]
    for body in spec.bodies:
        # Fetch's controllers compensate the arm's own weight.
        body.gravcomp = 0.0 if body.name == "world" else 1.0


def _actuate(spec: mujoco.MjSpec, name: str, joint: Joint) -> None:
    target = spec.joint(name)
    target.damping, target.stiffness = _first(target.damping, 0.0), _first(target.stiffness, 0.0)
    target.armature, target.frictionloss, target.ref = joint.armature, 0, 0
    if name == "torso_lift_joint":
        target.range = _TORSO_RANGE
    _add_servo(spec, name, joint.kp, joint.kv, joint.effort)


def _add_servo(spec: mujoco.MjSpec, name: str, kp: float, kv: float, effort: float) -> None:
    actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=kp, kv=kv)
    actuator.forcelimited, actuator.forcerange = 1, [-effort, effort]


def _build_gripper(spec: mujoco.MjSpec) -> None:
    for name in FINGER_JOINTS:
        joint = spec.joint(name)
        joint.damping, joint.armature, joint.frictionloss = _first(joint.damping, 5.0), 0.5, 0
        joint.solref_limit = [0.01, 1]
        finger = joint.parent
        finger.mass, finger.inertia = 0.0798, [2e-4, 2e-4, 2e-4]
        _make_grippy(finger.geoms[0])
        _add_servo(spec, name, kp=2000, kv=200, effort=GRIPPER.force)
    coupling = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=FINGER_JOINTS[0], name2=FINGER_JOINTS[1])
    coupling.data[:5] = [0, 1, 0, 0, 0]
    # The default constraint is so soft that a held object drifts 5 mm sideways.
    coupling.solref, coupling.solimp[:3] = [0.005, 1], [0.99, 0.999, 0.0001]


def _make_grippy(pad: Any) -> None:
    pad.friction, pad.condim, pad.priority = [1.0, 0.02, 0.001], 6, 1
    pad.solref, pad.solimp[:3] = [0.004, 1], [0.95, 0.99, 0.001]


def _first(value: Any, new: float) -> Any:
    """``new`` in the shape of ``value``: MuJoCo versions differ in whether a joint's damping is a polynomial."""
    return [new, 0, 0] if np.ndim(value) else new


@lru_cache(maxsize=1)
def _kinematics() -> tuple[Any, Any]:
    model = specification().compile()
    return model, mujoco.MjData(model)


def _geom_mesh(model: Any, geom: int) -> Mesh:
    """Triangles of a mesh or box geom in its body's frame."""
    vertices, faces = _mesh_arrays(model, geom) if model.geom_dataid[geom] >= 0 else _box_arrays(model.geom_size[geom])
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.geom_quat[geom])
    vertices = vertices @ R.reshape(3, 3).T + model.geom_pos[geom]
    color = np.round(255 * model.geom_rgba[geom, :3]).astype(np.uint8)
    return Mesh(vertices=vertices, faces=faces, colors=np.tile(color, (len(vertices), 1)))


def _mesh_arrays(model: Any, geom: int) -> tuple[Floats, Any]:
    mesh = model.mesh(model.geom_dataid[geom])
    v, f = mesh.vertadr[0], mesh.faceadr[0]
    vertices = model.mesh_vert[v : v + mesh.vertnum[0]].astype(np.float64)
    return vertices, model.mesh_face[f : f + mesh.facenum[0]].astype(np.int32)


def _box_arrays(half: Floats) -> tuple[Floats, Any]:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return corners, np.array(triangles, np.int32)
