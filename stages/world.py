"""Arrangements, looks and commands in, robot states and snapshots out: the simulated world and its scripted person."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec import structs

from runner.contract import Context, Refused, Stage
from stages.devices.miscalibration import Miscalibration
from stages.devices.servo import PIECE
from stages.devices.simulation import Simulation
from stages.devices.suites import kinds
from stages.devices.suites.placing import moved
from stages.devices.suites.suite import Kind, Rejected
from stages.devices.tabletop import Layout
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.messages import Arrange, Arrangement, Brake, LookRequest, Move, RobotCommand, RobotState, Snapshot
from stages.robots import BUILT_IN as ROBOT
from stages.robots import read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue

_DRIFT = 0.01
"""Metres that an object may move while the scene settles before the arrangement counts as failed."""
_TILT = 0.995
"""Cosine of the largest turn of its axis with which an object still stands as it was laid out."""
_DRAWS = 200
_LOOK = 4.0
"""Seconds that pass for others while the robot looks and thinks."""


class World(Stage):
    """A table, a tray, objects and a robot in MuJoCo; a person lays out scenes between the robot's tasks."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """``suite`` is the kind of scenes, ``seed`` draws them."""

        catalogue: Path = BUILT_IN
        robot: Path = ROBOT
        suite: str = "tray"
        seed: int = 0
        goal: str = "auto"
        """Of the suite ``tray``: a goal template by name, or ``auto`` (chosen by the seed)."""

        def __post_init__(self) -> None:
            if self.seed < 0:
                raise Refused(f"world.seed: {self.seed} is negative; choose 0, 1, 2, ...")
            kinds.check(self.suite, self.goal, self.seed)

    def __init__(self, config: Config) -> None:
        self._config = config
        self._catalogue = Catalogue.shared(config.catalogue)
        self._robot = read_robot(config.robot)
        self._suite = kinds.suite(config.suite, self._catalogue, self._robot, config.seed, goal=config.goal)
        self._looks = 0
        rng = np.random.default_rng([config.seed, 4])
        self._wrong = Miscalibration.draw(rng, self._robot, joints=self._suite.joints)
        self._simulation = Simulation(
            self._catalogue, self._robot, self._suite.names, self._suite.table, factors=self._suite.factors
        )
        self._started = False
        """Somebody may meddle: the start scene is laid out."""

    def on_arrangement(self, arrangement: Arrangement, ctx: Context) -> RobotState:
        """Lays out the goal or a start scene, lets it settle and draws again where something fell."""
        self._lay_out(arrangement.kind, (), ctx)
        return self._state()

    def on_arrange(self, arrange: Arrange, ctx: Context) -> None:
        """Lays out a scene when somebody asks for it, whatever the robot is doing."""
        if arrange.draw < 0:
            raise Refused(f"draw={arrange.draw} is negative; choose 0, 1, 2, ...")
        self._lay_out(arrange.kind, (arrange.draw,) if arrange.draw else (), ctx)

    def on_move(self, move: Move, ctx: Context) -> None:
        """Puts one object elsewhere when somebody asks for it, whatever the robot is doing."""
        layout = self._simulation.layout()
        if move.name not in layout:
            raise Refused(f"name={move.name!r}: no such object; valid: {', '.join(layout)}")
        self._simulation.place(
            move.name, moved(move.name, (move.x, move.y), layout, self._catalogue, self._suite.table)
        )
        ctx.log(f"{move.name} moved to {move.x:.2f}, {move.y:.2f}")

    def on_look_request(self, look_request: LookRequest, ctx: Context) -> Snapshot:
        """The world as it is now, for the simulated camera."""
        self._meddle(_LOOK, ctx)
        table = self._suite.table
        rng = np.random.default_rng([self._config.seed, 3, self._looks])
        self._looks += 1
        return Snapshot(
            names=self._simulation.present,
            T_base_objects=self._simulation.object_poses(),
            joint_names=self._robot.joint_names,
            joint_positions=self._encoders(),
            time=self._simulation.time,
            purpose=look_request.purpose,
            T_base_table=pose(np.eye(3), np.array([*table.center, table.height])),
            table_size=np.array(table.size),
            errors=self._wrong.at_a_look(rng),
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

    def _lay_out(self, kind: Kind, draw: tuple[int, ...], ctx: Context) -> None:
        """Draws scenes until one is possible and stands, and says how many were not, and why."""
        rng = np.random.default_rng([self._config.seed, int(kind == "start"), *draw])
        rejected: Counter[str] = Counter()
        for draws in range(1, _DRAWS + 1):
            try:
                layout = self._suite.sample(kind, rng)
            except Rejected as reason:
                rejected[str(reason)] += 1
                continue
            self._simulation.arrange(layout)
            self._started = kind == "start"
            if self._stands(layout):
                because = ", ".join(f"{why} {count}" for why, count in rejected.items())
                left_out = f"; {rejected.total()} of {draws} draws rejected: {because}" if because else ""
                ctx.log(f"{kind} scene laid out: {', '.join(layout)}{left_out}")
                return
            rejected["fell or slid"] += 1
        raise RuntimeError(f"no {kind} scene of suite {self._config.suite} was possible in {_DRAWS} draws: {rejected}")

    def _stands(self, layout: Layout) -> bool:
        poses = self._simulation.layout()
        return all(
            np.linalg.norm(poses[name][:3, 3] - T[:3, 3]) < _DRIFT and poses[name][:3, 2] @ T[:3, 2] > _TILT
            for name, T in layout.items()
        )

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
