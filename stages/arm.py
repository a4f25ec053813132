"""Robot commands in, robot states out: an arm and a gripper behind ROS 2 controllers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from runner.contract import Context, Stage
from stages.devices.ros2.settings import Care, Controllers, Link
from stages.messages import Brake, RobotCommand, RobotState, Ros2Heard, Ros2Message, Ros2Sent
from stages.messages.robot import Stopped
from stages.robots import BUILT_IN, read_robot

_BATCH = 16
"""What is heard is told so many messages at a time."""
Said = RobotState | Ros2Sent | Ros2Heard


class Ros2Arm(Stage):
    """Has commands carried out by controllers that ROS 2 nodes offer, and breaks them off where a guard does not hold.

    Nothing moves but with the operator's word: the arm is armed, and the camera is calibrated to it. Without it
    motions are only shown, as ghosts: all of them since somebody last read the encoders.
    """

    device: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """The robot, where its controllers are, and how carefully it moves."""

        robot: Path = BUILT_IN
        link: Link = field(default_factory=lambda: Link(node="scene_arm"))
        controllers: Controllers = field(default_factory=Controllers)
        care: Care = field(default_factory=Care)
        armed: bool = False
        """The operator's word that the robot may move: its workspace is free and somebody stands at the stop button."""
        calibrated: bool | None = False
        """The operator's word that the transforms say where the camera is, by a calibration. None where motions do not
        depend on it, as those that calibrate it."""

    def __init__(self, config: Config) -> None:
        from stages.devices.ros2.acting.arm import RemoteArm

        self._config = config
        self._robot = read_robot(config.robot)
        self._arm = RemoteArm(config.link, self._robot, config.controllers, config.care)
        self._why = self._withheld()

    def on_robot_command(self, robot_command: RobotCommand, ctx: Context) -> Iterator[Said | None]:
        """Carries a command out; what else arrives is heard in between, so that somebody may stop the arm."""
        arm, moves = self._arm, len(robot_command.times) or robot_command.gripper_width is not None
        if moves and self._why:
            yield from self._show(robot_command)
            return
        for _ in arm.carry_out(robot_command, lambda: ctx.rng.bytes(16)):
            yield from self._told(ctx, at_least=_BATCH)
            yield None
        yield from self._told(ctx, at_least=1)
        yield self._state(arm.stopped, arm.reason or self._why)

    def on_brake(self, brake: Brake) -> None:
        """Stops the arm where it is."""
        self._arm.brake()

    def close(self) -> None:
        """Leaves the ROS graph."""
        self._arm.close()

    def _withheld(self) -> str:
        """Why nothing may move; empty where it may."""
        config = self._config
        lacking = [name for name in ("armed", "calibrated") if getattr(config, name) is False]
        return f"nothing moves, only shown: set arm.{'=true and arm.'.join(lacking)}=true" if lacking else ""

    def _show(self, command: RobotCommand) -> Iterator[Said]:
        """The motion as a ghost. The encoders stay as they are; once the hand would close, there is no more to show."""
        if len(command.times) and not self._arm.trouble():
            self._arm.show(command)
            yield Ros2Sent(messages=self._take(self._arm.sent))
        closes = command.gripper_width is not None and command.gripper_width < self._robot.gripper.open_width / 2
        yield self._state("fault" if closes else "", self._why)

    def _told(self, ctx: Context, *, at_least: int) -> Iterator[Said]:
        """What was sent since the last time, and what was heard, where it is so many messages."""
        while self._arm.said:
            ctx.log(self._arm.said.popleft(), level="warning")
        if self._arm.sent:
            yield Ros2Sent(messages=self._take(self._arm.sent))
        if len(self._arm.heard) >= at_least:
            yield Ros2Heard(messages=self._take(self._arm.heard))

    @staticmethod
    def _take(messages: list[Ros2Message]) -> tuple[Ros2Message, ...]:
        taken = tuple(messages)
        messages.clear()
        return taken

    def _state(self, stopped: Stopped, reason: str) -> RobotState:
        """Where the robot is; without joints, and as a fault, where that is not known."""
        arm, robot = self._arm, self._robot
        if why := arm.trouble():
            reason = reason if why in reason else "; ".join(filter(None, (reason, why)))
            return RobotState(
                joint_names=(), positions=np.zeros(0), gripper_width=0.0, time=0.0, stopped="fault", reason=reason
            )
        opening = arm.opening()
        fingers = robot.gripper.posture(opening)
        return RobotState(
            joint_names=(*robot.joints, *fingers),
            positions=np.concatenate([arm.posture(), list(fingers.values())]),
            gripper_width=opening,
            time=arm.time(),
            tracking_error=arm.error,
            stopped=stopped,
            reason=reason,
            force=arm.force,
            shown=bool(self._why),
        )
