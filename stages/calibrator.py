"""Encoders and pictures of a board in, robot commands and look requests out, and at the end where the camera is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from runner.contract import Context, Refused, Stage
from stages.hand_eye.board import Board
from stages.hand_eye.limits import Limits
from stages.hand_eye.rig import Rig
from stages.messages import (
    Abort,
    Brake,
    CalibrateCamera,
    CameraCalibration,
    Frame,
    LookRequest,
    Mounting,
    RobotCommand,
    RobotState,
)
from stages.robots import BUILT_IN, read_robot

if TYPE_CHECKING:
    from stages.hand_eye.routine import CalibrationRoutine, Steps


class Calibrator(Stage):
    """Shows the camera a board from many sides, one pose at a time: robot states and frames answer what it asks."""

    stateful = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """The robot, and the board in its hand or, where the camera is in the hand, in the room."""

        robot: Path = BUILT_IN
        board: Board = field(default_factory=Board)
        poses: int = 15
        limits: Limits = field(default_factory=Limits)
        scripted: bool = True
        """Begins at once; else when somebody calls ``calibrate``."""

        def __post_init__(self) -> None:
            if self.poses < self.limits.boards:
                raise Refused(f"calibrator.poses = {self.poses}: limits.boards = {self.limits.boards} are needed")

    def __init__(self, config: Config) -> None:
        # Motion planning takes half a second to load; whoever only reads a graph does without.
        from stages.hand_eye.routine import CalibrationRoutine

        self._config, self._robot, self._routines = config, read_robot(config.robot), CalibrationRoutine
        self._routine: CalibrationRoutine | None = None
        self._steps: Steps | None = None
        """What is under way."""
        self._halted = False
        self._ctx: Context | None = None

    def on_mounting(self, mounting: Mounting, ctx: Context) -> RobotCommand | LookRequest | CameraCalibration | None:
        """Takes the camera to be there; begins after the first of these, where nobody is to call for it.

        What stands in the file now, this very calibration may have written.
        """
        config, first = self._config, self._routine is None
        camera = replace(self._robot.camera, link=mounting.link, T_link_camera=mounting.T_link_camera)
        rig = Rig(replace(self._robot, camera=camera), config.board)
        self._routine = self._routines(rig, poses=config.poses, limits=config.limits, log=self._log)
        return self._begin(self._routine, ctx) if first and config.scripted else None

    def on_calibrate(self, calibrate: CalibrateCamera, ctx: Context) -> RobotCommand | LookRequest | CameraCalibration:
        """Begins where the arm stands."""
        if self._steps is not None or self._routine is None:
            raise Refused("a calibration is under way" if self._steps else "the description was not read yet")
        return self._begin(self._routine, ctx)

    def on_robot_state(
        self, robot_state: RobotState, ctx: Context
    ) -> RobotCommand | LookRequest | CameraCalibration | None:
        """Goes on once the arm has done what it was told."""
        if self._routine and self._steps and self._halted:
            self._steps = None
            return self._routine.failure("stopped as asked; the arm stands where it is")
        return self._advance(robot_state, ctx)

    def on_frame(self, frame: Frame, ctx: Context) -> RobotCommand | LookRequest | CameraCalibration | None:
        """Goes on with what the camera sees."""
        return self._advance(frame, ctx)

    def on_stop(self, stop: Abort, ctx: Context) -> Brake:
        """Stops the arm, wherever it is."""
        if self._steps is None:
            raise Refused("no calibration is under way")
        self._halted = True
        return Brake()

    def _begin(self, routine: CalibrationRoutine, ctx: Context) -> RobotCommand | LookRequest | CameraCalibration:
        self._halted = False
        self._steps = routine.run(ctx.rng)
        answer = self._advance(None, ctx)
        assert answer is not None  # It has just begun.
        return answer

    def _advance(
        self, given: RobotState | Frame | None, ctx: Context
    ) -> RobotCommand | LookRequest | CameraCalibration | None:
        if self._steps is None:
            return None
        self._ctx = ctx
        try:
            return self._steps.send(given)
        except StopIteration as end:
            self._steps = None
            return end.value

    def _log(self, text: str) -> None:
        assert self._ctx is not None
        self._ctx.log(text)
