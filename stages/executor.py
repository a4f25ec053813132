"""Transfers and postures in, robot commands and outcomes out: with what was perceived, nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from runner.contract import Context, Refused, Stage
from stages.messages import (
    Arrived,
    Brake,
    Halt,
    Outcome,
    PostureRequest,
    Recover,
    RobotCommand,
    RobotState,
    TransferRequest,
)
from stages.robots import BUILT_IN as ROBOT
from stages.robots import read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue

if TYPE_CHECKING:
    from stages.planning.motion.posture import Homecoming, Motion, PostureRoutine
    from stages.planning.motion.transfer import Routine, TransferRoutine


_HAS_NOT_MOVED = Outcome(
    number=0, object="", destination="", success=True, failed_stage="", reason="", grasp="", attempts=0,
    robot_seconds=0.0, planning_seconds=0.0,
)  # fmt: skip
"""Of an arm that was stopped before it was first asked for anything: it is at home still."""


class Executor(Stage):
    """Drives one transfer, or one motion into a posture, at a time; every robot state answers the command before it."""

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
        from stages.planning.motion.motion import warm_up
        from stages.planning.motion.posture import PostureRoutine
        from stages.planning.motion.transfer import TransferRoutine

        self._config = config
        self._catalogue = Catalogue.shared(config.catalogue)
        self._robot = read_robot(config.robot)
        warm_up(self._robot)
        self._transfers, self._postures = TransferRoutine, PostureRoutine
        self._routine: TransferRoutine | PostureRoutine | None = None
        """The newest one."""
        self._steps: Routine | Motion | Homecoming | None = None
        """What is under way."""
        self._halted = False
        self._ctx: Context | None = None

    def on_transfer_request(self, transfer_request: TransferRequest, ctx: Context) -> RobotCommand | Outcome | Arrived:
        """Starts a transfer: the first command reads the encoders."""
        self._ctx = ctx
        self._routine = self._transfers(
            transfer_request,
            robot=self._robot,
            table=self._robot.table,
            catalogue=self._catalogue,
            rng=ctx.rng,
            attempts=self._config.attempts,
            log=self._log,
        )
        return self._begin(self._routine.run())

    def on_posture_request(self, posture_request: PostureRequest, ctx: Context) -> RobotCommand | Outcome | Arrived:
        """Brings the arm into a posture."""
        self._ctx = ctx
        self._routine = self._postures(posture_request, robot=self._robot, rng=ctx.rng, log=self._log)
        return self._begin(self._routine.run())

    def on_recover(self, recover: Recover, ctx: Context) -> RobotCommand | Outcome | Arrived:
        """Brings the arm home after a stop."""
        self._ctx, self._halted = ctx, False
        return self._begin(self._routine.recover()) if self._routine else _HAS_NOT_MOVED

    def on_robot_state(self, robot_state: RobotState, ctx: Context) -> RobotCommand | Outcome | Arrived | None:
        """Continues the transfer; states that answer no command of this stage are ignored."""
        if self._steps is None:
            return None
        self._ctx = ctx
        # The stop may have come between two commands.
        stopped = replace(robot_state, stopped="stop", reason="as asked") if self._halted else robot_state
        return self._advance(stopped)

    def on_stop(self, stop: Halt, ctx: Context) -> Brake:
        """Stops the arm, whatever it is doing."""
        if self._steps is None:
            raise Refused("the arm is not under way")
        return self.on_brake(Brake())

    def on_brake(self, brake: Brake) -> Brake:
        """Stops the arm, which then stands until it is to recover: what was on its way here moves it no more."""
        self._halted = True
        return brake

    def close(self) -> None:
        """Says what is in the hand of an arm that was under way."""
        if self._steps is not None and self._routine is not None:
            self._log(f"stopped on the way; {self._routine.in_hand or 'nothing'} is in the hand")

    def _begin(self, steps: Routine | Motion | Homecoming) -> RobotCommand | Outcome | Arrived:
        self._steps = steps
        return self._advance(None)

    def _advance(self, state: RobotState | None) -> RobotCommand | Outcome | Arrived:
        assert self._steps is not None
        try:
            return next(self._steps) if state is None else self._steps.send(state)
        except StopIteration as end:
            self._steps = None
            return end.value

    def _log(self, text: str) -> None:
        assert self._ctx is not None
        self._ctx.log(text)
