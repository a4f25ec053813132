"""Frames over time: chains up and down, motion, and what is not known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.devices.ros2.transforms import NoTransform, Transforms
from stages.geometry.poses import inverse
from stages.messages import Pose
from tests.stages.devices.ros2.bags import transform

SECOND = 10**9


def pose(x: float, yaw: float = 0.0) -> Pose:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T[0, 3] = x
    return T


@pytest.fixture
def tree() -> Transforms:
    """world holds base and table; the arm moves in base, the camera is fixed to it."""
    transforms = Transforms()
    transforms.add(transform("world", "base", pose(1.0, 0.3)), static=True)
    transforms.add(transform("world", "table", pose(2.0)), static=True)
    transforms.add(transform("arm", "camera", pose(0.1, -1.0)), static=True)
    for time in (1, 2, 4):
        transforms.add(transform("base", "arm", pose(time, 0.2 * time), time * SECOND), static=False)
    return transforms


def test_chains_go_up_and_down(tree: Transforms) -> None:
    expected = inverse(pose(2.0)) @ pose(1.0, 0.3) @ pose(2.0, 0.4) @ pose(0.1, -1.0)
    assert tree.lookup("table", "camera", 2 * SECOND) == pytest.approx(expected)
    assert tree.lookup("camera", "table", 2 * SECOND) == pytest.approx(inverse(expected))
    assert tree.lookup("/base", "base", 0) == pytest.approx(np.eye(4))


def test_motion_is_interpolated(tree: Transforms) -> None:
    assert tree.lookup("base", "arm", 3 * SECOND) == pytest.approx(pose(3.0, 0.6))


def test_what_is_not_known_is_named(tree: Transforms) -> None:
    with pytest.raises(NoTransform, match=r"base to arm is not known at 5.000 s: it is from 1.000 s to 4.000 s"):
        tree.lookup("base", "camera", 5 * SECOND)
    with pytest.raises(NoTransform, match="no transform names frame 'gripper'; there are: arm, base, camera, table"):
        tree.lookup("base", "gripper", SECOND)
    tree.add(transform("map", "robot", pose(0.0)), static=True)
    with pytest.raises(NoTransform, match="no transform between 'base' and 'robot': their roots are 'world' and 'map'"):
        tree.lookup("base", "robot", SECOND)


def test_what_is_no_transform_is_left_out_and_named_where_it_lacks(tree: Transforms) -> None:
    """Drivers that were not calibrated publish quaternions of zeros; the rest of their messages holds."""
    nowhere, unturned = transform("base", "arm", pose(np.nan), 5 * SECOND), transform("base", "lidar", pose(0.0))
    unturned.transforms[0].transform.rotation.w = 0.0
    unturned.transforms += transform("base", "radar", pose(3.0)).transforms
    tree.add(unturned, static=True)
    tree.add(nowhere, static=False)
    assert tree.lookup("base", "camera", 2 * SECOND)[0, 3] == pytest.approx(2 + 0.1 * np.cos(0.4))
    assert tree.lookup("base", "radar", 0)[0, 3] == 3
    with pytest.raises(NoTransform, match=r"^base to lidar has the rotation x y z w = 0 0 0 0, which is no transform"):
        tree.lookup("base", "lidar", SECOND)
    with pytest.raises(
        NoTransform, match=r"from 1.000 s to 4.000 s; since then base to arm has the translation x y z = nan"
    ):
        tree.lookup("base", "camera", 5 * SECOND)
    tree.add(transform("base", "lidar", pose(7.0)), static=True)
    assert tree.lookup("base", "lidar", SECOND)[0, 3] == 7


def test_only_the_newest_past_is_kept() -> None:
    transforms = Transforms(keep_seconds=2.0)
    for time in range(10):
        transforms.add(transform("base", "arm", pose(time), time * SECOND), static=False)
    with pytest.raises(NoTransform, match=r"from 7.000 s to 9.000 s"):
        transforms.lookup("base", "arm", 5 * SECOND)


def test_a_frame_may_get_another_parent(tree: Transforms) -> None:
    tree.add(transform("table", "arm", pose(0.5), 9 * SECOND), static=False)
    assert tree.lookup("table", "arm", 9 * SECOND) == pytest.approx(pose(0.5))
