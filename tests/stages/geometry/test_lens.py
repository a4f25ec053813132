"""Lenses are taken out of images: a point lies where a pinhole camera sees it."""

import cv2
import numpy as np
import pytest

from stages.geometry.lens import MODELS, Lens

K = np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]])
POLYNOMIAL = [-0.3, 0.1, 0.002, -0.001, 0.0]


@pytest.mark.parametrize(
    ("model", "d"),
    [("plumb_bob", POLYNOMIAL), ("rational_polynomial", [0.2, -0.1, 0, 0, 0, 0.1, 0, 0]),
     ("equidistant", [-0.05, 0.01, 0.0, 0.0]), ("inverse_brown_conrady", POLYNOMIAL)],
)  # fmt: skip
def test_a_lens_is_taken_out(model: str, d: list[float]) -> None:
    ray = np.array([[[0.35, -0.25, 1.0]]])
    expected = K @ ray.ravel()
    if model == "equidistant":
        bent = cv2.fisheye.distortPoints(ray[:, :, :2], K, np.array(d))
    else:
        bent = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), K, np.array(d))[0]
    column, row = np.round(bent.ravel()).astype(int)
    if model == "inverse_brown_conrady":  # the polynomial leads from the image to the ray
        (column, row), expected = np.round(expected[:2]).astype(int), np.append(bent.ravel(), 1)
    rgb, metres = np.zeros((80, 100, 3), np.uint8), np.zeros((80, 100), np.float32)
    rgb[row - 1 : row + 2, column - 1 : column + 2], metres[row - 1 : row + 2, column - 1 : column + 2] = 255, 0.7
    straight, straight_metres = Lens(K, (80, 100), d, model).straighten(rgb, metres)
    for found in (straight[:, :, 0] > 128, straight_metres > 0.6):
        rows, columns = np.nonzero(found)
        assert (columns.mean(), rows.mean()) == pytest.approx(expected[:2], abs=1.0)
    assert set(np.unique(straight_metres)) == {np.float32(0), np.float32(0.7)}  # never between two surfaces


@pytest.mark.parametrize("model", MODELS)
def test_what_does_not_bend_is_left_alone_and_wrong_coefficients_are_refused(model: str) -> None:
    rgb, metres = np.zeros((80, 100, 3), np.uint8), np.ones((80, 100), np.float32)
    assert Lens(K, (80, 100), [0.0] * 4, model).straighten(rgb, metres) == (rgb, metres)
    with pytest.raises(ValueError, match=f"'{model}' does not have 3 coefficients"):
        Lens(K, (80, 100), [0.1, 0.2, 0.3], model)
    with pytest.raises(ValueError, match=r"distortion d = \[nan, 0.0, 0.0, 0.0\]: its coefficients must be finite"):
        Lens(K, (80, 100), [np.nan, 0.0, 0.0, 0.0], model)
