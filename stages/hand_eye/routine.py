"""Calibrating the camera: commands and look requests out, encoders and pictures in, the calibration at the end."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import Any

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import rotation_angle
from stages.hand_eye.limits import Limits
from stages.hand_eye.poses import Sightlines, nearest_first, proposed
from stages.hand_eye.rig import Rig
from stages.hand_eye.solving import Fit, Sight, left_out, solve, turns
from stages.messages import CameraCalibration, Frame, LookRequest, RobotCommand, RobotState
from stages.messages.robot import Guard
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.motion import arm, free_motion, robot_command

Steps = Generator[RobotCommand | LookRequest, Any, CameraCalibration]
"""Yields what is asked and is sent the answer: a robot state, or a frame."""

_SPEED = 0.4
"""Share of the joint limits."""
_GUARD = Guard(force=12.0)
_CLEARANCE = 0.02
"""Metres that the robot keeps from the table, ..."""
_ABOUT = {True: 0.03, False: 0.05}
"""... and from a board whose place is known so well: in the hand, or somewhere in the room."""
_MOVED = 2e-3
"""Radians (metres) that a joint may move while a picture is taken."""


class CalibrationRoutine:
    """One calibration as a generator; whatever happens, the arm ends at home unless something stops it."""

    def __init__(self, rig: Rig, *, poses: int, limits: Limits, log: Callable[[str], None]) -> None:
        self._rig, self._poses, self._limits, self._log = rig, poses, limits, log
        self._robot = rig.with_board(rig.Y, clearance=_ABOUT[rig.held])
        self._world = CollisionWorld(self._robot, rig.robot.table, {}, clearance=_CLEARANCE)
        self._sights: list[Sight] = []

    def run(self, rng: np.random.Generator) -> Steps:
        """From wherever the arm stands."""
        self._sights = []
        state: RobotState = yield self._read()
        if state.stopped:
            return self.failure(_stands(state))
        at = arm(self._rig.robot, state)
        if touching := self._world.contacts(at):
            return self.failure(f"where the arm stands, {_pairs(touching)} would touch: move it, or the board")
        postures = proposed(self._rig, self._world, Sightlines(self._robot), self._poses, rng)
        holder = f"held by {self._rig.link}" if self._rig.held else "in the room"
        self._log(f"{len(postures)} poses proposed, the board {holder}")
        if unread := self._rig.unread(state.joint_names):
            self._log(f"no encoder of {', '.join(unread)} is read: taken to stand where the description says")
        for number, q in enumerate(nearest_first(postures, at), 1):
            path = free_motion(self._world, at, q, rng)
            if path is None:
                self._log(f"pose {number} of {len(postures)}: no free way there")
                continue
            state = yield self._move(path, f"calibration pose {number} of {len(postures)}")
            if state.stopped:
                return self.failure(_stands(state))
            at = arm(self._rig.robot, state)
            frame: Frame = yield LookRequest(purpose=f"calibration pose {number}")
            state = yield self._read()
            if state.stopped:
                return self.failure(_stands(state))
            self._see(frame, state, at, f"pose {number} of {len(postures)}")
        back = free_motion(self._world, at, self._rig.robot.home, rng)
        if back is not None:
            yield self._move(back, "go home")
        return self._result()

    def _see(self, frame: Frame, state: RobotState, before: Floats, place: str) -> None:
        if np.abs(arm(self._rig.robot, state) - before).max() > _MOVED:
            self._log(f"{place}: the arm moved while the picture was taken; left out")
            return
        found = self._rig.board.find(frame.rgb)
        if found is None:
            self._log(f"{place}: no board in the picture")
            return
        ids, pixels = found
        joints = dict(zip(state.joint_names, state.positions.tolist(), strict=True))
        self._sights.append(Sight(self._rig.between(joints), self._rig.board.corners[ids], pixels, frame.K))
        self._log(f"{place}: {len(ids)} of {len(self._rig.board.corners)} corners")

    def _result(self) -> CameraCalibration:
        if missing := too_alike(self._sights, self._limits, self._rig.link or "the base"):
            return self.failure(missing)
        fit = solve(self._sights)
        return judged(self._rig, self._sights, fit, self._limits)

    def failure(self, reason: str) -> CameraCalibration:
        """Nothing was found, and why."""
        return _calibration(self._rig, success=False, reason=reason)

    def _read(self) -> RobotCommand:
        return robot_command(self._rig.robot, "read the encoders")

    def _move(self, path: Floats, label: str) -> RobotCommand:
        return robot_command(self._rig.robot, label, path, speed=_SPEED, guard=_GUARD)


def too_alike(sights: Sequence[Sight], limits: Limits, carrier: str) -> str:
    """What the pictures lack to tell where the camera is; empty where they tell."""
    if len(sights) < limits.boards:
        return f"the board was found in {len(sights)} pictures; at least {limits.boards} are needed"
    spread, axes = turns(sights)
    first, second = np.rad2deg(spread[:2])
    more = f"turn it by {2 * limits.turn:.0f} degrees or more"
    if first < limits.turn:
        return f"too alike: boards are turned against each other by {first:.1f} degrees only; {more} about two axes"
    if second < limits.turn:
        axis = " ".join(f"{part:.2f}" for part in axes[0])
        return (
            f"too alike: boards are turned about one axis only, {axis} in the frame of {carrier}; {more} about another"
        )
    return ""


def judged(rig: Rig, sights: Sequence[Sight], fit: Fit, limits: Limits) -> CameraCalibration:
    """The calibration with its errors; no success where they are too large."""
    out = left_out(sights, fit)
    fault = _fault(rig, fit, out, limits)
    return _calibration(
        rig,
        success=not fault,
        reason=f"{fault} ({_told(rig, fit, out)})" if fault else _told(rig, fit, out),
        T_link_camera=fit.X,
        T_link_board=fit.Y,
        residuals=fit.residuals,
        residual=fit.residual,
        left_out_metres=out[:, 0],
        left_out_radians=out[:, 1],
        uncertain_metres=fit.uncertain[0],
        uncertain_radians=fit.uncertain[1],
    )


def _fault(rig: Rig, fit: Fit, out: Floats, limits: Limits) -> str:
    most = np.array([1e-3 * limits.millimetres, np.deg2rad(limits.degrees)])
    told = f"{limits.millimetres:g} mm or {limits.degrees:g} degrees"
    # Corners leave open how a board is turned, too; where it is they tell well.
    if fit.residual > limits.residual or np.median(out[:, 0]) > most[0]:
        return (
            f"the pictures contradict each other, by more than {limits.residual:g} px or {limits.millimetres:g} mm: "
            f"are the squares {1e3 * rig.board.square:g} mm, does the board sit tight, is the lens known, are the "
            "encoders right?"
        )
    if (np.array(fit.uncertain) > most).any():
        return (
            f"too alike: it stays uncertain by more than {told}; more poses, turned further and nearer to the camera, "
            "are needed"
        )
    return ""


def _told(rig: Rig, fit: Fit, out: Floats) -> str:
    """The figures, for people."""
    moved = float(np.linalg.norm(fit.X[:3, 3] - rig.X[:3, 3])), rotation_angle(fit.X[:3, :3], rig.X[:3, :3])
    return (
        f"{len(out)} boards, residual {fit.residual:.2f} px, left out {_error(*np.median(out, axis=0))}, uncertain by "
        f"{_error(*fit.uncertain)}; the camera is {_error(*moved)} from where it was said to be"
    )


def _error(metres: Any, radians: Any) -> str:
    return f"{1e3 * metres:.1f} mm and {np.rad2deg(radians):.2f} degrees"


def _calibration(rig: Rig, **fields: Any) -> CameraCalibration:
    nothing: dict[str, Any] = dict.fromkeys(("residuals", "left_out_metres", "left_out_radians"), np.zeros(0))
    return CameraCalibration(camera_link=rig.robot.camera.link, board_link=rig.link, **(nothing | fields))


def _pairs(touching: set[tuple[str, str]]) -> str:
    return ", ".join(f"{one} and {other}" for one, other in sorted(touching))


def _stands(state: RobotState) -> str:
    return f"{state.stopped}: {state.reason}; the arm stands where it is"
