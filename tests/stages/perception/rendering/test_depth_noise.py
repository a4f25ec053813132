"""Statistics of the structured-light noise on scenes whose perfect depth is known."""

import numpy as np
import pytest

from stages.geometry.camera import intrinsics
from stages.perception.rendering.depth_noise import StructuredLight, color_noise, structured_light

K = intrinsics(540.0, 640, 480)
SENSOR = StructuredLight()


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def wall(z: float) -> np.ndarray:
    return np.full((480, 640), z, np.float32)


def step() -> np.ndarray:
    """A box's front 10 cm before a wall."""
    depth = wall(1.0)
    depth[150:330, 250:390] = 0.9
    return depth


def errors(z: float) -> np.ndarray:
    measured = structured_light(wall(z), K, rng())
    return (measured - z)[measured > 0]


@pytest.mark.parametrize("z", [0.6, 1.0, 2.0])
def test_axial_noise_grows_with_the_square_of_the_distance(z: float) -> None:
    disparity_error = np.hypot(SENSOR.disparity_sigma, SENSOR.disparity_step / np.sqrt(12))
    expected = z**2 / (K[0, 0] * SENSOR.baseline) * disparity_error
    # On a wall at one depth, rounding is not uniform: the step's share differs from place to place.
    assert 0.4 * expected < errors(z).std() < 1.7 * expected
    assert abs(errors(z).mean()) < 0.8 * z**2 / (K[0, 0] * SENSOR.baseline) * SENSOR.disparity_step


def test_noise_on_a_slanted_plane_has_no_bias() -> None:
    z = np.tile(np.linspace(0.8, 1.2, 480, dtype=np.float32)[:, None], (1, 640))
    measured = structured_light(z, K, rng())
    error = (measured - z)[measured > 0]
    assert abs(error.mean()) < 2e-4
    assert 0.0008 < error.std() < 0.003


def test_disparities_come_in_steps() -> None:
    measured = structured_light(wall(1.0), K, rng())
    steps = K[0, 0] * SENSOR.baseline / measured[measured > 0] / SENSOR.disparity_step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)


def test_few_readings_are_lost_on_a_wall() -> None:
    lost = (structured_light(wall(1.0), K, rng()) == 0).mean()
    assert 0.5 * SENSOR.holes < lost < 2 * SENSOR.holes


def test_shadow_lies_left_of_what_is_in_front_and_is_as_wide_as_the_disparity() -> None:
    lost = structured_light(step(), K, rng()) == 0
    width = K[0, 0] * SENSOR.baseline * (1 / 0.9 - 1 / 1.0)
    per_row = lost[200:280, 250 - 20 : 248].sum(1).mean()
    assert per_row == pytest.approx(width - 2, abs=1.5)
    assert lost[200:280, 395:420].mean() < 0.02


def test_edges_fray_and_some_pixels_fly_between_the_surfaces() -> None:
    measured = structured_light(step(), K, rng())
    right = measured[160:320, 387:393]
    assert 0.1 < (right == 0).mean() < 0.5
    flying = (right > 0.915) & (right < 0.985)
    assert 0.01 < flying.mean() < 0.2
    inside = measured[170:310, 270:370]
    assert not ((inside > 0.915) | ((inside > 0) & (inside < 0.885))).any()


@pytest.mark.parametrize(("degrees", "low", "high"), [(45, 0.0, 0.05), (65, 0.0, 0.05), (80, 0.3, 0.7), (88, 0.8, 1.0)])
def test_readings_are_lost_at_grazing_angles(degrees: float, low: float, high: float) -> None:
    """A plane through (0, 0, 1), turned about the vertical: its ray's angle to the normal is ``degrees`` there."""
    x = (np.arange(640) - K[0, 2]) / K[0, 0]
    depth = np.tile(1 / (1 - x * np.tan(np.deg2rad(degrees)) + 1e-12), (480, 1)).astype(np.float32)
    depth[(depth < 0.1) | (depth > 10)] = 0
    lost = structured_light(depth, K, rng())[:, 316:324] == 0
    assert low <= lost.mean() <= high


def test_readings_end_at_the_range_limits_and_where_there_is_nothing() -> None:
    for z in (0.0, 0.2, 5.0):
        assert (structured_light(wall(z), K, rng()) == 0).all()


def test_noise_depends_on_the_generator_alone() -> None:
    first, second, other = (structured_light(step(), K, rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert (first != other).any()
    assert first.dtype == np.float32 and (first >= 0).all()


def test_color_noise_is_slight_and_unbiased() -> None:
    grey = np.full((100, 100, 3), 120, np.uint8)
    noisy = color_noise(grey, rng(), sigma=2.0).astype(float)
    assert noisy.mean() == pytest.approx(120, abs=0.1)
    assert noisy.std() == pytest.approx(2.0, abs=0.1)
    assert (color_noise(np.full((9, 9, 3), 255, np.uint8), rng()) > 240).all()
