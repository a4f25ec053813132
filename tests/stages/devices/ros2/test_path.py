"""Where an arm is on its path, whoever sets its speed."""

import numpy as np
import pytest

from stages.devices.ros2.acting.path import Path, Progress
from stages.devices.ros2.types import Types
from stages.messages import RobotCommand

TIMES = np.linspace(0, 2, 101)


def there_and_back() -> RobotCommand:
    """A joint goes out and comes back, the other one moves on."""
    out = 0.5 * (1 - np.cos(np.pi * TIMES))
    positions = np.stack([out, 0.3 * (3 * (TIMES / 2) ** 2 - 2 * (TIMES / 2) ** 3)], axis=1)
    return RobotCommand(
        joint_names=("a", "b"), times=TIMES, positions=positions, velocities=np.gradient(positions, TIMES, axis=0)
    )


@pytest.mark.parametrize("slower", [1.0, 2.0, 5.0])
def test_an_arm_that_is_slowed_down_is_on_its_path(slower: float) -> None:
    path = Path.of(there_and_back(), np.zeros(2), limits=np.ones(2), speed=1.0)
    progress, seconds = Progress(path), np.arange(0, slower * path.times[-1] + 0.5, 0.008)
    where = [np.array([np.interp(t / slower, path.times, q) for q in path.positions.T]) for t in seconds]
    off = [progress.advance(q, t) for t, q in zip(seconds, where, strict=True)]
    assert max(off) < 0.016 and progress.ended


def test_an_arm_that_leaves_its_path_is_off_it() -> None:
    progress = Progress(Path.of(there_and_back(), np.zeros(2), limits=np.ones(2), speed=1.0))
    assert progress.advance(np.array([0.0, 0.1]), 0.5) > 0.05
    assert progress.advance(np.array([1.0, 0.15]), 0.1) > 0.5, "nobody is ahead of the clock"


def test_points_begin_where_the_arm_is_and_are_for_the_controller() -> None:
    command = there_and_back()
    path = Path.of(command, np.array([0.05, 0.0]), limits=np.full(2, 0.5), speed=0.5)
    fields = path.goal(Types.of("jazzy"), ["a", "b"], path=0.1, end=0.01, overtime=2.5)
    points = fields["trajectory"].points
    assert len(points) == len(TIMES) and points[0].positions.tolist() == [0.0, 0.0]
    assert path.times[1] == pytest.approx(1.5 * 0.1 / (0.2 * 0.5)) and path.times[-1] == pytest.approx(
        path.times[1] + 4
    )
    assert fields["goal_time_tolerance"] == {"sec": 2, "nanosec": 500_000_000}
