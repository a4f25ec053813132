"""The simulated world: a robot at a table with catalogue objects, in MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.planning.collision import add_primitives, add_table, quaternion
from stages.robots import Robot, Table
from stages.scene.catalogue import Catalogue, CatalogueObject
from stages.scene.scoring import label_of

_TIMESTEP = 0.002
_SETTLE_AFTER_MOTION = 0.25
_GRIPPER_RAMP = 0.6
"""Seconds over which a new gripper opening is commanded."""
_GRIPPER_HOLD = 0.3
"""Seconds for the fingers to stall or arrive."""
_DROP = 0.002
"""Metres above their support at which objects are laid out."""
_AWAY = (-3.0, 0.5)
"""Where on the floor behind the robot what no one has laid out is put, and how far apart; metres."""


class Simulation:
    """Physics of one robot and objects of the catalogue (``cup``, ``cup_2``, ...); all poses in the robot base frame.

    Objects are held by friction alone: elliptic friction cones, torsional friction at the finger pads and fingers
    coupled as on the real gripper keep what is held from creeping.
    """

    def __init__(self, catalogue: Catalogue, robot: Robot, names: tuple[str, ...], table: Table) -> None:
        self._robot, self._names, self.present = robot, names, names
        spec = robot.specification()
        option = spec.option
        option.timestep, option.integrator = _TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
        # The sparse Newton factorisation of MuJoCo 4.0.0 is broken.
        option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3.0, 3.0, 0.1])
        floor.pos = [0, 0, robot.floor]
        add_table(spec, table)
        for name in names:
            _add_object(spec, name, catalogue[label_of(name, catalogue)])
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._index()

    @property
    def time(self) -> float:
        """Simulated seconds."""
        return float(self._data.time)

    def arrange(self, layout: Mapping[str, Floats], *, settle: float = 1.5) -> None:
        """Puts the robot at home and the objects at ``layout`` (T_base_object, 4 x 4), then lets physics settle.

        Objects that the layout does not have are not ``present``: they are out of the way and out of sight.
        """
        now = self._data.time
        mujoco.mj_resetData(self._model, self._data)
        self._data.time = now
        self._go_home()
        for name, T in layout.items():
            self._put(name, T)
        self.present = tuple(name for name in self._names if name in layout)
        for k, name in enumerate(name for name in self._names if name not in layout):
            self._data.joint(name).qpos[:3] = _AWAY[0], _AWAY[1] * k, self._robot.floor + 0.1
        self.run(settle)

    def place(self, name: str, T_base_object: Floats, *, settle: float = 1.0) -> None:
        """Puts one object down just above a pose (4 x 4), then lets physics settle."""
        self._put(name, T_base_object)
        self.run(settle)

    def _put(self, name: str, T_base_object: Floats) -> None:
        joint = self._data.joint(name)
        joint.qpos[:] = np.concatenate([T_base_object[:3, 3] + [0, 0, _DROP], quaternion(T_base_object[:3, :3])])
        joint.qvel[:] = 0

    def run(self, seconds: float) -> None:
        """Lets time pass."""
        for _ in range(round(seconds / _TIMESTEP)):
            mujoco.mj_step(self._model, self._data)

    def follow(self, joint_names: tuple[str, ...], times: Floats, positions: Floats, velocities: Floats) -> float:
        """Follows a joint trajectory (T, T x J, T x J) with velocity feed-forward; returns the largest joint error."""
        actuators = np.array([self._actuators[name] for name in joint_names])
        addresses = np.array([self._model.joint(name).qposadr[0] for name in joint_names])
        lag = -self._model.actuator_biasprm[actuators, 2] / self._model.actuator_gainprm[actuators, 0]
        targets, rates = _resample(times, positions, velocities)
        worst = 0.0
        for target, command in zip(targets, targets + lag * rates, strict=True):
            self._data.ctrl[actuators] = command
            mujoco.mj_step(self._model, self._data)
            worst = max(worst, float(np.abs(self._data.qpos[addresses] - target).max()))
        self._data.ctrl[actuators] = targets[-1]
        self.run(_SETTLE_AFTER_MOTION)
        return worst

    def move_gripper(self, width: float) -> None:
        """Drives the fingers towards ``width`` metres apart; they stall with limited force at what is between them."""
        start, end = self._data.ctrl[self._fingers].copy(), self._grip(width)
        steps = round(_GRIPPER_RAMP / _TIMESTEP)
        for k in range(1, steps + 1):
            self._data.ctrl[self._fingers] = start + (end - start) * k / steps
            mujoco.mj_step(self._model, self._data)
        self.run(_GRIPPER_HOLD)

    def encoders(self) -> Floats:
        """Positions of the joints that :attr:`stages.robots.Robot.joint_names` names."""
        return self._data.qpos[self._joints].copy()

    def gripper_width(self) -> float:
        """Metres between the fingers."""
        gripper = self._robot.gripper
        return sum(gripper.width(float(self._data.joint(name).qpos[0])) for name in gripper.fingers) / 2

    def object_poses(self) -> Floats:
        """N x 4 x 4: T_base_object of every object that is ``present``, in that order."""
        bodies = [self._data.body(name) for name in self.present]
        return np.array([pose(body.xmat.reshape(3, 3), body.xpos) for body in bodies])

    def _go_home(self) -> None:
        gripper = self._robot.gripper
        for name, position in self._robot.posture.items():
            self._data.joint(name).qpos[0] = position
            self._data.ctrl[self._actuators[name]] = position
        for name, position in gripper.posture(gripper.open_width).items():
            self._data.joint(name).qpos[0] = position
        self._data.ctrl[self._fingers] = self._grip(gripper.open_width)

    def _grip(self, width: float) -> Floats:
        """What is commanded to the actuators of the fingers; their own range need not be that of the joints."""
        gain, bias = self._model.actuator_gainprm[self._fingers, 0], self._model.actuator_biasprm[self._fingers, 1]
        return self._robot.gripper.finger_position(width) * (-bias / gain)

    def _index(self) -> None:
        model, joint = self._model, mujoco.mjtTrn.mjTRN_JOINT
        self._joints = np.array([model.joint(name).qposadr[0] for name in self._robot.joint_names])
        moved = {
            k: model.joint(model.actuator_trnid[k, 0]).name
            for k in range(model.nu)
            if model.actuator_trntype[k] == joint
        }
        self._actuators = {name: k for k, name in moved.items()}
        self._fingers = np.array([k for k in range(model.nu) if moved.get(k) not in self._robot.posture])


def _add_object(spec: mujoco.MjSpec, name: str, entry: CatalogueObject) -> None:
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    geoms = add_primitives(body, entry.collision)
    volumes = [_volume(primitive.kind, primitive.size) for primitive in entry.collision]
    for geom, volume in zip(geoms, volumes, strict=True):
        geom.mass = entry.mass * volume / sum(volumes)
        geom.friction, geom.condim, geom.solref = [entry.friction, 0.01, 0.001], 4, [0.01, 1]


def _volume(kind: str, size: tuple[float, ...]) -> float:
    return float(np.prod(size)) if kind == "box" else float(np.pi * size[0] ** 2 * size[1])


def _resample(times: Floats, positions: Floats, velocities: Floats) -> tuple[Floats, Floats]:
    """The trajectory at every time step of the simulation."""
    if len(times) < 2:
        return positions, velocities
    spline = CubicHermiteSpline(times, positions, velocities)
    steps = np.minimum(np.arange(1, round(times[-1] / _TIMESTEP) + 1) * _TIMESTEP, times[-1])
    return spline(steps), spline(steps, 1)
