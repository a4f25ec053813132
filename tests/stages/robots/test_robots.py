"""Descriptions: what they say is true of the model, and nothing else in the source names a robot."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh.creation

import stages.robots
from runner.contract import Refused
from stages.devices.check_robot import report
from stages.geometry.camera import project
from stages.geometry.poses import exp_so3, inverse, pose
from stages.planning.motion.collision import CollisionWorld
from stages.robots import BESIDE, Robot, Table, read_robot

HERE = Path(__file__).parent
FOLDER = Path(stages.robots.__file__).parent
ALL = sorted(path.stem for path in FOLDER.glob("*.yaml"))


@pytest.fixture(params=ALL)
def robot(request: pytest.FixtureRequest) -> Robot:
    return read_robot(FOLDER / f"{request.param}.yaml")


def at_home(robot: Robot) -> tuple[tuple[str, ...], np.ndarray]:
    return tuple(robot.posture), np.array(list(robot.posture.values()))


def pixels(robot: Robot, points: np.ndarray) -> np.ndarray:
    """Of points in the base frame, N x 2, from the middle of the image; nan behind the camera."""
    seen = points @ robot.T_camera_base[:3, :3].T + robot.T_camera_base[:3, 3]
    return np.where(seen[:, 2:] > 0.05, robot.camera.focal * seen[:, :2] / seen[:, 2:], np.nan)


def test_the_camera_sees_where_the_robot_places(robot: Robot) -> None:
    corners = [[x, 0.95 * y, robot.table.height] for x in robot.x for y in robot.y]
    assert (np.abs(pixels(robot, np.array(corners))) < np.array(robot.camera.size) / 2).all()


def test_the_camera_sees_it_from_every_view_too(robot: Robot) -> None:
    world, corners = (
        CollisionWorld(robot, robot.table, {}),
        [[x, y, robot.table.height] for x in robot.x for y in robot.y],
    )
    for q in robot.views:
        assert world.is_free(q)
        posture = robot.posture | dict(zip(robot.joints, q.tolist(), strict=True))
        T_camera_base = inverse(robot.camera_pose(tuple(posture), np.array(list(posture.values()))))
        seen = project(np.array(corners) @ T_camera_base[:3, :3].T + T_camera_base[:3, 3], robot.camera.K)
        assert ((seen > 0) & (seen < robot.camera.size)).all()


def test_the_arm_at_home_is_outside_the_cameras_image(robot: Robot) -> None:
    for mesh, T in robot.links(*at_home(robot)):
        inside = np.abs(pixels(robot, mesh.vertices @ T[:3, :3].T + T[:3, 3])) < np.array(robot.camera.size) / 2
        assert not inside.all(1).any()


def test_meshes_and_links_belong_together(robot: Robot) -> None:
    links = robot.body.link_poses(*at_home(robot))
    assert {link for link, _ in robot.body.meshes} <= set(links)
    for _, mesh in robot.body.meshes:
        assert mesh.colors.shape == mesh.vertices.shape
        assert mesh.faces.max() < len(mesh.vertices)


def test_widths_and_finger_positions_invert_each_other(robot: Robot) -> None:
    for width in (0.01, 0.03, 0.06):
        assert np.isclose(robot.gripper.width(robot.gripper.finger_position(width)), width)


def test_the_torso_carries_the_camera() -> None:
    robot = read_robot(FOLDER / "fetch.yaml")
    names, positions = at_home(robot)
    lowered = positions.copy()
    lowered[names.index("torso_lift_joint")] -= 0.2
    difference = robot.camera_pose(names, positions) - robot.camera_pose(names, lowered)
    np.testing.assert_allclose(difference[:3, 3], [0, 0, 0.2], atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "elbow_flex_joint: {",
            "elbow_joint: {",
            r":\d+: joints\.elbow_joint: 'elbow_joint' is not in the model, which has",
        ),
        (
            "  elbow_flex_joint: {",
            "  # elbow_flex_joint: {",
            r":\d+: joints: elbow_flex_joint on the way to the hand: name each here or under still",
        ),
        ("link: gripper_link", "link: grip", r":\d+: gripper\.link: 'grip' is not in the model"),
        ("gymnasium_robotics/", "gymnasium_robot/", r"model\[0\]\.folder: .* 'gymnasium_robot' is not installed"),
        ("velocity: 0.10,", "", r"joints\.torso_lift_joint: the key 'velocity' is missing"),
        ("x: [0.45, 0.80]", "x: [0.8, 0.4]", r"workspace\.x: \[0\.8, 0\.4\] is not \[lowest, highest\]"),
        ("fetch/robot.xml", "fetch/robots.xml", r"MuJoCo cannot read the model: .*robots\.xml"),
        ("still:", "touching: []\nstill:", r"the key 'touching' stands there twice"),
        (
            "servo: {kp: 1500, kv: 120, effort: 66.2, armature: 0.3}",
            "",
            r"no actuator for 'elbow_flex_joint'; give it a servo",
        ),
        (
            "  servo: {kp: 2000, kv: 200, effort: 60, armature: 0.5, damping: 5.0}",
            "",
            r"gripper: the model has no actuator",
        ),
        ('meshdir="stls/fetch"', 'meshdir="stl"', r"model: MuJoCo cannot build it: .*stl/"),
        (
            "still:",
            "views: [{torso_joint: 0.2}]\nstill:",
            r"views\[0\]\.torso_joint: unknown key; valid are torso_lift",
        ),
        ("touching:", "touch:", r"touch: unknown key; valid are model, remove"),
        ("  - [base_link, torso_fixed_link]", "  - base_link", r":23: touching: 'base_link' is not a pair of links"),
        ("{range: [0.0, 0.38615]}", "{rnage: [0, 1]}", r":20: change.*\.rnage: unknown attribute; valid are .* range,"),
        ("{range: [0.0, 0.38615]}", "{range: wide}", r":20: change.*\.range: 'wide' cannot be set"),
        ("remove: [", "remove: [1, ", r":\d+: remove: \[1, .* is not a list of texts"),
        ("[r_gripper_finger_joint, l", "[1, l", r":62: gripper\.fingers: \[1, .* is not a list of texts"),
        ("0.1018]]", "wide]]", r":63: gripper\.widths: .*at least two pairs \[position of a finger joint, metres"),
        ("0.1018]]", "101.8]]", r":63: gripper\.widths: 101\.8 m between the fingers; metres below 0\.5 are valid"),
        ("0.1018]]", "0.0018]]", r":63: gripper\.widths: .*the widths must rise, or fall, at every step"),
        ("[0.05, 0.1018]]", "[0.0, 0.1018]]", r":63: gripper\.widths: .*must rise, or fall, at every step"),
        ("closed_width: 0.0018", "closed_width: 0.2", r":64: gripper\.closed_width: 0\.2 m is not below open_width"),
        ("open_width: 0.1018", "open_width: 0.2", r":65: gripper\.open_width: 0\.2 m is more than the largest of w"),
        ("widest: 0.095", "widest: 0.11", r":66: gripper\.widest: 0\.11 m is more than open_width, 0\.1018 m"),
        ("size: [640, 480]", "size: [0, 0]", r":70: camera\.size: \[0\.0, 0\.0\] is not \[width, height\], whole"),
    ],
)
def test_what_is_wrong_is_named(old: str, new: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text((FOLDER / "fetch.yaml").read_text().replace(old, new, 1))
    with pytest.raises(Refused, match=message):
        read_robot(file)


def test_a_camera_on_a_head_looks_from_where_the_torso_has_it(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(f"like: {FOLDER}/fetch.yaml\nviews:\n  - {{torso_lift_joint: 0.2}}\n")
    robot = read_robot(file)
    (view,) = robot.views
    assert view[0] == 0.2 and np.array_equal(view[1:], robot.home[1:])
    assert CollisionWorld(robot, robot.table, {}).is_free(view)


def test_a_description_may_be_like_another(tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(f"like: {FOLDER}/ur5e.yaml\nfloor: -0.9\n")
    robot, other = read_robot(file), read_robot(FOLDER / "ur5e.yaml")
    assert (robot.floor, other.floor) == (-0.9, -0.7)
    assert robot.posture == other.posture


def test_descriptions_that_are_like_each_other_are_refused(tmp_path: Path) -> None:
    file, other = tmp_path / "robot.yaml", tmp_path / "other.yaml"
    file.write_text("like: other.yaml\n")
    other.write_text("floor: 0\nlike: robot.yaml\n")
    with pytest.raises(Refused, match=r"other\.yaml:2: like: .*: robot\.yaml is like other\.yaml is like robot\.yaml"):
        read_robot(file)


def test_a_description_is_tried_before_it_is_used() -> None:
    tried = "\n".join(report(read_robot(HERE / "arm.yaml")))
    assert "6 moved, 0 still, 2 of the gripper" in tried
    assert "at home  free" in tried
    assert "reach    42 of 42" in tried
    assert "sees all of the workspace" in tried


def test_meshes_of_a_urdf_are_found_in_its_packages(tmp_path: Path) -> None:
    (tmp_path / "lab_arm" / "meshes").mkdir(parents=True)
    trimesh.creation.box((0.05, 0.16, 0.03)).export(tmp_path / "lab_arm" / "meshes" / "hand.stl")
    for name in ("arm.yaml", "arm.urdf"):
        mesh = '<mesh filename="package://lab_arm/meshes/hand.stl"/>'
        (tmp_path / name).write_text((HERE / name).read_text().replace('<box size="0.05 0.16 0.03"/>', mesh))
    (hand,) = [mesh for link, mesh in read_robot(tmp_path / "arm.yaml").body.meshes if link == "hand"]
    np.testing.assert_allclose(np.ptp(hand.vertices, axis=0), (0.05, 0.16, 0.03), atol=1e-6)


def test_no_source_names_a_robot() -> None:
    names = re.compile(r"\b(fetch|ur5e|panda|robotiq)(?!ed)", re.IGNORECASE)
    named = [
        f"{path.relative_to(FOLDER.parent)}: {line.strip()}"
        for path in sorted(FOLDER.parent.rglob("*.py"))
        for line in path.read_text().splitlines()
        if names.search(line)
    ]
    assert named == ['robots/robot.py: BUILT_IN = Path(__file__).parent / "fetch.yaml"']


def test_a_table_reaches_as_far_as_it_is_seen_and_further_to_the_sides() -> None:
    declared = Table(center=(0.8, 0.0), size=(0.7, 1.2), height=0.7)
    T_base_table = pose(exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.array([0.8, 0.1, 0.73]))
    corners = np.array([[-0.8, -0.1], [0.5, -0.1], [0.5, 0.39], [-0.8, 0.39]])
    # In the base frame from (0.41, -0.7) to (0.9, 0.6).
    seen = declared.seen(T_base_table, corners)
    assert (*seen.center, *seen.size) == pytest.approx((0.78, -0.05, 0.74, 1.3 + 2 * BESIDE))
    assert (seen.height, seen.thickness) == (pytest.approx(0.73), declared.thickness)


def test_a_table_of_which_less_is_seen_reaches_as_far_as_it_is_declared() -> None:
    declared = Table(center=(0.8, 0.0), size=(0.7, 1.2), height=0.7)
    T_base_table = pose(np.eye(3), np.array([0.8, 0.0, 0.68]))
    for corners in (None, 0.1 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])):
        seen = declared.seen(T_base_table, corners)
        assert (*seen.center, *seen.size, seen.height) == pytest.approx((0.8, 0.0, 0.7, 1.2 + 2 * BESIDE, 0.68))
