"""The force that an arm feels from what its joint states say of its motors."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from stages.devices.efforts import Efforts, Felt
from stages.robots import Robot, read_robot
from tests.stages.devices.ros2.robot import ROBOT

PUSH = np.array([0.0, 12.0, -16.0])
"""Newtons at the hand: 20 in all."""


@pytest.fixture(scope="module")
def robot() -> Robot:
    return read_robot(ROBOT)


@pytest.fixture(scope="module")
def model(robot: Robot) -> Any:
    """The robot with its whole weight for its motors to carry, as a real one has it."""
    spec = robot.specification(seen=False)
    for body in spec.bodies:
        body.gravcomp = 0.0
    return spec.compile()


def measured(model: Any, robot: Robot, q: np.ndarray, push: np.ndarray) -> np.ndarray:
    """What motors do that hold an arm at ``q`` against a push."""
    data = mujoco.MjData(model)
    for name, position in zip(robot.joints, q, strict=True):
        data.joint(name).qpos[0] = position
    mujoco.mj_forward(model, data)
    linear = np.zeros((3, model.nv))
    mujoco.mj_jacBody(model, data, linear, None, model.body(robot.gripper.link).id)
    dofs = [model.joint(name).dofadr[0] for name in robot.joints]
    return (data.qfrc_bias - linear.T @ push)[dofs]


def test_the_arms_own_weight_is_no_force_and_a_push_is(robot: Robot, model: Any) -> None:
    none, still = np.zeros(3), np.zeros(len(robot.joints))
    elsewhere = robot.home + 0.5
    # Motors never quite do what they say: what they said of the standing arm is taken off.
    offset = np.full(len(robot.joints), 0.7)
    felt = Felt(
        Efforts(robot, robot.joints, balanced=False), robot.home, measured(model, robot, robot.home, none) + offset
    )
    free = [
        felt.newtons(elsewhere, still, still, measured(model, robot, elsewhere, none) + offset, t / 125)
        for t in range(50)
    ]
    pushed = [
        felt.newtons(elsewhere, still, still, measured(model, robot, elsewhere, PUSH) + offset, (50 + t) / 125)
        for t in range(50)
    ]
    assert max(free) < 0.2
    assert 10 < pushed[-1] < 20.5, "a part of it, seen from the axis that it turns most"
    assert pushed[0] < 0.5 * pushed[-1] < pushed[10], "smoothed, and there within a tenth of a second"
