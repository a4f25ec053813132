"""Rotations: exponential map, distances, symmetry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.geometry.poses import (
    cube_rotations,
    exp_so3,
    inverse,
    log_so3,
    pose,
    random_rotations,
    rotation_angle,
    symmetry_angle,
)

vectors = st.tuples(*[st.floats(-1.8, 1.8)] * 3).map(np.array)


@given(vectors)
def test_log_undoes_exp(vector: np.ndarray) -> None:
    assert log_so3(exp_so3(vector)) == pytest.approx(vector, abs=1e-9)


@given(vectors, vectors)
def test_angle_is_the_length_of_the_relative_rotation_vector(a: np.ndarray, b: np.ndarray) -> None:
    A, B = exp_so3(a), exp_so3(b)
    assert rotation_angle(A, B) == pytest.approx(np.linalg.norm(log_so3(A.T @ B)), abs=1e-7)


def test_a_half_turn_has_a_rotation_vector_of_length_pi() -> None:
    assert np.linalg.norm(log_so3(np.diag([1.0, -1.0, -1.0]))) == pytest.approx(np.pi)


def test_random_rotations_are_rotations_and_uniform() -> None:
    R = random_rotations(20000, np.random.default_rng(0))
    assert R @ np.swapaxes(R, 1, 2) == pytest.approx(np.broadcast_to(np.eye(3), R.shape), abs=1e-12)
    assert np.linalg.det(R) == pytest.approx(np.ones(len(R)))
    assert R.mean(0) == pytest.approx(np.zeros((3, 3)), abs=0.02)


def test_symmetry_takes_the_nearest_equivalent() -> None:
    half_turn = pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    R = exp_so3(np.array([0.0, 0.0, np.pi - 0.1]))
    assert symmetry_angle(R, np.eye(3), np.stack([np.eye(4), half_turn])) == pytest.approx(0.1)


def test_the_cube_has_24_rotations() -> None:
    R = cube_rotations()
    assert len(R) == 24 and np.array_equal(R[0], np.eye(3)) and len(np.unique(R, axis=0)) == 24


def test_inverse() -> None:
    T = pose(exp_so3(np.array([0.3, -0.2, 1.0])), np.array([1.0, 2.0, 3.0]))
    assert inverse(T) @ T == pytest.approx(np.eye(4))
