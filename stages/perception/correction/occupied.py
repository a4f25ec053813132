"""What stands on the table, before anybody knows what it is: boxes that the arm keeps out of."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.geometry.regions import moved
from stages.perception.observation.plane import find_plane, support_region
from stages.perception.rendering.rasteriser import Float32s, View
from stages.robots import Robot

_CELL = 0.02
_PER_CELL = 3
"""Readings that show that something is there."""
_LEAST = 0.03
"""Metres above the table from which on a reading is of something."""
_TALLEST = 0.6
_MARGIN = 0.05
"""Metres by which boxes are larger: as much as an uncalibrated camera is off, and what lies in the shadow."""
_WIDEST = 0.2
"""Metres across up to which what is connected is one box: one tall object does not make all that it touches as high."""
_HIGHER = 0.03
"""Metres by which the table is higher: as much as an uncalibrated camera is off in height."""


def occupied(
    depth: Float32s, view: View, T_base_camera: Floats, robot: Robot, rng: np.random.Generator
) -> tuple[float, Floats] | None:
    """The table's height at most and the boxes on it: N x 6, low and high corner, base frame, metres.

    ``depth`` is H x W metres, 0 where there is no reading or the robot is. None where no table is seen where the robot
    works.
    """
    middle = np.array([*np.mean([robot.x, robot.y], 1), robot.table.height, 1.0])
    radius = np.hypot(np.ptp(robot.x), np.ptp(robot.y)) / 2
    around = np.append((inverse(T_base_camera) @ middle)[:3], radius)
    T_camera_table = find_plane(depth, view, rng, objects=around[None], up=T_base_camera[2, :3])
    if T_camera_table is None:
        return None
    T_base_table = T_base_camera @ T_camera_table
    height = float(T_base_table[2, 3])
    region = support_region(depth, view, T_camera_table)
    if region is None:
        return None
    corners = moved(region, T_base_table)
    low, high = corners.min(0) - _MARGIN, corners.max(0) + _MARGIN
    points = (view.rays() * depth[..., None])[depth > 0] @ T_base_camera[:3, :3].T + T_base_camera[:3, 3]
    above = points[:, 2] - height
    on_it = (above > _LEAST) & (above < _TALLEST) & ((points[:, :2] > low) & (points[:, :2] < high)).all(1)
    return height + _HIGHER, _boxes(points[on_it], low, high, height)


def _boxes(points: Floats, low: Floats, high: Floats, height: float) -> Floats:
    """One box around the readings of each part, or several around those of a wide one, N x 6."""
    cells = np.floor((points[:, :2] - low) / _CELL).astype(np.int64)
    counts = np.zeros(np.ceil((high - low) / _CELL).astype(int) + 1, np.int64)
    np.add.at(counts, tuple(cells.T), 1)
    parts, labels = cv2.connectedComponents((counts >= _PER_CELL).astype(np.uint8), connectivity=8)
    of = labels[tuple(cells.T)]
    found = [piece for part in range(1, parts) for piece in _pieces(points[of == part])]
    return np.array([[*(one.min(0)[:2] - _MARGIN), height, *(one.max(0) + _MARGIN)] for one in found], float).reshape(
        -1, 6
    )


def _pieces(points: Floats) -> Iterator[Floats]:
    """Points, halved across until none of the pieces is too wide."""
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    axis = int((high - low).argmax())
    if high[axis] - low[axis] <= _WIDEST:
        yield points
        return
    beyond = points[:, axis] > (low + high)[axis] / 2
    yield from _pieces(points[~beyond])
    yield from _pieces(points[beyond])
