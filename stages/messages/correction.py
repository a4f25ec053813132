"""Looking at the robot's own arm: postures asked for, and what they show of the camera."""

from runner.contract import Command, Message
from stages.messages.arrays import Matrix, Pose, Vector
from stages.messages.robot import Stopped

OWN_ARM = "own arm"
"""Purposes of looks that are for this begin so; nothing is perceived in them."""
CAMERAS_WAY = f"{OWN_ARM}: what is in the way of the camera"
"""Purpose of a look before the arm brings the camera elsewhere."""


class PostureRequest(Message, frozen=True, kw_only=True):
    """Asks the executor to bring the arm into a posture, around what has been seen."""

    joint_names: tuple[str, ...]
    positions: Vector
    """Radians (metres where joints slide)."""
    table_height: float
    """Metres in the base frame; the table is elsewhere as the robot's description has it."""
    occupied: Matrix
    """Boxes that the arm must not enter, N x 6: low and high corner, base frame, metres."""
    label: str
    """Shown to people."""


class Arrived(Message, frozen=True, kw_only=True):
    """How a :class:`PostureRequest` ended, and where the arm is."""

    success: bool
    reason: str
    stopped: Stopped = ""
    """Why the arm stands on the way."""
    joint_names: tuple[str, ...]
    positions: Vector
    """Encoders of all joints."""
    robot_seconds: float


class Correction(Message, frozen=True, kw_only=True):
    """What the robot's own arm showed of its depth camera, for all looks that follow."""

    found: bool
    """Where it is not, looks stay as the camera delivers them."""
    reason: str
    T_believed_true: Pose
    """Where the depth camera is, in the frame in which it is said to be."""
    depth: float
    """Factor that makes its readings metres."""
    deviations: Vector
    """Standard deviations, 7: rotation (radians) and translation (metres) about and along x, y, z, depth factor."""
    residual: float
    """Metres between the readings and the robot's surface, root mean square."""
    explained: float
    """Share of the readings where the robot should be that lie on its surface."""
    postures: int
    robot_seconds: float


class Calibrate(Command, frozen=True, kw_only=True):
    """Has the arm show itself to the camera once more, before the next look."""
