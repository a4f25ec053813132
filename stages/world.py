"""Arrangements, looks and commands in, robot states and snapshots out: the simulated world and its scripted person."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from msgspec import structs

from runner.contract import Context, Refused
from stages.devices.board import Bare, TrueBoard
from stages.devices.simulated_robot import SimulatedRobot
from stages.devices.suites import kinds
from stages.devices.suites.placing import moved
from stages.devices.suites.suite import Kind, Rejected
from stages.devices.tabletop import Layout
from stages.hand_eye.board import Board
from stages.messages import Arrange, Arrangement, LookRequest, Move, RobotState, Snapshot
from stages.robots import BUILT_IN as ROBOT
from stages.robots import read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue

_DRIFT = 0.01
"""Metres that an object may move while the scene settles before the arrangement counts as failed."""
_TILT = 0.995
"""Cosine of the largest turn of its axis with which an object still stands as it was laid out."""
_DRAWS = 10000
"""Of one scene before it counts as impossible: full trays and dense starts take hundreds, few of them thousands, of a
few milliseconds each."""


class World(SimulatedRobot):
    """A table, a tray, objects and a robot in MuJoCo; a person lays out scenes between the robot's tasks."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """``suite`` is the kind of scenes, ``seed`` draws them."""

        catalogue: Path = BUILT_IN
        robot: Path = ROBOT
        suite: str = "tray"
        seed: int = 0
        goal: str = "auto"
        """Of the suite ``tray``: a goal template by name, or ``auto`` (chosen by the seed)."""
        strangers: int = 0
        """Of the suite ``tray``: objects that look like those of the goal, come with the start and must stay."""
        calibrated: bool = False
        """Somebody has measured where the camera is, with a board."""

        def __post_init__(self) -> None:
            if self.seed < 0:
                raise Refused(f"world.seed: {self.seed} is negative; choose 0, 1, 2, ...")
            kinds.check(self.suite, self.goal, self.seed, self.strangers)

    @classmethod
    def prepare(cls, config: Config) -> None:
        """Reads the catalogue and the robot, which most others need too."""
        Catalogue.shared(config.catalogue)
        read_robot(config.robot)

    def __init__(self, config: Config) -> None:
        self._config, self._catalogue = config, Catalogue.shared(config.catalogue)
        robot = read_robot(config.robot)
        suite = kinds.suite(
            config.suite, self._catalogue, robot, config.seed, goal=config.goal, strangers=config.strangers
        )
        super().__init__(robot, suite, self._catalogue, config.seed, calibrated=config.calibrated)

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


class BoardWorld(SimulatedRobot):
    """A table with nothing on it, a robot, and a board to calibrate its camera with."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """``seed`` draws how far the camera and the board are from where they are said to be."""

        robot: Path = ROBOT
        board: Board = field(default_factory=Board)
        encoders: float = 0.0
        """Degrees by which the encoders are off at most."""
        seed: int = 0

    def __init__(self, config: Config) -> None:
        robot = read_robot(config.robot)
        self._board = TrueBoard(robot, config.board, np.random.default_rng([config.seed, 5]))
        suite = Bare(robot.table, joints=np.deg2rad(config.encoders))
        super().__init__(self._board.robot, suite, Catalogue({}), config.seed)

    def on_look_request(self, look_request: LookRequest, ctx: Context) -> Snapshot:
        """The robot and the board as they are now."""
        T_base_board = self._board.place(self._simulation.encoders())
        return structs.replace(super().on_look_request(look_request, ctx), T_base_board=T_base_board)
