"""Pose errors against cases worked out by hand."""

import numpy as np
import pytest

from stages.perception.metrics import add, add_s, is_near_flip, pose_errors
from stages.perception.poses import exp_so3, pose
from stages.scene.catalogue import Symmetries

SQUARE = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
QUARTER = pose(exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
SHIFT = pose(np.eye(3), np.array([0.0, 0.0, 0.02]))


def test_a_shift_moves_every_point_by_itself() -> None:
    assert add(SHIFT, np.eye(4), SQUARE) == pytest.approx(0.02)
    assert add_s(SHIFT, np.eye(4), SQUARE) == pytest.approx(0.02)


def test_a_quarter_turn_of_a_square_is_seen_by_add_alone() -> None:
    assert add(QUARTER, np.eye(4), SQUARE) == pytest.approx(np.sqrt(2))
    assert add_s(QUARTER, np.eye(4), SQUARE) == pytest.approx(0, abs=1e-9)


def test_errors_modulo_symmetry() -> None:
    T = SHIFT @ QUARTER @ pose(exp_so3(np.array([0.1, 0, 0])), np.zeros(3))
    assert pose_errors(T, np.eye(4), np.stack([np.eye(4), QUARTER])) == pytest.approx((0.02, 0.1))
    assert pose_errors(QUARTER, np.eye(4), np.eye(4)[None]) == pytest.approx((0, np.pi / 2))


def test_a_symmetry_about_an_axis_off_the_origin_moves_the_origin() -> None:
    turn = pose(np.diag([-1.0, -1.0, 1.0]), np.array([0.2, 0.0, 0.0]))
    assert pose_errors(turn, np.eye(4), np.stack([np.eye(4), turn])) == pytest.approx((0, 0), abs=1e-9)


def test_a_near_flip_is_told_from_a_random_error() -> None:
    half = pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    symmetries = Symmetries(discrete=np.zeros((0, 4, 4)), continuous=(), near=half[None])
    assert is_near_flip(half, np.eye(4), symmetries, tolerance=0.2)
    assert not is_near_flip(np.eye(4), np.eye(4), symmetries, tolerance=0.2)
    assert not is_near_flip(QUARTER, np.eye(4), symmetries, tolerance=0.2)
