"""What the motors of an arm do beyond what a motion takes: a force from outside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from stages.geometry.arrays import Floats
from stages.robots import Robot

FILTER = 0.03
"""Seconds over which efforts are smoothed: servos answer a jump of the acceleration with a delay."""
_SHORTEST_LEVER = 0.2
"""Metres: of joints whose axis passes closer to the hand hardly any force is felt, only friction."""


class Efforts:
    """Torques of J joints by inverse dynamics of the described robot with an empty hand; other joints are at home."""

    def __init__(self, robot: Robot, joints: Sequence[str], *, balanced: bool) -> None:
        """``balanced``: the links that the description balances weigh nothing, as in simulation."""
        spec = robot.specification(seen=False)
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        for body in () if balanced else spec.bodies:
            body.gravcomp = 0.0
        self._model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self._model)
        named = [self._model.joint(name) for name in joints]
        self._addresses, self._dofs = (
            np.array([getattr(one, key)[0] for one in named]) for key in ("qposadr", "dofadr")
        )
        self._turns = np.array([robot.body.turns(name) for name in joints])
        self._hand = self._model.body(robot.gripper.link).id
        for name, position in robot.posture.items():
            self._data.joint(name).qpos[0] = position

    def taken(self, q: Floats, v: Floats, a: Floats) -> Floats:
        """J, newton metres (newtons), of a motion at positions, velocities and accelerations (J)."""
        data = self._data
        data.qpos[self._addresses], data.qvel[self._dofs], data.qacc[self._dofs] = q, v, a
        mujoco.mj_inverse(self._model, data)
        return data.qfrc_inverse[self._dofs].copy()

    def at_hand(self, outside: Floats) -> float:
        """The force of torques from outside (J) in newtons, as if it acted on the hand, where the arm is."""
        return float((np.abs(outside) / levers(self._model, self._data, self._hand, self._dofs))[self._turns].max())


def levers(model: Any, data: Any, body: int, dofs: Any) -> Floats:
    """Metres between a body and the axes of joints."""
    linear = np.zeros((3, model.nv))
    mujoco.mj_jacBody(model, data, linear, None, body)
    moved = linear[:, dofs]
    return np.maximum(np.sqrt((moved * moved).sum(0)), _SHORTEST_LEVER)


class Felt:
    """The force from outside while one command runs, since what the motors did at its start."""

    def __init__(self, efforts: Efforts, q: Floats, measured: Floats) -> None:
        """``measured`` (J) are the efforts of an arm that stands at ``q`` (J)."""
        self._efforts = efforts
        still = np.zeros_like(q)
        self._offset = measured - efforts.taken(q, still, still)
        self._outside = still
        self._time: float | None = None

    def newtons(self, q: Floats, v: Floats, a: Floats, measured: Floats, seconds: float) -> float:
        """Takes what is measured at a time; returns the smoothed force."""
        outside = measured - self._offset - self._efforts.taken(q, v, a)
        passed = 0.0 if self._time is None else max(seconds - self._time, 0.0)
        self._time = seconds
        self._outside = self._outside + (outside - self._outside) * (1 - np.exp(-passed / FILTER))
        return self._efforts.at_hand(self._outside)
