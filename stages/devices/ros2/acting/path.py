"""A trajectory as a controller is given it, and how far along it an arm is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from stages.devices.ros2.types import Types
from stages.geometry.arrays import Floats
from stages.messages import RobotCommand

_STEP = 0.01
"""Seconds between the points at which a trajectory is compared with where the arm is."""
_AHEAD = 1.0
"""Seconds that the arm may advance along it from one joint state to the next."""
_LEAD_SHARE, _LEAD_SECONDS = 0.2, 0.1
"""Share of the speed limits with which the arm goes to where the motion begins, and for how long at least."""


@dataclass(frozen=True)
class Path:
    """A timed motion that begins where the arm is: ``times`` (T) in seconds, the others T x J."""

    times: Floats
    positions: Floats
    velocities: Floats

    @staticmethod
    def of(command: RobotCommand, start: Floats, *, limits: Floats, speed: float) -> Path:
        """The motion of a command at a share of its speed, after a short way from ``start`` (J) to where it begins.

        ``limits`` (J) are those of the joints' velocities.
        """
        way = float((np.abs(command.positions[0] - start) / limits).max())
        # A cubic from rest to rest is half as fast again in its middle.
        lead = max(1.5 * way / (_LEAD_SHARE * speed), _LEAD_SECONDS)
        return Path(
            np.append(0.0, lead + command.times / speed),
            np.vstack([start, command.positions]),
            np.vstack([np.zeros_like(start), speed * command.velocities]),
        )

    def goal(self, types: Types, names: Sequence[str], *, path: float, end: float, overtime: float) -> dict[str, Any]:
        """Fields of a FollowJointTrajectory goal, with tolerances for every joint; radians (metres), seconds."""
        points = [
            {"positions": q, "velocities": v, "time_from_start": duration(t)}
            for t, q, v in zip(self.times[1:], self.positions[1:], self.velocities[1:], strict=True)
        ]
        tolerances = [
            [types.new("control_msgs/msg/JointTolerance", name=name, position=metres) for name in names]
            for metres in (path, end)
        ]
        return {
            "trajectory": self.trajectory(types, names, points),
            "path_tolerance": tolerances[0],
            "goal_tolerance": tolerances[1],
            "goal_time_tolerance": duration(overtime),
        }

    @staticmethod
    def trajectory(types: Types, names: Sequence[str], points: Sequence[dict[str, Any]]) -> Any:
        """A JointTrajectory that begins when it arrives."""
        made = [types.new("trajectory_msgs/msg/JointTrajectoryPoint", **point) for point in points]
        return types.new("trajectory_msgs/msg/JointTrajectory", joint_names=list(names), points=made)


class Progress:
    """How far along a path an arm has come, which may be later than planned: it is slowed down, or its clock is."""

    def __init__(self, path: Path) -> None:
        spline = CubicHermiteSpline(path.times, path.positions, path.velocities)
        self._times = np.append(np.arange(0.0, path.times[-1], _STEP), path.times[-1])
        self._positions, self.velocities = spline(self._times), spline(self._times, 1)
        self.accelerations = np.gradient(self.velocities, self._times, axis=0)
        self.index = 0
        """Of the point that the arm has reached."""

    @property
    def ended(self) -> bool:
        """Whether the last point is reached."""
        return self.index == len(self._times) - 1

    def advance(self, q: Floats, elapsed: float) -> float:
        """Takes where the arm is (J), seconds after the start; returns how far from the path, radians (metres)."""
        until = min(elapsed, float(self._times[self.index]) + _AHEAD)
        last = max(int(np.searchsorted(self._times, until, "right")), self.index + 1)
        distances = np.abs(self._positions[self.index : last] - q).max(1)
        self.index += int(distances.argmin())
        return float(distances.min())


def duration(seconds: float) -> dict[str, int]:
    """As ROS 2 has it."""
    whole, rest = divmod(round(seconds * 1e9), 10**9)
    return {"sec": whole, "nanosec": rest}
