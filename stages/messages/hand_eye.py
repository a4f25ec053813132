"""Calibrating the camera: what is asked, and what comes of it."""

from __future__ import annotations

from runner.contract import Command, Message
from stages.messages.arrays import Pose, Vector


class Mounting(Message, frozen=True, kw_only=True):
    """Where the robot's description has the camera."""

    link: str
    """What carries the camera; empty: it stands in the base frame."""
    T_link_camera: Pose


class CameraCalibration(Message, frozen=True, kw_only=True):
    """Where the camera is, or why that is still not known."""

    success: bool
    reason: str
    """What was found and how well; where nothing was, what is missing."""
    camera_link: str
    """What carries the camera; empty: it stands in the base frame."""
    T_link_camera: Pose | None = None
    """In that link's frame; None where the pictures do not tell."""
    board_link: str = ""
    T_link_board: Pose | None = None
    """The middle of the board's pattern (x right, y down, z into the board) in the frame of what carries it."""
    residuals: Vector
    """Root mean square of a corner's error in each picture, pixels."""
    residual: float = 0.0
    """Over all pictures, pixels."""
    left_out_metres: Vector
    left_out_radians: Vector
    """For each picture: how far its board is from where all other pictures have it."""
    uncertain_metres: float = 0.0
    uncertain_radians: float = 0.0
    """Standard deviations of the camera's position and turn, by the pictures alone."""


class CalibrateCamera(Command, frozen=True, kw_only=True):
    """Moves the arm from pose to pose, looks at the board from each, and finds out where the camera is."""

    answers = (CameraCalibration,)


class Abort(Command, frozen=True, kw_only=True):
    """Stops the arm at once, where it is, and ends the calibration."""

    answers = (CameraCalibration,)
