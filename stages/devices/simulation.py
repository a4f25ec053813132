"""The simulated world: a robot at a table with catalogue objects, in MuJoCo."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from stages.devices.servo import Servo
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.planning.motion.collision import add_floor, add_primitives, add_table, quaternion
from stages.robots import Robot, Table
from stages.scene.catalogue import Catalogue, CatalogueObject
from stages.scene.scoring import label_of

_TIMESTEP = 0.002
_SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
_ROLLING = 5e-4
"""Metres by which the load of what rolls is ahead of its axis: a can that rolls at 8 cm/s stops after 4 cm."""
_WITH_TORSION, _WITH_ROLLING = 4, 6
"""Dimensions of contact in which there is friction, one more for the normal."""
_DROP = 0.002
"""Metres above their support at which objects are laid out."""
_AWAY = (-3.0, 0.5)
"""Where on the floor behind the robot what no one has laid out is put, and how far apart; metres."""


@dataclass(frozen=True)
class Factors:
    """How an object differs from what the catalogue says of it."""

    mass: float = 1.0
    friction: float = 1.0


class Simulation:
    """Physics of one robot and objects of the catalogue (``cup``, ``cup_2``, ...); all poses in the robot base frame.

    Objects are held by friction alone: elliptic friction cones, torsional friction at the finger pads and fingers
    coupled as on the real gripper keep what is held from creeping.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        robot: Robot,
        names: tuple[str, ...],
        table: Table,
        *,
        factors: Mapping[str, Factors] = MappingProxyType({}),
    ) -> None:
        """``factors``: of objects that are not as the catalogue has them."""
        self._robot, self._names, self.present = robot, names, names
        self._model = scene_model(catalogue, robot, names, table, factors=factors)
        self._data = mujoco.MjData(self._model)
        self.servo = Servo(robot, self._model, self._data, self._step)
        self._joints = np.array([self._model.joint(name).qposadr[0] for name in robot.joint_names])
        self._pads = [self._model.geom(name).id for name in robot.model.pads]
        self._rough = self._model.geom_friction[self._pads].copy()
        self._go_home()

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
        for name in self._names:
            if name not in layout:
                self._put_away(name)
        self.run(settle)

    def place(self, name: str, T_base_object: Floats, *, settle: float = 1.0) -> None:
        """Puts one object down just above a pose (4 x 4), then lets physics settle."""
        self._put(name, T_base_object)
        self.run(settle)

    def _put(self, name: str, T_base_object: Floats) -> None:
        joint = self._data.joint(name)
        joint.qpos[:] = np.concatenate([T_base_object[:3, 3] + [0, 0, _DROP], quaternion(T_base_object[:3, :3])])
        joint.qvel[:] = 0
        self._awake(mujoco.mj_kinematics)

    def _put_away(self, name: str) -> None:
        """Each to a place of its own."""
        place = _AWAY[0], _AWAY[1] * self._names.index(name), self._robot.floor + 0.1
        self._put(name, pose(np.eye(3), np.array(place)))

    def add(self, name: str, T_base_object: Floats) -> None:
        """Puts an object down that may have been out of the way."""
        self.place(name, T_base_object, settle=0.0)
        self.present = tuple(one for one in self._names if one == name or one in self.present)

    def remove(self, name: str) -> None:
        """Puts an object out of the way and out of sight."""
        self._put_away(name)
        self.present = tuple(one for one in self.present if one != name)

    def touching(self, name: str) -> set[str]:
        """Names of the bodies that an object touches: links of the robot, ``table``, other objects."""
        self._awake(mujoco.mj_forward)
        return self._touched(name)

    def _awake(self, compute: Callable[[Any, Any], None]) -> None:
        """Computes for what sleeps, too, which else has no contacts and is where it was."""
        self._model.opt.enableflags &= ~_SLEEP
        compute(self._model, self._data)
        self._model.opt.enableflags |= _SLEEP

    def _touched(self, name: str) -> set[str]:
        """The same, as far as contacts are known."""
        bodies = self._model.geom_bodyid[self._data.contact.geom]
        own = self._model.body(name).id
        pairs = bodies[(bodies == own).any(axis=1)]
        return {self._model.body(body).name for body in pairs.ravel() if body != own}

    def held(self) -> str:
        """The object that both fingers touch and nothing else does; empty where there is none."""
        others = {"table", *self.present}
        mujoco.mj_forward(self._model, self._data)
        touched = {name: self._touched(name) for name in self.present}
        return next((name for name, bodies in touched.items() if len(bodies) > 1 and not bodies & others), "")

    def slide(self, factor: float) -> None:
        """Makes the finger pads as rough as ``factor`` times what they are."""
        self._model.geom_friction[self._pads] = factor * self._rough

    def run(self, seconds: float) -> None:
        """Lets time pass."""
        for _ in range(round(seconds / _TIMESTEP)):
            self._step()

    def _step(self) -> None:
        mujoco.mj_step(self._model, self._data)

    def encoders(self) -> Floats:
        """Positions of the joints that :attr:`stages.robots.Robot.joint_names` names."""
        return self._data.qpos[self._joints].copy()

    def layout(self) -> dict[str, Floats]:
        """T_base_object (4 x 4) by name of every object that is ``present``."""
        return dict(zip(self.present, self.object_poses(), strict=True))

    def hand(self) -> Floats:
        """x, y, z of the hand, metres."""
        return self._data.body(self._robot.gripper.link).xpos.copy()

    def object_poses(self) -> Floats:
        """N x 4 x 4: T_base_object of every object that is ``present``, in that order."""
        bodies = [self._data.body(name) for name in self.present]
        return np.array([pose(body.xmat.reshape(3, 3), body.xpos) for body in bodies]).reshape(-1, 4, 4)

    def _go_home(self) -> None:
        gripper = self._robot.gripper
        for name, position in self._robot.posture.items():
            self._data.joint(name).qpos[0] = position
            self._data.ctrl[self.servo.actuators[name]] = position
        for name, position in gripper.posture(gripper.open_width).items():
            self._data.joint(name).qpos[0] = position
        self._data.ctrl[self.servo.fingers] = self.servo.grip(gripper.open_width)


def scene_model(
    catalogue: Catalogue,
    robot: Robot,
    names: tuple[str, ...],
    table: Table,
    *,
    factors: Mapping[str, Factors] = MappingProxyType({}),
) -> mujoco.MjModel:
    """Robot, floor, table and objects; an object's free joint and body have its name."""
    spec = robot.specification()
    option = spec.option
    option.timestep, option.integrator = _TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    # What stands still and is not touched costs nothing; whatever comes upon it, or moves what it stands on, wakes it.
    option.enableflags |= _SLEEP
    # The sparse Newton factorisation of MuJoCo 4.0.0 is broken.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    add_floor(spec, robot.floor)
    add_table(spec, table)
    for name in names:
        _add_object(spec, name, catalogue[label_of(name, catalogue)], factors.get(name, Factors()))
    return spec.compile()


def _add_object(spec: mujoco.MjSpec, name: str, entry: CatalogueObject, factors: Factors) -> None:
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    geoms = add_primitives(body, entry.collision)
    volumes = [_volume(primitive.kind, primitive.size) for primitive in entry.collision]
    for geom, primitive, volume in zip(geoms, entry.collision, volumes, strict=True):
        geom.mass = factors.mass * entry.mass * volume / sum(volumes)
        geom.friction = [factors.friction * entry.friction, 0.01, _ROLLING]
        geom.condim, geom.solref = _WITH_ROLLING if primitive.kind == "cylinder" else _WITH_TORSION, [0.01, 1]


def _volume(kind: str, size: tuple[float, ...]) -> float:
    return float(np.prod(size)) if kind == "box" else float(np.pi * size[0] ** 2 * size[1])
