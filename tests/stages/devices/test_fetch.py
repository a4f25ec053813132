import numpy as np

from stages.devices import fetch
from stages.devices.tabletop import TABLE

HOME = tuple(fetch.HOME), np.array(list(fetch.HOME.values()))


def test_the_head_camera_looks_down_at_the_table() -> None:
    T_camera_base = np.linalg.inv(fetch.camera_pose(*HOME))
    for x in (0.5, 0.75):
        for y in (-0.4, 0.4):
            point = T_camera_base @ [x, y, TABLE.height, 1]
            u, v = 540 * point[:2] / point[2]
            assert abs(u) < 320, (x, y)
            assert abs(v) < 240, (x, y)


def test_meshes_and_links_belong_together() -> None:
    links = fetch.link_poses(*HOME)
    meshes = dict(fetch.robot_meshes())
    assert set(meshes) <= set(links)
    assert {"gripper_link", "r_gripper_finger_link", "l_gripper_finger_link"} <= set(meshes)
    for mesh in meshes.values():
        assert mesh.colors.shape == mesh.vertices.shape
        assert mesh.faces.max() < len(mesh.vertices)


def test_the_torso_carries_the_camera() -> None:
    names, positions = HOME
    lowered = positions.copy()
    lowered[names.index("torso_lift_joint")] -= 0.2
    difference = fetch.camera_pose(names, positions) - fetch.camera_pose(names, lowered)
    np.testing.assert_allclose(difference[:3, 3], [0, 0, 0.2], atol=1e-9)


def test_the_arm_at_home_is_outside_the_cameras_image() -> None:
    T_camera_base = np.linalg.inv(fetch.camera_pose(*HOME))
    links = fetch.link_poses(*HOME)
    for link, mesh in fetch.robot_meshes():
        if not any(part in link for part in ("shoulder", "arm", "elbow", "wrist", "gripper")):
            continue
        T = T_camera_base @ links[link]
        points = mesh.vertices @ T[:3, :3].T + T[:3, 3]
        ahead = points[points[:, 2] > 0.05]
        pixels = np.abs(540 * ahead[:, :2] / ahead[:, 2:])
        assert not ((pixels[:, 0] < 320) & (pixels[:, 1] < 240)).any(), link


def test_widths_and_finger_positions_invert_each_other() -> None:
    for width in (0.01, 0.05, 0.10):
        assert np.isclose(fetch.GRIPPER.width(fetch.GRIPPER.finger(width)), width)
