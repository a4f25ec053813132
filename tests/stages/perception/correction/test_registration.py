"""Registration of what a depth camera reads of the robot, rendered with errors that are known."""

from functools import cache

import numpy as np
import pytest

from stages.devices.miscalibration import Miscalibration
from stages.devices.simulated_camera import SimulatedCamera
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.messages import Snapshot
from stages.perception.correction.body import RobotSurface
from stages.perception.correction.registration import Posture, Registration, Sight
from stages.perception.rendering.depth_noise import structured_light
from stages.perception.rendering.rasteriser import View
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.posture import postures_in_view
from stages.robots import BUILT_IN, Robot, read_robot
from stages.scene.catalogue import BUILT_IN as CATALOGUE
from stages.scene.catalogue import Catalogue

ROBOT = read_robot(BUILT_IN)
PRIOR = np.array([*[np.deg2rad(0.5)] * 3, *[0.005] * 3, 0.02])
WRONG = Miscalibration.draw(np.random.default_rng([340, 4]), ROBOT, joints=0.0)
DEPTH_CAMERA = WRONG.T_believed_true @ WRONG.T_color_depth


def registration(robot: Robot = ROBOT) -> Registration:
    return Registration(RobotSurface(robot), View.of(robot.camera.K, *robot.camera.size), PRIOR)


@cache
def postures() -> tuple[Posture, ...]:
    """Free postures in the camera's view, the most telling ones first."""
    found = postures_in_view(CollisionWorld(ROBOT, ROBOT.table, {}), np.random.default_rng(0), 10)
    fingers = ROBOT.gripper.posture(ROBOT.gripper.open_width)
    shown = [posture(dict(zip(ROBOT.joints, q.tolist(), strict=True)) | ROBOT.still | fingers) for q in found]
    return tuple(shown[k] for k in registration().telling(shown))


def posture(positions: dict[str, float]) -> Posture:
    values = np.array([positions[name] for name in ROBOT.joint_names])
    return Posture(ROBOT.joint_names, values, ROBOT.camera_pose(ROBOT.joint_names, values))


@cache
def sights() -> tuple[Sight, ...]:
    """What a noisy camera with these errors reads of the robot in three of them."""
    rng, camera = np.random.default_rng(1), SimulatedCamera(Catalogue.shared(CATALOGUE), ROBOT)
    found: list[Sight] = []
    for one in postures()[:3]:
        snapshot = Snapshot(
            names=(), T_base_objects=np.zeros((0, 4, 4)), joint_names=ROBOT.joint_names, joint_positions=one.positions,
            time=0.0, errors=WRONG.at_a_look(rng),
        )  # fmt: skip
        _, depth = camera.image(snapshot, one.T_base_camera)
        found.append(Sight(one, structured_light(depth, ROBOT.camera.K, rng)))
    camera.close()
    return tuple(found)


def test_finds_where_the_depth_camera_stands_and_how_long_its_metre_is() -> None:
    fit = registration().fit(sights())
    assert not fit.doubt and fit.explained > 0.95 and fit.residual < 0.001
    assert fit.depth * WRONG.depth == pytest.approx(1.0, abs=0.002)
    seen = np.array([[x, y, ROBOT.table.height, 1.0] for x in ROBOT.x for y in ROBOT.y]) @ ROBOT.T_camera_base.T
    read = seen * np.append(np.full(3, WRONG.depth * fit.depth), 1.0)
    off = np.linalg.norm(read @ fit.T_believed_true.T - seen @ DEPTH_CAMERA.T, axis=1)
    assert off.max() < 0.001, "of what stands at the corners of the workspace"
    assert (fit.deviations < PRIOR / 3).all()


def test_what_does_not_look_like_the_robot_is_refused() -> None:
    elsewhere = [Sight(one.posture, np.full_like(one.depth, 1.2)) for one in sights()]
    fit = registration().fit(elsewhere)
    assert "of the readings where the arm should be lie on it; 80% must" in fit.doubt


def test_a_camera_that_is_farther_off_than_was_declared_is_refused() -> None:
    off = pose(np.eye(3), np.array([0.0, 0.03, 0.0]))
    moved = [Sight(Posture(s.posture.joint_names, s.posture.positions, s.posture.T_base_camera @ off), s.depth)
             for s in sights()]  # fmt: skip
    fit = registration().fit(moved)
    assert fit.doubt


def test_the_most_telling_posture_comes_first() -> None:
    beside = posture(dict(zip(ROBOT.joint_names, _at_home(), strict=True)))
    order = list(registration().telling([beside, *postures()]))
    assert order[:3] == [1, 2, 3], "at home the arm is out of sight"


def test_an_arm_right_before_the_camera_tells_nothing() -> None:
    beyond = postures()[0]
    back = pose(np.eye(3), np.array([0.0, 0.0, 0.5]))  # what was 0.6 to 0.9 m away is before the camera's first reading
    near = Posture(beyond.joint_names, beyond.positions, beyond.T_base_camera @ back)
    assert list(registration().telling([near, beyond])) == [1, 0]


def _at_home() -> Floats:
    positions = ROBOT.posture | ROBOT.gripper.posture(ROBOT.gripper.open_width)
    return np.array([positions[name] for name in ROBOT.joint_names])
