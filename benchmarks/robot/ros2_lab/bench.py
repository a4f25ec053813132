"""The lab's physics in real time: the robot, the table, what stands on it, and the motors' commands."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from stages.devices.simulation import scene_model
from stages.devices.suites import kinds
from stages.devices.suites.suite import Rejected
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.robots import read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue

ROBOT = Path(__file__).parents[3] / "stages" / "robots" / "ur5e.yaml"
_BEHIND = 0.05
"""Seconds that the lab may be behind the clock; what is more passes slower."""
_MOVED = 2e-4
"""Radians or metres, or an entry of a rotation, from which on the camera sees that something has moved."""
_DROP, _DRIFT, _TILT = 0.002, 0.01, 0.995
_AWAY = (-3.0, 0.5)


class Bench:
    """Physics of one seed of the suite ``tray``; ``each`` is called before every step, ``lock`` held."""

    def __init__(self, seed: int) -> None:
        self.robot, catalogue = read_robot(ROBOT), Catalogue.load(BUILT_IN)
        self._seed, self._suite = seed, kinds.suite("tray", catalogue, self.robot, seed)
        self.names, self.table = self._suite.names, self._suite.table
        self.model: Any = scene_model(catalogue, self.robot, self.names, self.table)
        self.data: Any = mujoco.MjData(self.model)
        self.lock = threading.Lock()
        self.each: list[Callable[[], None]] = []
        self.slow = 0.0
        """Seconds of the clock by which the lab's time is behind in all."""
        self.version = 0
        """Counts what the camera sees move."""
        self._present: tuple[str, ...] = ()
        self._seen = np.zeros(0)
        joints = {self.model.joint(i).name: i for i in range(self.model.njnt)}
        self.addresses = np.array([self.model.jnt_qposadr[joints[name]] for name in self.robot.joint_names])
        self._home()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()

    def arrange(self, kind: Any) -> None:
        """Puts the objects where the suite has them; the robot goes on standing where it is."""
        rng = np.random.default_rng([self._seed, int(kind == "start")])
        while True:
            try:
                layout = self._suite.sample(kind, rng)
            except Rejected:
                continue
            with self.lock:
                self._present = tuple(layout)
                self._lay_out(layout)
            time.sleep(2.0)
            found = self.truth()
            if all(_stands(found[name], T) for name, T in layout.items()):
                return

    def truth(self) -> dict[str, Floats]:
        """T_base_object (4 x 4) by name of what is laid out."""
        with self.lock:
            return {name: self.pose(name) for name in self._present}

    def picture(self) -> tuple[int, int, Floats, dict[str, Floats]]:
        """What the camera sees: version, time in ns, positions of the robot's joints, poses of objects."""
        with self.lock:
            poses = {name: self.pose(name) for name in self._present}
            return self.version, time.time_ns(), self.data.qpos[self.addresses].copy(), poses

    def _run(self) -> None:
        step, began = self.model.opt.timestep, time.monotonic()
        passed = 0.0
        while not self._stopping.is_set():
            behind = time.monotonic() - began - passed
            if behind < step:
                time.sleep(step)
                continue
            if behind > _BEHIND:
                began += behind - _BEHIND
                self.slow += behind - _BEHIND
            with self.lock:
                for each in self.each:
                    each()
                mujoco.mj_step(self.model, self.data)
                passed += step
                self._notice()

    def _notice(self) -> None:
        seen = np.concatenate([self.data.qpos, [len(self._present)]])
        if len(seen) != len(self._seen) or np.abs(seen - self._seen).max() > _MOVED:
            self._seen = seen
            self.version += 1

    def _home(self) -> None:
        gripper = self.robot.gripper
        for name, position in (self.robot.posture | gripper.posture(gripper.open_width)).items():
            self.data.joint(name).qpos[0] = position
        self._lay_out({})

    def _lay_out(self, layout: Mapping[str, Floats]) -> None:
        """Puts objects where they are to stand (T_base_object by name), the others away."""
        for index, name in enumerate(self.names):
            away = np.array([_AWAY[0], _AWAY[1] * index, self.robot.floor + 0.1])
            self._put(name, layout.get(name, pose(np.eye(3), away)))

    def _put(self, name: str, T: Floats) -> None:
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(T[:3, :3]).ravel())
        joint = self.data.joint(name)
        joint.qpos[:] = np.concatenate([T[:3, 3] + [0, 0, _DROP], quaternion])
        joint.qvel[:] = 0

    def pose(self, name: str) -> Floats:
        """T_base_body, 4 x 4; with the lock held."""
        body, T = self.data.body(name), np.eye(4)
        T[:3, :3], T[:3, 3] = body.xmat.reshape(3, 3), body.xpos
        return T


def _stands(found: Floats, T: Floats) -> bool:
    near = np.linalg.norm(found[:3, 3] - T[:3, 3]) < _DRIFT
    return bool(near and found[:3, 2] @ T[:3, 2] > _TILT)
