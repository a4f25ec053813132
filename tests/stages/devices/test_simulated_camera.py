"""The simulated head camera against geometry that is known: the table plane, objects' places, the robot's arm."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import stages.scene
from stages.devices.simulated_camera import ROBOT_MARGIN, SimulatedCamera, robot_pixels
from stages.geometry.arrays import Floats
from stages.geometry.camera import project, rays
from stages.messages import Snapshot
from stages.scene.catalogue import Catalogue
from tests.stages.planning.scenes import ROBOT, TABLE

CATALOGUE = Catalogue.load(Path(stages.scene.__file__).parent / "catalogue.yaml")
FORWARD = dict(zip(ROBOT.joints, (0.30, 0.0, -0.2, 0.0, 0.9, 0.0, 0.8, 0.0), strict=True))


@pytest.fixture(scope="module")
def camera() -> Iterator[SimulatedCamera]:
    camera = SimulatedCamera(CATALOGUE, ROBOT)
    yield camera
    camera.close()


K = ROBOT.camera.K
WIDTH, HEIGHT = ROBOT.camera.size


def standing(name: str, x: float, y: float) -> Floats:
    T = np.eye(4)
    T[:3, 3] = x, y, TABLE.height - CATALOGUE[name].bounds[0, 2]
    return T


def snapshot(joints: dict[str, float] | None = None, **places: tuple[float, float]) -> Snapshot:
    posture = {**ROBOT.posture, **(joints or {})}
    return Snapshot(
        names=tuple(places),
        T_base_objects=np.array([standing(name, *place) for name, place in places.items()]).reshape(-1, 4, 4),
        joint_names=tuple(posture),
        joint_positions=np.array(list(posture.values())),
        time=0.0,
    )


def camera_pose(scene: Snapshot) -> Floats:
    return ROBOT.camera_pose(scene.joint_names, scene.joint_positions)


def table_depth(T_base_camera: Floats) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the plane of the table top at every pixel, and where its ray meets the table; both H x W."""
    directions = rays(K, HEIGHT, WIDTH) @ T_base_camera[:3, :3].T
    depth = (TABLE.height - T_base_camera[2, 3]) / directions[..., 2]
    meets = T_base_camera[:2, 3] + depth[..., None] * directions[..., :2]
    return depth, (np.abs(meets - TABLE.center) < np.array(TABLE.size) / 2 - 0.01).all(-1)


def test_table_plane_is_right_to_a_millimetre(camera: SimulatedCamera) -> None:
    scene = snapshot()
    rgb, depth = camera.image(scene, camera_pose(scene))
    assert rgb.shape == (HEIGHT, WIDTH, 3) and depth.shape == (HEIGHT, WIDTH)
    expected, on_table = table_depth(camera_pose(scene))
    assert on_table.mean() > 0.4
    assert np.abs(depth - expected)[on_table].max() < 0.001


def test_object_appears_where_it_stands_with_its_height_and_colour(camera: SimulatedCamera) -> None:
    scene = snapshot(tea_box=(0.7, 0.1))
    T_base_camera = camera_pose(scene)
    rgb, depth = camera.image(scene, T_base_camera)
    top = np.linalg.inv(T_base_camera) @ [0.7, 0.1, TABLE.height + 0.08, 1]
    u, v = np.round(project(top[:3], K)).astype(int)
    assert depth[v, u] == pytest.approx(top[2], abs=0.001)
    red, green, blue = rgb[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3).mean(0)
    assert green > red + 20 and green > blue + 20


def test_robot_at_home_leaves_the_table_in_view(camera: SimulatedCamera) -> None:
    scene = snapshot()
    T_base_camera = camera_pose(scene)
    depth = camera.image(scene, T_base_camera)[1]
    assert camera.robot_mask(scene, T_base_camera, depth).mean() < 0.02


def test_arm_over_the_table_is_masked_and_nothing_else(camera: SimulatedCamera) -> None:
    scene, empty = snapshot(FORWARD, soup_can=(0.62, 0.35)), snapshot(soup_can=(0.62, 0.35))
    T_base_camera = camera_pose(scene)
    depth, without = camera.image(scene, T_base_camera)[1], camera.image(empty, T_base_camera)[1]
    arm = np.abs(depth - without) > 1e-4
    mask = camera.robot_mask(scene, T_base_camera, depth)
    assert arm.mean() > 0.05
    assert mask[arm].all()
    assert mask.sum() < 1.35 * arm.sum()
    bottom = np.linalg.inv(T_base_camera) @ [0.62, 0.35, TABLE.height + 0.1, 1]
    u, v = np.round(project(bottom[:3], K)).astype(int)
    assert not mask[v - 5 : v + 5, u - 5 : u + 5].any()


def test_readings_well_in_front_of_the_robot_are_not_masked() -> None:
    body = np.zeros((40, 40), np.float32)
    body[10:30, 10:30] = 1.0
    depth = np.full((40, 40), 1.5, np.float32)
    depth[:, :20] = 1.0 - 2 * ROBOT_MARGIN
    depth[20:, 20:] = 0
    mask = robot_pixels(body, depth)
    assert mask[12:28, 20:29].all()
    assert not mask[12:28, 10:16].any()
    assert not mask[:6].any()
