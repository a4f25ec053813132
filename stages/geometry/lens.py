"""Lenses that bend straight lines: images as a pinhole camera would have taken them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from stages.messages.arrays import Depth, Intrinsics, Rgb

PLUMB_BOB, FISHEYE, INVERSE = "plumb_bob", "equidistant", "inverse_brown_conrady"
MODELS = (PLUMB_BOB, "rational_polynomial", FISHEYE, INVERSE)
"""OpenCV's polynomial of 4 or 5 coefficients (k1 k2 p1 p2 k3) and of 8, its fisheye of 4 (Kannala and Brandt), and
the first one read the other way: from the image to the ray."""


class Lens:
    """A lens of known coefficients before a camera of matrix ``K``."""

    def __init__(
        self, K: Intrinsics, size: tuple[int, int], coefficients: Sequence[float], model: str = PLUMB_BOB
    ) -> None:
        """``size`` is height and width of its images, pixels.

        Raises:
            ValueError: there is no such model, it has another number of coefficients, or one is not finite.
        """
        d = np.array(coefficients, np.float64).ravel()
        if model not in MODELS:
            raise ValueError(f"distortion model {model!r} is not known; valid: {', '.join(MODELS)}")
        if not np.isfinite(d).all():
            raise ValueError(f"distortion d = {d.tolist()}: its coefficients must be finite")
        self._maps = _maps(np.asarray(K, np.float64), size, d, model) if d.any() else None

    def straighten(self, rgb: Rgb, depth: Depth) -> tuple[Rgb, Depth]:
        """Colour and depth (H x W) as a pinhole camera of matrix K sees them; 0 beyond their rims."""
        if self._maps is None:
            return rgb, depth
        return (
            np.asarray(cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR), np.uint8),
            np.asarray(cv2.remap(depth, *self._maps, cv2.INTER_NEAREST), np.float32),
        )


def _maps(K: Intrinsics, size: tuple[int, int], d: Any, model: str) -> tuple[Any, Any]:
    """Where each straight pixel is found in the bent image: columns and rows, H x W each."""
    height, width = size
    library: Any = cv2
    try:
        if model == INVERSE:
            grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(np.float64)
            bent = library.undistortPoints(grid, K, d, P=K).reshape(height, width, 2).astype(np.float32)
            return np.ascontiguousarray(bent[..., 0]), np.ascontiguousarray(bent[..., 1])
        undistort = library.fisheye if model == FISHEYE else library
        return undistort.initUndistortRectifyMap(K, d, np.eye(3), K, (width, height), cv2.CV_32FC1)
    except cv2.error:
        raise ValueError(f"distortion model {model!r} does not have {len(d)} coefficients") from None
