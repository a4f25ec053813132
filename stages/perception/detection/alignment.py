"""A photograph made ready to be compared with depth and with views: moved to where depth sees it, and as bright."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.perception.detection.appearance import Bytes, Mask
from stages.perception.rendering.rasteriser import Float32s

_WIDTH = 640
"""Images are reduced to about so many columns."""
_FARTHEST = 10
"""Pixels of these by which colour may lie beside depth, in both directions."""
_USUAL = 10.0
"""Standard deviation of that: without edges that say more, colour lies where depth does."""
_STEP = 0.03
"""Metres by which what is beside an object is farther away, at one metre or less; grows with the square of depth."""
_ACROSS = 3
"""Pixels within which it is: sensors read nothing along edges."""
_FEWEST = 100
"""Pixels along such edges below which they say nothing."""
_STRONGEST = 97.0
"""Percentile of the edges of colour beyond which all are alike: letters are no outlines."""
_WHITE, _BRIGHT = 98.0, 0.95
"""The percentile of brightness that becomes so bright, of 1: as white is in views."""


def aligned(rgb: Bytes, depth: Float32s) -> Bytes:
    """The photograph (H x W x 3, sRGB) with its edges where depth (H x W metres, 0 no reading) has them, well exposed.

    Colour lies a few pixels beside depth where cameras were registered by the data sheet, at an earlier calibration or
    for another distance. It is moved as a whole, by the pixels at which the outlines that depth shows lie on the
    strongest edges of colour.
    """
    down, right = _beside(rgb, depth)
    rows, columns = (
        np.clip(np.arange(size) + by, 0, size - 1) for size, by in zip(depth.shape, (down, right), strict=True)
    )
    return _exposed(rgb[rows[:, None], columns])


def _beside(rgb: Bytes, depth: Float32s) -> tuple[int, int]:
    """Pixels by which colour lies below and right of depth."""
    step = max(1, round(rgb.shape[1] / _WIDTH))
    sparse = depth[::step, ::step]
    rows, columns = np.nonzero(_outlines(sparse))
    if len(rows) < _FEWEST:
        return 0, 0
    edges = _edges(np.asarray(cv2.resize(rgb, sparse.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8))
    shifts = [(y, x) for y in range(-_FARTHEST, _FARTHEST + 1) for x in range(-_FARTHEST, _FARTHEST + 1)]
    found = [float(edges[rows + y, columns + x].mean()) * np.exp(-(y * y + x * x) / (2 * _USUAL**2)) for y, x in shifts]
    down, right = shifts[int(np.argmax(found))]
    return step * down, step * right


def _outlines(depth: Float32s) -> Mask:
    """Where something ends that stands before something else, apart from the image's border."""
    window = np.ones((2 * _ACROSS + 1,) * 2, np.uint8)
    beyond = cv2.dilate(depth, window) - depth > _STEP * np.maximum(depth, 1.0) ** 2
    beside = cv2.dilate(np.where(depth > 0, depth, np.inf).astype(np.float32), np.ones((3, 3), np.uint8))
    marked = (depth > 0) & beyond & (beside - depth > _STEP / 3)
    inner = np.s_[_FARTHEST:-_FARTHEST, _FARTHEST:-_FARTHEST]
    outlines = np.zeros_like(marked)
    outlines[inner] = marked[inner]
    return outlines


def _edges(rgb: Bytes) -> NDArray[np.floating]:
    """How much colour changes at each pixel, CIELAB, bounded."""
    smooth = cv2.GaussianBlur(rgb, (0, 0), 1.0).astype(np.float32) / 255
    lab = cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB)
    strength = np.sqrt(sum((cv2.Sobel(lab, cv2.CV_32F, *way) ** 2).sum(-1) for way in ((1, 0), (0, 1))))
    return np.minimum(strength, np.percentile(strength, _STRONGEST))


def _exposed(rgb: Bytes) -> Bytes:
    white = float(np.percentile(rgb.max(2), _WHITE)) / 255
    return np.clip(rgb * (_BRIGHT / max(white, 0.05)), 0, 255).astype(np.uint8)
