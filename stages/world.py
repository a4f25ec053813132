"""Arrangements, looks and commands in, robot states and snapshots out: the simulated world and its scripted person."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from runner.contract import Context, Refused, Stage
from stages.devices import fetch, tabletop
from stages.devices.simulation import Simulation
from stages.geometry.poses import pose
from stages.messages import Arrange, Arrangement, LookRequest, Move, RobotCommand, RobotState, Snapshot
from stages.scene.catalogue import BUILT_IN, Catalogue

_DRIFT = 0.01
"""Metres that an object may move while the scene settles before the arrangement counts as failed."""
_TILT = 0.995
"""Cosine of the largest tilt of an object that still stands."""
_DRAWS = 20


class World(Stage):
    """A table, a tray, objects and a robot in MuJoCo; a person lays out scenes between the robot's tasks."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """``seed`` draws the scenes; ``goal`` is a goal template by name or ``auto`` (chosen by the seed)."""

        catalogue: Path = BUILT_IN
        seed: int = 0
        goal: str = "auto"

        def __post_init__(self) -> None:
            if self.seed < 0:
                raise Refused(f"world.seed: {self.seed} is negative; choose 0, 1, 2, ...")
            tabletop.goal_name(self.goal, self.seed)

    def __init__(self, config: Config) -> None:
        self._config = config
        self._catalogue = Catalogue.shared(config.catalogue)
        self._goal = tabletop.goal_name(config.goal, config.seed)
        self._simulation = Simulation(self._catalogue, tabletop.object_names(self._goal))

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
        layout = dict(zip(self._simulation.names, self._simulation.object_poses(), strict=True))
        if move.name not in layout:
            raise Refused(f"name={move.name!r}: no such object; valid: {', '.join(layout)}")
        self._simulation.place(move.name, tabletop.moved(move.name, move.x, move.y, layout, self._catalogue))
        ctx.log(f"{move.name} moved to {move.x:.2f}, {move.y:.2f}")

    def on_look_request(self, look_request: LookRequest) -> Snapshot:
        """The world as it is now, for the simulated camera."""
        return Snapshot(
            names=self._simulation.names,
            T_base_objects=self._simulation.object_poses(),
            joint_names=fetch.JOINT_NAMES,
            joint_positions=self._simulation.encoders(),
            time=self._simulation.time,
            purpose=look_request.purpose,
            T_base_table=pose(np.eye(3), np.array([*tabletop.TABLE.center, tabletop.TABLE.height])),
        )

    def on_robot_command(self, robot_command: RobotCommand) -> RobotState:
        """Runs a joint trajectory, then moves the gripper; an empty command only reads the encoders."""
        error = 0.0
        if len(robot_command.times):
            error = self._simulation.follow(
                robot_command.joint_names, robot_command.times, robot_command.positions, robot_command.velocities
            )
        if robot_command.gripper_width is not None:
            self._simulation.move_gripper(robot_command.gripper_width)
        return self._state(error)

    def _lay_out(self, kind: Literal["goal", "start"], draw: tuple[int, ...], ctx: Context) -> None:
        rng = np.random.default_rng([self._config.seed, int(kind == "start"), *draw])
        sample = tabletop.sample_goal if kind == "goal" else tabletop.sample_start
        for _ in range(_DRAWS):
            layout = sample(self._goal, self._catalogue, rng)
            self._simulation.arrange(layout)
            if self._stands(layout):
                ctx.log(f"{kind} scene laid out: {', '.join(layout)}")
                return
        raise RuntimeError(f"no {kind} scene of {self._goal} stood in {_DRAWS} draws")

    def _stands(self, layout: tabletop.Layout) -> bool:
        poses = dict(zip(self._simulation.names, self._simulation.object_poses(), strict=True))
        return all(
            np.linalg.norm(poses[name][:3, 3] - T[:3, 3]) < _DRIFT and poses[name][2, 2] > _TILT
            for name, T in layout.items()
        )

    def _state(self, tracking_error: float = 0.0) -> RobotState:
        return RobotState(
            joint_names=fetch.JOINT_NAMES,
            positions=self._simulation.encoders(),
            gripper_width=self._simulation.gripper_width(),
            time=self._simulation.time,
            tracking_error=tracking_error,
        )
