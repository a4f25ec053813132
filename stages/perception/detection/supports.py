"""The planes that objects may stand on, and where in the image something stands on them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.perception.observation.plane import find_plane, height_above, noise
from stages.perception.rendering.rasteriser import Float32s, View

Mask = NDArray[np.bool_]

_STRIDE = 4
_MOST = 4
_LEVEL = np.cos(np.deg2rad(80.0))
"""A plane is no support where its normal is further than that from the image's upward direction, and from the
direction to the camera: it would be a wall, seen from a level camera."""
_FACING = np.cos(np.deg2rad(30.0))
_CELL = 0.01
"""Metres along a cell of the map of a plane."""
_PIECE = 60
"""Cells of the smallest piece of a plane that objects stand on."""
_MARGIN = 4
"""Cells that objects may stand beyond the plane's readings, which the objects themselves hide."""
_CELLS = 1000


@dataclass(frozen=True)
class Support:
    """A plane, and what is known of the image with respect to it."""

    height: Float32s
    """H x W: metres above the plane."""
    over: Mask
    """H x W: pixels above what the camera sees of the plane."""
    normal: Floats
    """Camera frame, pointing up."""


def supports(
    depth: Float32s, filled: Float32s, view: View, rng: np.random.Generator, up: Floats | None
) -> list[Support]:
    """Up to _MOST planes, the one that most readings lie on first.

    ``depth`` is H x W metres (0 no reading), ``filled`` the same without holes, ``up`` the direction against gravity
    (camera frame) where it is known.
    """
    return [Support(height_above(filled, view, T), _over(view.rays() * filled[..., None], readings, T), T[:3, 2])
            for T, readings in _planes(depth[::_STRIDE, ::_STRIDE].copy(), view, rng, up)]  # fmt: skip


def _planes(
    depth: Float32s, view: View, rng: np.random.Generator, up: Floats | None
) -> Iterator[tuple[Floats, Floats]]:
    """T_camera_plane and the readings that lie on it, N x 3, of one plane after the other; ``depth`` is spent."""
    coarse = view.sampled(0, 0, view.width, view.height, _STRIDE)
    found = 0
    for _ in range(2 * _MOST):
        T = find_plane(depth, coarse, rng, objects=np.zeros((0, 4)), up=up)
        if T is None or found == _MOST:
            return
        near = (depth > 0) & (np.abs(height_above(depth, coarse, T)) < 1.5 * noise(depth))
        if up is not None or -T[1, 2] > _LEVEL or -T[2, 2] > _FACING:
            found += 1
            yield T, (coarse.rays() * depth[..., None])[near]
        depth[near] = 0


def _over(points: Floats, readings: Floats, T: Floats) -> Mask:
    """Which points (H x W x 3) lie over the pieces of the plane that were read; each piece counts as convex."""
    on_plane = (readings - T[:3, 3]) @ T[:3, :2]
    low = on_plane.min(0) - (_MARGIN + 1) * _CELL
    shape = np.minimum(np.ceil((on_plane.max(0) - low) / _CELL) + _MARGIN + 2, _CELLS).astype(int)
    cells = np.zeros(shape, np.uint8)
    where = np.minimum((on_plane - low) / _CELL, shape - 1).astype(int)
    cells[where[:, 0], where[:, 1]] = 1
    closed = cv2.morphologyEx(cells, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    covered = _pieces(np.asarray(closed, np.uint8))
    index = np.floor(((points - T[:3, 3]) @ T[:3, :2] - low) / _CELL).astype(int)
    inside = ((index >= 0) & (index < shape)).all(-1)
    index = np.clip(index, 0, shape - 1)
    return inside & covered[index[..., 0], index[..., 1]]


def _pieces(cells: NDArray[np.uint8]) -> Mask:
    """The hulls of all connected pieces of some size, wider by a margin."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(cells)
    hulls = np.zeros_like(cells)
    for number in range(1, count):
        if stats[number, cv2.CC_STAT_AREA] > _PIECE:
            cv2.fillConvexPoly(hulls, cv2.convexHull(np.argwhere(labels == number)[:, ::-1].astype(np.int32)), 1)
    size = 2 * _MARGIN + 1
    return cv2.dilate(hulls, np.ones((size, size), np.uint8)) > 0
