"""Transfers in, robot commands and outcomes out: picks and places with what was perceived, nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from runner.contract import Context, Refused, Stage
from stages.messages import Outcome, RobotCommand, RobotState, TransferRequest
from stages.robots import BUILT_IN as ROBOT
from stages.robots import read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue


class Executor(Stage):
    """Drives one transfer at a time; every robot state answers the command before it."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """``attempts``: how many grasps are tried on an object before the transfer is reported as failed."""

        catalogue: Path = BUILT_IN
        robot: Path = ROBOT
        attempts: int = 3

        def __post_init__(self) -> None:
            if self.attempts < 1:
                raise Refused(f"executor.attempts: {self.attempts} is too few; choose 1, 2, ...")

    def __init__(self, config: Config) -> None:
        # Motion planning takes half a second to load; whoever only reads a graph does without.
        from stages.planning.transfer import Routine, TransferRoutine

        self._config = config
        self._catalogue = Catalogue.shared(config.catalogue)
        self._robot = read_robot(config.robot)
        self._transfers = TransferRoutine
        self._routine: Routine | None = None
        self._ctx: Context | None = None

    def on_transfer_request(self, transfer_request: TransferRequest, ctx: Context) -> RobotCommand | Outcome:
        """Starts a transfer: the first command reads the encoders."""
        self._ctx = ctx
        routine = self._transfers(
            transfer_request,
            robot=self._robot,
            table=self._robot.table,
            catalogue=self._catalogue,
            rng=ctx.rng,
            attempts=self._config.attempts,
            log=self._log,
        )
        self._routine = routine.run()
        return self._advance(None)

    def on_robot_state(self, robot_state: RobotState, ctx: Context) -> RobotCommand | Outcome | None:
        """Continues the transfer; states that answer no command of this stage are ignored."""
        if self._routine is None:
            return None
        self._ctx = ctx
        return self._advance(robot_state)

    def _advance(self, state: RobotState | None) -> RobotCommand | Outcome:
        assert self._routine is not None
        try:
            return next(self._routine) if state is None else self._routine.send(state)
        except StopIteration as end:
            self._routine = None
            return end.value

    def _log(self, text: str) -> None:
        assert self._ctx is not None
        self._ctx.log(text)
