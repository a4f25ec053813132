"""Masks of images, H x W: grown, shrunk, freed of what is thin."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats

Mask = NDArray[np.bool_]


def eroded(mask: Mask, radius: int) -> Mask:
    """The mask without what lies within ``radius`` pixels of its border."""
    return cv2.erode(mask.astype(np.uint8), _disc(radius), borderValue=0).astype(bool)


def dilated(mask: Mask, radius: int) -> Mask:
    """The mask and what lies within ``radius`` pixels of it."""
    return cv2.dilate(mask.astype(np.uint8), _disc(radius), borderValue=0).astype(bool)


def opened(mask: Mask, radius: int) -> Mask:
    """The mask without parts thinner than a disc; single missing readings do not tear it."""
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, _disc(1))
    return cv2.morphologyEx(closed, cv2.MORPH_OPEN, _disc(radius)).astype(bool) & mask


def box_of(mask: Mask) -> Floats:
    """x0, y0, x1, y1 of what is true, in pixels, x1 and y1 exclusive; the mask is not empty."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float)


def part_of(mask: Mask, margin: int = 0) -> tuple[slice, slice]:
    """The smallest part of the image outside of which nothing is true, and so many pixels around it: most objects are
    small."""
    spans = (np.flatnonzero(mask.any(axis)).tolist() for axis in (1, 0))
    rows, columns = (slice(max(0, s[0] - margin), s[-1] + 1 + margin) if s else slice(0, 0) for s in spans)
    return rows, columns


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
