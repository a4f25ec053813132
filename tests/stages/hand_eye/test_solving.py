"""Camera and board are found from pictures alone, and how well is said."""

import dataclasses
import re

import numpy as np
import pytest

from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, pose, rotation_angle
from stages.hand_eye.board import Board
from stages.hand_eye.limits import Limits
from stages.hand_eye.rig import Rig
from stages.hand_eye.routine import judged, too_alike
from stages.hand_eye.solving import Fit, left_out, solve, turns
from stages.robots import read_robot
from tests.stages.hand_eye.sights import X, Y, sights
from tests.stages.robots.test_robots import FOLDER


def errors(fit: Fit) -> tuple[float, float]:
    """Millimetres and degrees."""
    return 1e3 * float(np.linalg.norm(fit.X[:3, 3] - X[:3, 3])), float(
        np.rad2deg(rotation_angle(fit.X[:3, :3], X[:3, :3]))
    )


@pytest.mark.parametrize("seed", range(10))
def test_camera_and_board_are_found_without_a_guess(seed: int) -> None:
    fit = solve(sights(12, seed))
    millimetres, degrees = errors(fit)
    assert millimetres < 2.0 and degrees < 0.2
    assert np.linalg.norm(fit.Y[:3, 3] - Y[:3, 3]) < 2e-3
    assert 0.2 < fit.residual < 0.35  # a corner is off along both axes


def test_it_is_exact_without_noise() -> None:
    assert max(errors(solve(sights(6, 0, noise=0.0)))) < 1e-4


def test_how_uncertain_it_is_agrees_with_how_wrong_it_is() -> None:
    fits = [solve(sights(8, seed, noise=0.5)) for seed in range(20)]
    wrong = np.sqrt(np.mean([np.sum((fit.X[:3, 3] - X[:3, 3]) ** 2) for fit in fits]))
    told = np.mean([fit.uncertain[0] for fit in fits])
    assert 0.6 < wrong / told < 1.6


def test_one_wrong_picture_does_not_spoil_it_and_is_named() -> None:
    pictures = sights(12, 0)
    knocked = pose(exp_so3(np.array([0.0, 0.05, 0.0])), np.array([0.02, 0.0, 0.0]))
    pictures[5] = dataclasses.replace(pictures[5], A=pictures[5].A @ knocked)
    fit = solve(pictures)
    assert int(fit.residuals.argmax()) == 5
    assert int(left_out(pictures, fit)[:, 0].argmax()) == 5
    assert errors(fit)[0] < 6.0


def test_left_out_pictures_tell_of_errors_that_grow() -> None:
    quiet, loud = (
        left_out(pictures, solve(pictures)) for pictures in (sights(8, 0, noise=0.1), sights(8, 0, noise=1.0))
    )
    assert (np.median(loud, axis=0) > 4 * np.median(quiet, axis=0)).all()


def test_a_board_printed_too_large_shows_in_the_residual() -> None:
    assert solve(sights(12, 0, square=1.05)).residual > 2 * solve(sights(12, 0)).residual


ONE_AXIS = np.array([[0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("axes", "degrees", "count", "missing"),
    [
        (np.eye(3), 35.0, 4, "the board was found in 4 pictures; at least 6 are needed"),
        (
            np.eye(3),
            4.0,
            10,
            "too alike: boards are turned against each other by .* degrees only; turn it by 24 degrees",
        ),
        (ONE_AXIS, 60.0, 10, "too alike: boards are turned about one axis only, .* in the frame of hand; turn it by"),
    ],
)
def test_poses_that_are_too_alike_are_refused_with_what_is_missing(
    axes: Floats, degrees: float, count: int, missing: str
) -> None:
    assert re.match(missing, too_alike(sights(count, 0, axes=axes, degrees=degrees), Limits(), "hand"))


def test_poses_that_differ_are_not_refused() -> None:
    assert too_alike(sights(8, 0), Limits(), "hand") == ""
    assert np.rad2deg(turns(sights(8, 0))[0][1]) > Limits().turn


def test_pictures_that_contradict_each_other_are_no_calibration() -> None:
    rig = Rig(read_robot(FOLDER / "ur5e_hand.yaml"), Board())
    for square, said in (
        (1.0, "12 boards, residual 0.2"),
        (1.03, "the pictures contradict each other, by more than 1 px or 2 mm"),
    ):
        pictures = sights(12, 0, square=square)
        found = judged(rig, pictures, solve(pictures), Limits())
        assert found.success == (square == 1.0) and found.reason.startswith(said)
