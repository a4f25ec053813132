"""A robot in the simulated world: looks and commands in, snapshots and encoders out."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from msgspec import structs

from runner.contract import Context, Stage
from stages.devices.miscalibration import Miscalibration
from stages.devices.servo import PIECE
from stages.devices.simulation import Simulation
from stages.devices.suites.suite import Suite
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.messages import Brake, LookRequest, RobotCommand, RobotState, SensorErrors, Snapshot
from stages.robots import Robot
from stages.scene.catalogue import Catalogue

_LOOK = 4
"""Seconds that pass while the robot looks and thinks."""


class SimulatedRobot(Stage):
    """What every simulated world does, whatever is in it; its joints and, unless it is ``calibrated``, its camera are
    those of a robot that nobody calibrated today."""

    device = True

    def __init__(
        self, robot: Robot, suite: Suite, catalogue: Catalogue, seed: int, *, calibrated: bool = False
    ) -> None:
        self._robot, self._suite, self._seed = robot, suite, seed
        self._looks = 0
        self._wrong = Miscalibration.draw(
            np.random.default_rng([seed, 4]), robot, joints=suite.joints, calibrated=calibrated
        )
        self._simulation = Simulation(catalogue, robot, suite.names, suite.table, factors=suite.factors)
        self._started = False
        """Somebody may meddle: the start scene is laid out."""

    def on_look_request(self, look_request: LookRequest, ctx: Context) -> Snapshot:
        """The world as it is now, for the simulated camera."""
        for _ in range(_LOOK):
            self._meddle(1.0, ctx)
            self._simulation.run(1.0)
        rng = np.random.default_rng([self._seed, 3, self._looks])
        self._looks += 1
        return self.snapshot(look_request.purpose, self._wrong.at_a_look(rng))

    def snapshot(self, purpose: str, errors: SensorErrors | None = None) -> Snapshot:
        """The world as it is, with what is wrong with the sensors that look at it."""
        table = self._suite.table
        return Snapshot(
            names=self._simulation.present,
            T_base_objects=self._simulation.object_poses(),
            joint_names=self._robot.joint_names,
            joint_positions=self._encoders(),
            time=self._simulation.time,
            purpose=purpose,
            T_base_table=pose(np.eye(3), np.array([*table.center, table.height])),
            table_size=np.array(table.size),
            errors=errors,
        )

    def on_robot_command(self, robot_command: RobotCommand, ctx: Context) -> Iterator[RobotState | None]:
        """Runs a joint trajectory, then moves the gripper; an empty command only reads the encoders.

        What else arrives is heard in between, so that somebody may meddle or stop the arm.
        """
        servo = self._simulation.servo
        joints = [self._robot.joint_names.index(name) for name in robot_command.joint_names]
        if joints:
            positions = robot_command.positions + self._wrong.joints[joints]
            robot_command = structs.replace(robot_command, positions=positions)
        try:
            for _ in servo.carry_out(robot_command):
                self._meddle(PIECE, ctx)
                yield None
        except GeneratorExit:
            ctx.log(f"the arm stands; the fingers are {1e3 * servo.opening():.0f} mm apart")
            raise
        yield self._state()

    def on_brake(self, brake: Brake) -> None:
        """Stops the arm where it is."""
        self._simulation.servo.brake()

    def _meddle(self, seconds: float, ctx: Context) -> None:
        if self._started and (what := self._suite.meddle(self._simulation, seconds)):
            ctx.log(what)

    def _encoders(self) -> Floats:
        return self._simulation.encoders() - self._wrong.joints

    def _state(self) -> RobotState:
        servo = self._simulation.servo
        return RobotState(
            joint_names=self._robot.joint_names,
            positions=self._encoders(),
            gripper_width=servo.opening(),
            time=self._simulation.time,
            tracking_error=servo.error,
            stopped=servo.stopped,
            reason=servo.reason,
            force=servo.force,
        )
