"""Stages that have an arm move, or a camera look, until something is wrong."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from runner.contract import Context, Finished, Stage
from stages.messages import Brake, Frame, LookRequest, RobotCommand, RobotState
from stages.messages.robot import Guard
from stages.robots import read_robot
from tests.stages.devices.ros2.robot import ROBOT

_SECONDS = 4.0


class Commander(Stage):
    """Turns the wrist there and back."""

    device: ClassVar[bool] = True

    def on_start(self) -> RobotCommand:
        """The first turn."""
        return _turn(read_robot(ROBOT).home)

    def on_robot_state(self, robot_state: RobotState) -> RobotCommand | Brake | Finished:
        """The next one; the end where the robot did not do it. Nobody brakes."""
        if robot_state.stopped:
            return Finished(code=0, reason=f"{robot_state.stopped}: {robot_state.reason}")
        return _turn(robot_state.positions[:6])


class Looker(Stage):
    """Asks for one look after the other."""

    device: ClassVar[bool] = True

    def on_start(self) -> LookRequest:
        """The first one."""
        return LookRequest(purpose="look 1")

    def on_frame(self, frame: Frame, ctx: Context) -> LookRequest:
        """The next one."""
        ctx.log(f"has look {frame.index + 1}")
        return LookRequest(purpose=f"look {frame.index + 2}")


def _turn(start: np.ndarray) -> RobotCommand:
    robot = read_robot(ROBOT)
    share = np.linspace(0, 1, 41)[:, None]
    way = np.zeros(6)
    way[-1] = 0.5 - (start - robot.home)[-1]
    positions = start + way * (3 * share**2 - 2 * share**3)
    velocities = way * 6 * (share - share**2) / _SECONDS
    times = _SECONDS * share[:, 0]
    return RobotCommand(
        joint_names=robot.joints, times=times, positions=positions, velocities=velocities, guard=Guard(), label="turn"
    )
