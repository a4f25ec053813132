"""Pose errors against cases worked out by hand."""

import numpy as np
import pytest

from stages.geometry.poses import exp_so3, pose
from stages.scene.catalogue import Symmetries
from stages.scene.metrics import (
    add,
    add_s,
    area_under_curve,
    average_recall,
    is_near_flip,
    mssd,
    nearest_symmetries,
    pose_errors,
    vsd,
)

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


def test_a_turn_about_a_continuous_axis_is_no_error_whatever_its_angle() -> None:
    offset = np.array([0.3, 0.0, 0.0])  # The axis does not go through the origin.
    over = pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    can = Symmetries(discrete=over[None], continuous=((np.array([0.0, 0.0, 1.0]), offset),), near=np.zeros((0, 4, 4)))
    turn = exp_so3(np.array([0.0, 0.0, 0.6123]))
    tilt = pose(exp_so3(np.array([0.0, 0.05, 0.0])), np.zeros(3))
    T_true = pose(exp_so3(np.array([0.4, -0.2, 1.0])), np.array([0.1, 0.2, 0.9]))
    turned = T_true @ over @ pose(turn, offset - turn @ offset)
    assert pose_errors(turned, T_true, nearest_symmetries(turned, T_true, can)) == pytest.approx((0, 0), abs=1e-9)
    tilted = turned @ tilt
    assert pose_errors(tilted, T_true, nearest_symmetries(tilted, T_true, can))[1] == pytest.approx(0.05)


def test_a_near_flip_is_told_from_a_random_error() -> None:
    half = pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    symmetries = Symmetries(discrete=np.zeros((0, 4, 4)), continuous=(), near=half[None])
    assert is_near_flip(half, np.eye(4), symmetries, tolerance=0.2)
    assert not is_near_flip(np.eye(4), np.eye(4), symmetries, tolerance=0.2)
    assert not is_near_flip(QUARTER, np.eye(4), symmetries, tolerance=0.2)


CUBE = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])


def test_mssd_of_a_translated_cube_is_the_translation() -> None:
    shift = pose(np.eye(3), np.array([0.03, 0.0, -0.04]))
    assert mssd(shift, np.eye(4), CUBE, np.eye(4)[None]) == pytest.approx(0.05)


def test_mssd_of_a_turned_cube_depends_on_whether_it_is_symmetric() -> None:
    # A quarter turn moves a corner along a chord of sqrt(2) times its distance from the axis, 0.1 sqrt(2).
    assert mssd(QUARTER, np.eye(4), CUBE, np.eye(4)[None]) == pytest.approx(0.2)
    assert mssd(QUARTER, np.eye(4), CUBE, np.stack([np.eye(4), QUARTER])) == pytest.approx(0, abs=1e-9)


def test_mssd_knows_no_near_symmetry_and_takes_the_farthest_point() -> None:
    half = pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    assert mssd(half, np.eye(4), CUBE, np.eye(4)[None]) == pytest.approx(0.2 * np.sqrt(2))
    assert add(half, np.eye(4), np.vstack([CUBE, np.zeros(3)])) < mssd(half, np.eye(4), CUBE, np.eye(4)[None])


# A camera far away in effect: rays are parallel, so that distances along them are depths.
FAR_K = np.array([[1e9, 0, 0], [0, 1e9, 0], [0, 0, 1.0]])


def test_vsd_on_four_pixels() -> None:
    truth = np.array([[1.0, 1.0], [1.0, 0.0]])
    estimate = np.array([[1.01, 1.03], [0.0, 1.0]])
    observed = np.array([[1.0, 1.0], [1.0, 1.0]])
    # Union: all four. (0,0) 1 cm off, (0,1) 3 cm off and 15 mm behind it yet visible as the truth is there,
    # (1,0) and (1,1) belong to one of the two only.
    errors = vsd(estimate, truth, observed, FAR_K, np.array([0.005, 0.02, 0.05]))
    assert errors == pytest.approx([1.0, 0.75, 0.5])


def test_vsd_leaves_out_what_is_hidden_and_keeps_what_was_not_observed() -> None:
    truth = np.array([[1.0, 1.0], [1.0, 1.0]])
    estimate = np.array([[1.0, 1.0], [1.0, 0.0]])
    observed = np.array([[0.5, 1.0], [0.0, 0.0]])  # Something in front, the object, no readings.
    assert vsd(estimate, truth, observed, FAR_K, np.array([0.01])) == pytest.approx([1 / 3])
    nothing = np.zeros((2, 2))
    assert vsd(nothing, nothing, observed, FAR_K, np.array([0.01])) == pytest.approx([1.0])


def test_vsd_measures_along_the_ray() -> None:
    K = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])  # Pixel (1, 0) is seen at 45 degrees.
    one, other = np.array([[0.0, 1.0]]), np.array([[0.0, 1.01]])
    assert vsd(one, other, one, K, np.array([0.012, 0.0142])) == pytest.approx([1.0, 0.0])


def test_recall_is_averaged_over_thresholds() -> None:
    assert average_recall(np.array([0.0, 0.12, np.inf])) == pytest.approx((10 + 8) / 30)


def test_the_area_under_the_curve_is_one_for_no_error_and_falls_linearly() -> None:
    assert area_under_curve(np.array([0.0, 0.025, 0.1, np.inf])) == pytest.approx((1 + 0.75) / 4)
