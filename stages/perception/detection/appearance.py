"""What a masked piece of an image looks like: crop, colours, outline, features; renders and photographs alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from stages.perception.detection.backbone import SIDE, Backbone
from stages.perception.rendering.rasteriser import Float32s

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

OUTLINE = 24
"""Cells along the outline that masks are compared by."""
_FILLED = 0.92
"""Of a crop's side, the object's longer edge."""
_GREY = 127
_CHROMA, _LIGHT = 12, 6
"""Bins of the histograms, of a and b each, and of lightness."""


class Piece(NamedTuple):
    """A piece of an image, scaled into a square of SIDE pixels, grey around it."""

    crop: Bytes
    mask: Mask
    """Where it is seen."""
    whole: Mask
    """Where it is, seen or hidden."""


@dataclass(frozen=True)
class Looks:
    """How N pieces look."""

    middle: Float32s
    """N x 112."""
    last: Float32s
    """N x 320."""
    grid: Float32s
    """N x GRID^2 x 112."""
    covered: Mask
    """N x GRID^2."""
    chroma: Float32s
    """N x 144, root of the share of each bin: products of two are Bhattacharyya coefficients."""
    light: Float32s
    """N x 6, likewise."""
    outline: Mask
    """N x OUTLINE^2."""

    @staticmethod
    def of(pieces: Sequence[Piece]) -> Looks:
        """Of at least one piece."""
        crops, masks, whole = map(np.stack, zip(*pieces, strict=True))
        seen = Backbone.pretrained().features(crops, masks)
        chroma, light = zip(*(_histograms(piece.crop[piece.mask]) for piece in pieces), strict=True)
        outline = np.stack([_outline(mask) for mask in whole])
        return Looks(seen.middle, seen.last, seen.grid, seen.covered, np.stack(chroma), np.stack(light), outline)


def square(rgb: Bytes, mask: Mask, whole: Mask | None = None) -> Piece:
    """The mask's own part of an image; ``whole`` also has what is hidden of it, where that is known."""
    whole = mask if whole is None else whole
    rows, columns = np.flatnonzero(whole.any(1)), np.flatnonzero(whole.any(0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    height, width = whole[window].shape
    scale = SIDE * _FILLED / max(height, width)
    size = max(2, round(width * scale)), max(2, round(height * scale))
    area = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(np.ascontiguousarray(rgb[window]), size, interpolation=area)
    y, x = (SIDE - size[1]) // 2, (SIDE - size[0]) // 2
    part = np.s_[y : y + size[1], x : x + size[0]]
    crop, inside, outline = np.full((SIDE, SIDE, 3), _GREY, np.uint8), *np.zeros((2, SIDE, SIDE), bool)
    for target, source in ((inside, mask), (outline, whole)):
        target[part] = cv2.resize(source[window].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    crop[inside] = small[inside[part]]
    return Piece(crop, inside, outline)


def _histograms(colors: Bytes) -> tuple[Float32s, Float32s]:
    """Smoothed histograms of chroma and of lightness (CIELAB) of K x 3 colours, as roots of shares."""
    lab = cv2.cvtColor((colors[None] / np.float32(255)), cv2.COLOR_RGB2LAB)[0]
    chroma = np.histogramdd(lab[:, 1:], bins=_CHROMA, range=((-66, 78), (-66, 78)))[0]
    light = np.histogram(lab[:, 0], bins=_LIGHT, range=(0, 100.1))[0].astype(float)
    return _rooted(gaussian_filter(chroma, 0.7).ravel()), _rooted(gaussian_filter1d(light, 0.7))


def _rooted(counts: NDArray[np.float64]) -> Float32s:
    return np.sqrt(counts / max(counts.sum(), 1e-9)).astype(np.float32)


def _outline(mask: Mask) -> Mask:
    small = cv2.resize(mask.astype(np.float32), (OUTLINE, OUTLINE), interpolation=cv2.INTER_AREA)
    return np.asarray(small > 0.5).ravel()
