"""What goes to the robot's controllers and what its encoders say."""

from runner.contract import Message
from stages.messages.arrays import Matrix, Vector


class RobotCommand(Message, frozen=True, kw_only=True):
    """A joint trajectory to follow, then a gripper opening to reach; either may be empty."""

    joint_names: tuple[str, ...] = ()
    times: Vector
    """Seconds from the start of the motion, length T."""
    positions: Matrix
    """T x J, radians (metres for the torso)."""
    velocities: Matrix
    gripper_width: float | None = None
    """Metres between the fingertips."""
    label: str = ""
    """What the motion is for, shown to people."""


class RobotState(Message, frozen=True, kw_only=True):
    """Encoders after a command has ended or the world was arranged."""

    joint_names: tuple[str, ...]
    positions: Vector
    gripper_width: float
    time: float
    """Robot clock, seconds."""
    tracking_error: float = 0.0
    """Largest joint error while the last trajectory ran, radians."""
