"""The world as planning sees it: the robot among estimated objects, checked for collisions with a clearance."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from stages.geometry.arrays import Floats
from stages.planning.motion.kinematics import Chain
from stages.robots import Robot, Table
from stages.scene.catalogue import CatalogueObject, Primitive

AMPLE = 0.015
"""Metres that motions far from what is grasped and placed keep from everything, where there is room."""

_ROBOT, _NEAR_ROBOT, _NEAR_HELD, _HELD = 1, 2, 4, 8
"""Contact bits: what the robot, what keeps clear of it, what keeps clear of the held object, the held object."""


def add_floor(spec: Any, height: float) -> Any:
    """Adds the floor, at a height in metres, to a MuJoCo specification as body ``floor``; returns its geom."""
    body = spec.worldbody.add_body(name="floor", pos=[0, 0, height])
    return body.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3.0, 3.0, 0.1])


def add_table(spec: Any, table: Table) -> Any:
    """Adds the table to a MuJoCo specification as body ``table``; returns its geom."""
    body = spec.worldbody.add_body(name="table", pos=[*table.center, table.height - table.thickness / 2])
    half = [table.size[0] / 2, table.size[1] / 2, table.thickness / 2]
    return body.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=half)


def add_primitives(body: Any, primitives: tuple[Primitive, ...]) -> list[Any]:
    """Adds collision geometry in the object frame to a MuJoCo body; returns the geoms."""
    return [_add_primitive(body, primitive) for primitive in primitives]


def quaternion(R: Floats) -> Floats:
    """Unit quaternion (w, x, y, z) of a 3 x 3 rotation."""
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(R).ravel())
    return result


class CollisionWorld:
    """One scene: robot, floor, table, objects where they were perceived, and the one object to be carried, if any.

    ``occupied`` are pieces in the base frame that nobody has named yet.

    The hand frame is the catalogue's grasp frame: x is the approach direction, y the closing direction, the origin
    lies between the fingertips. ``clearance`` (metres, at most :data:`AMPLE`) is kept from everything except what
    :meth:`touching` and :meth:`resting` allow.
    """

    def __init__(
        self,
        robot: Robot,
        table: Table,
        objects: Mapping[str, tuple[CatalogueObject, Floats]],
        *,
        carried: str = "",
        occupied: tuple[Primitive, ...] = (),
        clearance: float = 0.005,
    ) -> None:
        self.robot, self.carried, self.clearance, self.checks = robot, carried, clearance, 0
        self.objects = {name: entry for name, (entry, _) in objects.items()}
        self._model = self._compile(table, objects, occupied)
        self._data = mujoco.MjData(self._model)
        self._index_robot()
        self._geoms = {name: self._geoms_of(name) for name in ("floor", "table", "occupied", *objects)}
        self._held_geoms = self._geoms_of("held")
        self._obstacles = [geom for geoms in self._geoms.values() for geom in geoms]
        self._model.geom_margin[self._obstacles] = clearance
        self.set_width(robot.gripper.open_width)

    def set_width(self, width: float) -> None:
        """Opens the fingers to ``width`` metres for all checks that follow."""
        self._data.qpos[self._fingers] = list(self.robot.gripper.posture(width).values())

    def hand(self, q: Floats) -> Floats:
        """Forward kinematics: T_base_hand (4 x 4) at joint positions ``q`` (J)."""
        return self.chain.hand(q)

    def is_free(self, q: Floats) -> bool:
        """True where joint positions ``q`` (J) keep the clearance."""
        self.checks += 1
        self._data.qpos[self._q] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        return self._data.ncon == 0

    def depth(self, q: Floats) -> float:
        """Metres by which joint positions ``q`` (J) fall short of the clearance where they do most, else 0."""
        self.is_free(q)
        contacts = self._data.contact[: self._data.ncon]
        return max((float(contact.includemargin - contact.dist) for contact in contacts), default=0.0)

    def contacts(self, q: Floats) -> set[tuple[str, str]]:
        """Pairs of bodies, each in alphabetical order, that are too close at ``q``, for messages to people."""
        self.is_free(q)
        found: set[tuple[str, str]] = set()
        for contact in self._data.contact[: self._data.ncon]:
            bodies = self._model.geom_bodyid[[contact.geom1, contact.geom2]]
            first, second = sorted(self._model.body(body).name for body in bodies)
            found.add((first, second))
        return found

    @contextmanager
    def ample(self) -> Generator[None, None, None]:
        """While it lasts, the clearance is :data:`AMPLE`."""
        before = self._model.geom_margin[self._obstacles].copy()
        self._model.geom_margin[self._obstacles] = AMPLE
        try:
            yield
        finally:
            self._model.geom_margin[self._obstacles] = before

    @contextmanager
    def touching(self, name: str) -> Generator[None, None, None]:
        """While it lasts, robot and held object may touch ``name``."""
        with self._without(self._geoms[name], _NEAR_ROBOT | _NEAR_HELD):
            yield

    @contextmanager
    def resting(self, *names: str) -> Generator[None, None, None]:
        """While it lasts, the held object, not the robot, may touch ``names``."""
        with self._without([g for name in names for g in self._geoms[name]], _NEAR_HELD):
            yield

    @contextmanager
    def holding(self, T_hand_object: Floats, width: float) -> Generator[None, None, None]:
        """While it lasts, the carried object is in the hand and no longer where it was perceived."""
        body = self._model.body("held").id
        self._model.body_pos[body], self._model.body_quat[body] = (
            T_hand_object[:3, 3],
            quaternion(T_hand_object[:3, :3]),
        )
        self._set_held(_HELD, _NEAR_HELD)
        self.set_width(width)
        try:
            with self.touching(self.carried):
                yield
        finally:
            self._set_held(0, 0)
            self.set_width(self.robot.gripper.open_width)

    def touched(self, q: Floats) -> set[str]:
        """What is not of the robot and too close to the held object at joint positions ``q`` (J)."""
        near = {name for pair in self.contacts(q) if "held" in pair for name in pair}
        return near & self._geoms.keys()

    def move(self, T_base_object: Floats) -> None:
        """Says that the carried object now stands at ``T_base_object``."""
        mocap = self._model.body_mocapid[self._model.body(self.carried).id]
        self._data.mocap_pos[mocap] = T_base_object[:3, 3]
        self._data.mocap_quat[mocap] = quaternion(T_base_object[:3, :3])

    def _set_held(self, contype: int, conaffinity: int) -> None:
        body = self._model.body("held").id
        self._model.geom_contype[self._held_geoms], self._model.geom_conaffinity[self._held_geoms] = (
            contype,
            conaffinity,
        )
        # MuJoCo's broad phase reads the bits of whole bodies.
        self._model.body_contype[body], self._model.body_conaffinity[body] = contype, conaffinity

    @contextmanager
    def _without(self, geoms: list[int], bits: int) -> Generator[None, None, None]:
        before = self._model.geom_contype[geoms].copy()
        self._model.geom_contype[geoms] = before & ~bits
        try:
            yield
        finally:
            self._model.geom_contype[geoms] = before

    def _compile(
        self,
        table: Table,
        objects: Mapping[str, tuple[CatalogueObject, Floats]],
        occupied: tuple[Primitive, ...],
    ) -> Any:
        spec = self.robot.specification(seen=False)
        hand = spec.body(self.robot.hand)
        links = {hand.name, *(body.name for body in hand.find_all(mujoco.mjtObj.mjOBJ_BODY))}
        for geom in spec.geoms:
            near_hand = 0 if geom.parent.name in links else _HELD
            geom.contype, geom.conaffinity = _ROBOT, _ROBOT | _NEAR_ROBOT | near_hand
        obstacles = [add_floor(spec, self.robot.floor), add_table(spec, table)]
        obstacles += add_primitives(spec.worldbody.add_body(name="occupied"), occupied)
        for name, (entry, T) in objects.items():
            body = spec.worldbody.add_body(name=name, mocap=True, pos=T[:3, 3], quat=quaternion(T[:3, :3]))
            obstacles += add_primitives(body, entry.collision)
        for geom in obstacles:
            geom.contype, geom.conaffinity, geom.margin = _NEAR_ROBOT | _NEAR_HELD, 0, AMPLE
        gripper = self.robot.gripper
        T_link_hand = gripper.T_link_hand
        hand = spec.body(gripper.link).add_body(
            name="hand frame", pos=T_link_hand[:3, 3], quat=quaternion(T_link_hand[:3, :3])
        )
        held = objects[self.carried][0].collision if self.carried else ()
        for geom in add_primitives(hand.add_body(name="held"), held):
            geom.contype, geom.conaffinity, geom.mass = 0, 0, 1e-6
        return spec.compile()

    def _index_robot(self) -> None:
        model, joints = self._model, [self._model.joint(name) for name in self.robot.joints]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self._fingers = np.array([model.joint(name).qposadr[0] for name in self.robot.gripper.posture(0.0)])
        # A joint without limits turns freely; half a turn either way reaches every angle.
        limits = [model.jnt_range[j.id] if model.jnt_limited[j.id] else (-np.pi, np.pi) for j in joints]
        self.lower, self.upper = np.array(limits).T
        self.chain = Chain.of(model, self.robot.joints, "hand frame", self.robot.still, (self.lower, self.upper))
        for name, position in self.robot.still.items():
            self._data.joint(name).qpos[0] = position

    def _geoms_of(self, body: str) -> list[int]:
        return [int(geom) for geom in np.flatnonzero(self._model.geom_bodyid == self._model.body(body).id)]


def _add_primitive(body: Any, primitive: Primitive) -> Any:
    T = primitive.T_object_primitive
    placed: dict[str, Any] = {"pos": T[:3, 3], "quat": quaternion(T[:3, :3])}
    if primitive.kind == "box":
        return body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=np.array(primitive.size) / 2, **placed)
    radius, height = primitive.size
    return body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[radius, height / 2, 0], **placed)
