"""The pinhole camera: projecting and back-projecting undo each other, also after scaling and cropping."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.geometry.camera import (
    back_project,
    checked_depth,
    checked_intrinsics,
    cropped,
    intrinsics,
    project,
    ray_factors,
    rays,
    scaled,
)

K = np.array([[525.0, 0, 319.5], [0, 530.0, 231.2], [0, 0, 1]])
numbers = st.floats(-0.5, 0.5)


def test_back_projection_undoes_projection() -> None:
    depth = np.random.default_rng(0).uniform(0.4, 3, (12, 16)).astype(np.float32)
    pixels = project(back_project(depth, K), K)
    np.testing.assert_allclose(pixels[..., 0], np.tile(np.arange(16), (12, 1)), atol=1e-9)
    np.testing.assert_allclose(pixels[..., 1], np.tile(np.arange(12)[:, None], (1, 16)), atol=1e-9)


def test_no_reading_is_the_origin() -> None:
    assert (back_project(np.zeros((3, 4), np.float32), K) == 0).all()


def test_ray_factor_is_the_distance_per_depth() -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    np.testing.assert_allclose(2 * ray_factors(K, 6, 8), np.linalg.norm(back_project(depth, K), axis=-1))
    assert (rays(K, 6, 8)[..., 2] == 1).all()


@given(numbers, numbers, st.floats(0.3, 3), st.floats(0.1, 4))
def test_scaled_camera_sees_the_point_at_the_scaled_place(x: float, y: float, z: float, factor: float) -> None:
    u, v = project(np.array([x, y, z]), K)
    expected = [(u + 0.5) * factor - 0.5, (v + 0.5) * factor - 0.5]
    np.testing.assert_allclose(project(np.array([x, y, z]), scaled(K, factor)), expected, atol=1e-9)


def test_scaling_agrees_with_area_resizing() -> None:
    ramp = np.tile(np.arange(40, dtype=np.float64), (30, 1))
    small = cv2.resize(ramp, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    x = rays(K, 30, 40)[0, :, 0]
    np.testing.assert_allclose(rays(scaled(K, 0.5), 15, 20)[0, :, 0], np.interp(small[0], np.arange(40), x), atol=1e-9)


@given(numbers, numbers, st.floats(0.3, 3), st.integers(0, 300), st.integers(0, 300))
def test_cropped_camera_sees_the_point_relative_to_the_corner(x: float, y: float, z: float, x0: int, y0: int) -> None:
    pixel = project(np.array([x, y, z]), K)
    np.testing.assert_allclose(project(np.array([x, y, z]), cropped(K, x0, y0)), pixel - [x0, y0], atol=1e-9)


def test_ideal_camera_looks_through_the_middle() -> None:
    assert tuple(intrinsics(500.0, 640, 480)[:2, 2]) == (319.5, 239.5)


@pytest.mark.parametrize(
    ("row", "column", "value"), [(0, 1, 2.0), (1, 0, 0.1), (2, 2, 2.0), (1, 1, 0.0), (0, 2, np.nan)]
)
def test_a_matrix_that_is_no_pinhole_cameras_is_refused(row: int, column: int, value: float) -> None:
    assert checked_intrinsics(K) is K
    wrong = K.copy()
    wrong[row, column] = value
    with pytest.raises(ValueError, match=rf"K = .*{value}.*: must be fx 0 cx, 0 fy cy, 0 0 1 .* without skew"):
        checked_intrinsics(wrong)


def test_depth_that_cannot_be_metres_is_refused() -> None:
    depth = np.full((3, 4), 1.0, np.float32)
    depth[0] = [0, -5000, np.nan, np.inf]
    assert checked_depth(depth) is depth
    for empty in (np.zeros((3, 4), np.float32), np.zeros((0, 4), np.float32)):
        assert checked_depth(empty) is empty
    with pytest.raises(ValueError, match=r"median depth is 1000 m; metres are expected, 0\.05 to 20"):
        checked_depth(1000 * depth)
    with pytest.raises(ValueError, match=r"median depth is 0\.001 m; metres are expected"):
        checked_depth(depth / 1000)
