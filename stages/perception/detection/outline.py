"""Whether an object's outline shows in a photograph: a border where its silhouette ends."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.messages.digest import PATCH_STRIDE, DepthPatch
from stages.perception.detection.appearance import Bytes
from stages.perception.rendering.rasteriser import Float32s

HIDES = 0.03
"""Metres in front of the surface at which a reading belongs to something that hides it."""
_BESIDE = 3.0
"""Pixels from the outline (at 640 pixels across) at which inside and outside are compared."""
_SHIFTS = (-4.0, -2.0, 0.0, 2.0, 4.0)
"""Pixels (likewise) by which colour may be off depth, in both directions."""
_ALIKE = 8.0
"""CIELAB units up to which two colours are one: light that falls off along a surface changes it by as much."""
_LEAST = 20
"""Points of an outline below which it says nothing."""


def faintness(glimpses: Sequence[DepthPatch], rgb: Bytes, depth: Float32s) -> Floats:
    """Share of each object's outline at which the photograph goes on in the same colour; NaN where hardly any is free.

    What has an outline of its own differs from what is beside it; what merely fits into a surface has borders where
    none are seen. ``depth`` is H x W metres, 0 where there is no reading. Of the outline those points count that lie in
    the image with nothing in front beside them; of all small shifts of colour against depth the best counts.
    """
    scale = rgb.shape[1] / 640
    smooth = cv2.GaussianBlur(rgb, (0, 0), scale).astype(np.float32) / 255
    lab = np.asarray(cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB), np.float32)
    return np.array([_faintness(glimpse, lab, depth, scale) for glimpse in glimpses])


def _faintness(glimpse: DepthPatch, lab: Float32s, depth: Float32s, scale: float) -> float:
    beside = _BESIDE * scale
    margin = int(2 * beside)
    layer = np.pad(glimpse.inverse.repeat(PATCH_STRIDE, 0).repeat(PATCH_STRIDE, 1), margin)
    corner = PATCH_STRIDE * np.array([glimpse.left, glimpse.top]) - margin
    points = _outline(layer > 0)
    outwards = beside * _outwards(layer > 0, points, beside)
    inside, outside = (np.rint(points + side * outwards).astype(int) for side in (-1, 1))
    surface = layer[inside[:, 1], inside[:, 0]]
    inside, outside = inside + corner, outside + corner
    counts = surface > 0
    for place in (inside, outside):
        counts &= ((place >= 0) & (place < depth.shape[::-1])).all(1)
    inside, outside, surface = inside[counts], outside[counts], surface[counts]
    read = depth[outside[:, 1], outside[:, 0]]
    free = ~((read > 0) & (1.0 / surface - read > HIDES))
    if free.sum() < _LEAST:
        return np.nan
    shifts = [np.rint([dx * scale, dy * scale]).astype(int) for dy in _SHIFTS for dx in _SHIFTS]
    return min(_alike(lab, inside[free] + shift, outside[free] + shift) for shift in shifts)


def _alike(lab: Float32s, one: NDArray[np.int_], other: NDArray[np.int_]) -> float:
    """Share of pairs of pixels (N x 2 each: x, y; those beyond the image are as its border) that have one colour."""
    last = np.array(lab.shape[1::-1]) - 1
    (x, y), (u, v) = np.clip(one, 0, last).T, np.clip(other, 0, last).T
    return float((((lab[y, x] - lab[v, u]) ** 2).sum(-1) < _ALIKE**2).mean())


def _outline(shown: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The pixels along the border of a mask, N x 2: x, y."""
    contours = cv2.findContours(shown.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    return np.asarray(np.concatenate([np.zeros((0, 2)), *(contour[:, 0] for contour in contours)]), np.int32)


def _outwards(shown: NDArray[np.bool_], points: NDArray[np.int32], beside: float) -> Floats:
    """Unit vectors out of a mask at points of its border, N x 2."""
    inner = cv2.GaussianBlur(shown.astype(np.float32), (0, 0), beside)
    slope = -np.stack([cv2.Sobel(inner, cv2.CV_32F, 1, 0), cv2.Sobel(inner, cv2.CV_32F, 0, 1)], -1)
    slope = slope[points[:, 1], points[:, 0]].astype(float)
    return slope / np.maximum(np.sqrt((slope**2).sum(-1, keepdims=True)), 1e-9)
