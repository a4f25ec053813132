"""Resting poses, vessels and widths of shapes whose answers are known."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.scene.catalogue import Mesh
from stages.scene.catalogue.household_meshes import bowl, mug, soup_can, tray
from stages.scene.catalogue.mesh_shape import (
    axis_rotation,
    holds_water,
    resting_rotations,
    transform,
    turned_up,
    width_between,
)

DOWN = np.diag([1.0, -1.0, -1.0])
directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1).map(np.array)


def box(*extents: float) -> Mesh:
    shape = trimesh.creation.box(extents)
    return Mesh(np.asarray(shape.vertices), np.asarray(shape.faces, np.int32), np.zeros((8, 3), np.uint8))


@given(directions)
def test_turned_up_turns_the_direction_up(direction: np.ndarray) -> None:
    R = turned_up(direction)
    np.testing.assert_allclose(R @ direction, [0, 0, np.linalg.norm(direction)], atol=1e-8)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)


@given(directions, st.floats(-np.pi, np.pi))
def test_axis_rotation_keeps_its_axis_and_turns_by_its_angle(axis: np.ndarray, angle: float) -> None:
    R = axis_rotation(axis, angle)
    np.testing.assert_allclose(R @ axis, axis, atol=1e-9)
    assert np.trace(R) == pytest.approx(1 + 2 * np.cos(angle))


@settings(max_examples=25)
@given(st.tuples(*[st.floats(0.02, 0.3)] * 3))
def test_a_box_rests_on_each_of_its_six_faces_upright_first(extents: tuple[float, float, float]) -> None:
    rotations = resting_rotations(box(*extents))
    assert len(rotations) == 6
    np.testing.assert_allclose(rotations[0], np.eye(3), atol=1e-9)
    ups = {tuple(np.round(R[2]).astype(int)) for R in rotations}
    assert len(ups) == 6


def test_a_pole_rests_on_no_tip() -> None:
    cone = trimesh.creation.cone(radius=0.03, height=0.2)
    mesh = Mesh(
        np.asarray(cone.vertices), np.asarray(cone.faces, np.int32), np.zeros((len(cone.vertices), 3), np.uint8)
    )
    assert all(R[2, 2] > -0.5 for R in resting_rotations(mesh))


@pytest.mark.parametrize(("build", "expected"), [(bowl, True), (mug, True), (tray, True), (soup_can, False)])
def test_vessels_hold_water(build, expected: bool) -> None:
    mesh = build()
    assert holds_water(mesh) is expected
    upside_down = Mesh(mesh.vertices @ DOWN.T, mesh.faces, mesh.colors)
    assert not holds_water(upside_down)


def test_coarse_boxes_hold_no_water() -> None:
    assert not holds_water(box(0.2, 0.01, 0.1))


def test_width_is_measured_between_the_fingers() -> None:
    R = np.column_stack([[0, 0, -1.0], [1.0, 0, 0], [0, -1.0, 0]])
    assert width_between(soup_can(), transform(R, np.array([0, 0, 0.01]))) == pytest.approx(0.068, abs=5e-4)
    above = transform(R, np.array([0, 0, 1.0]))
    assert width_between(soup_can(), above) == pytest.approx(0.068, abs=5e-4)
