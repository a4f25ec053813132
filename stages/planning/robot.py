"""What planning has to know of a robot, whichever it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco

from stages.geometry.arrays import Floats


@dataclass(frozen=True)
class Gripper:
    """Two parallel fingers. The link's x axis is the approach direction, y the closing direction."""

    link: str
    """Link between the fingers."""
    joints: tuple[str, str]
    """Each moves one finger outwards, metres, 0 when closed."""
    open_width: float
    closed_width: float
    force: float
    """Newton per finger."""
    reach: float
    """Metres from the link's origin to the fingertips along the approach direction."""

    def width(self, finger: float) -> float:
        """Metres between the fingers at a finger joint's position."""
        return 2 * finger + self.closed_width

    def finger(self, width: float) -> float:
        """Position of a finger joint for ``width`` metres between the fingers, within the joint's range."""
        clipped = min(max(width, self.closed_width), self.open_width)
        return (clipped - self.closed_width) / 2


@dataclass(frozen=True)
class RobotModel:
    """A fixed-base arm with a gripper, described by a MuJoCo specification."""

    specification: Callable[[], mujoco.MjSpec]
    """Makes a new specification of the robot alone; the world frame is its base frame."""
    joints: tuple[str, ...]
    """The J joints that planning moves."""
    velocity: Floats
    """J, limits, rad/s (m/s)."""
    acceleration: Floats
    """J, limits, rad/s^2 (m/s^2)."""
    home: Floats
    """J, a posture that leaves the camera's view free."""
    head: dict[str, float]
    """Fixed positions of joints that planning does not move."""
    gripper: Gripper
