"""Poses are proposed that the arm reaches, from which the board is seen, and that tell where camera and board are."""

from dataclasses import replace

import numpy as np
import pytest

from stages.geometry.camera import project
from stages.geometry.poses import inverse
from stages.hand_eye.board import Board
from stages.hand_eye.limits import Limits
from stages.hand_eye.poses import Sightlines, nearest_first, proposed
from stages.hand_eye.rig import Rig
from stages.hand_eye.routine import too_alike
from stages.hand_eye.solving import Sight
from stages.planning.motion.collision import CollisionWorld
from stages.robots import read_robot
from tests.stages.robots.test_robots import FOLDER

COUNT = 7


@pytest.mark.parametrize("name", ["fetch", "ur5e_hand"])
def test_poses_are_free_show_the_board_and_differ(name: str) -> None:
    rig = Rig(read_robot(FOLDER / f"{name}.yaml"), Board())
    robot = rig.with_board(rig.Y, clearance=0.03)
    world = CollisionWorld(robot, robot.table, {}, clearance=0.02)
    postures = proposed(rig, world, Sightlines(robot), COUNT, np.random.default_rng(0))
    assert len(postures) == COUNT
    sights: list[Sight] = []
    for q in postures:
        assert world.is_free(q)
        A = rig.between(dict(zip(robot.joints, q.tolist(), strict=True)))
        T = inverse(rig.X) @ A @ rig.Y
        pixels = project(rig.board.rim @ T[:3, :3].T + T[:3, 3], robot.camera.K)
        assert (T[:3, 3] @ T[:3, 2] > 0) and (pixels > 0).all() and (pixels < robot.camera.size).all()
        sights.append(Sight(A, rig.board.corners, np.zeros((24, 2)), robot.camera.K))
    assert too_alike(sights, Limits(), "") == ""
    ordered = nearest_first(postures, robot.home)
    assert sorted(map(tuple, ordered)) == sorted(map(tuple, postures))


def test_a_board_behind_the_table_is_not_seen() -> None:
    rig = Rig(read_robot(FOLDER / "ur5e.yaml"), Board())
    lines = Sightlines(rig.with_board(rig.Y))
    eye = inverse(rig.robot.T_camera_base)[:3, 3]
    x, y = rig.robot.table.center
    above, below = (np.array([[x, y, rig.robot.table.height + z]]) for z in (0.1, -0.2))
    assert lines.reach(rig.robot.home, eye, above) and not lines.reach(rig.robot.home, eye, below)


def test_a_description_may_say_where_the_board_is() -> None:
    robot = read_robot(FOLDER / "ur5e_hand.yaml")
    told = Rig(robot, replace(Board(), position=(0.5, 0.1, 0.2), rotation=(180.0, 0.0, 0.0)))
    np.testing.assert_allclose(told.Y[:3, 3], (0.5, 0.1, 0.2))
    np.testing.assert_allclose(told.Y[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-9)
