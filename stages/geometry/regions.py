"""Convex regions of the horizontal plane: hull, overlap, gap and containment.

A region is a K x 2 array of corners in metres, counter-clockwise, K >= 3. Every footprint is convex, so the
overlap is Sutherland-Hodgman clipping, in double precision and free of tolerances.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Region = NDArray[np.float64]
EMPTY: Region = np.zeros((0, 2))


def hull(points: NDArray[np.float64]) -> Region:
    """Convex hull of N x 2 points; :data:`EMPTY` where they span no area."""
    try:
        return np.asarray(points[ConvexHull(points).vertices], float)
    except (QhullError, ValueError):
        return EMPTY


def rectangle(low: Sequence[float], high: Sequence[float]) -> Region:
    """The axis-aligned rectangle between two corners."""
    return np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]], float)


def moved(region: Region, T: NDArray[np.float64]) -> Region:
    """The region under the horizontal part of a 4 x 4 transform that keeps z upright."""
    return region @ T[:2, :2].T + T[:2, 3]


def area(region: Region) -> float:
    """Square metres (shoelace formula)."""
    if len(region) < 3:
        return 0.0
    x, y = (region - region[0]).T
    return 0.5 * float(x @ _next(y) - y @ _next(x))


def centroid(region: Region) -> NDArray[np.float64]:
    """Centre of area, 2."""
    origin = region[0]
    p = region - origin
    q = _next(p)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return origin + ((p + q) * cross[:, None]).sum(0) / (3 * cross.sum())


def overlap(a: Region, b: Region) -> Region:
    """The common part of two regions, possibly :data:`EMPTY`."""
    if len(a) < 3 or len(b) < 3 or np.any(a.max(0) <= b.min(0)) or np.any(b.max(0) <= a.min(0)):
        return EMPTY
    corners = a.tolist()
    edge_starts = b.tolist()
    for start, end in zip(edge_starts, edge_starts[1:] + edge_starts[:1], strict=True):
        corners = _clipped(corners, start, end)
        if len(corners) < 3:
            return EMPTY
    return np.array(corners)


def _clipped(corners: list[list[float]], start: list[float], end: list[float]) -> list[list[float]]:
    """The corners left of the line from ``start`` to ``end``, with new ones where the outline crosses it."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    sides = [dx * (y - start[1]) - dy * (x - start[0]) for x, y in corners]
    kept: list[list[float]] = []
    for i, (corner, side) in enumerate(zip(corners, sides, strict=True)):
        before, side_before = corners[i - 1], sides[i - 1]
        if side * side_before < 0:
            t = side_before / (side_before - side)
            kept.append([before[0] + t * (corner[0] - before[0]), before[1] + t * (corner[1] - before[1])])
        if side >= 0:
            kept.append(corner)
    return kept


def overlap_area(a: Region, b: Region) -> float:
    """m(r_1, r_2) of the paper, section IV-B: the overlapping area, square metres."""
    return area(overlap(a, b))


def gap(a: Region, b: Region) -> float:
    """Smallest distance between two regions, metres; 0 where they overlap or touch."""
    if len(overlap(a, b)) or depth(a, b[:1])[0] >= 0 or depth(b, a[:1])[0] >= 0:
        return 0.0
    return float(min(_corner_distances(a, b).min(), _corner_distances(b, a).min()))


def edges(region: Region) -> NDArray[np.float64]:
    """From each corner to the next."""
    return _next(region) - region


def _next(region: Region) -> NDArray[np.float64]:
    """The corner after each; ``np.roll`` takes ten times as long."""
    return np.concatenate([region[1:], region[:1]])


def beyond(sides: tuple[NDArray[np.float64], NDArray[np.float64]], other: Region) -> float:
    """How far all of ``other`` lies beyond that of a region's :func:`sides` which separates them best; negative if none
    does."""
    inward, offset = sides
    return float((offset - (inward @ other.T).max(1)).max())


def _corner_distances(corners: NDArray[np.float64], region: Region) -> NDArray[np.float64]:
    """Distance of N points to the nearest edge of a region, N."""
    along = edges(region)
    offset = corners[:, None] - region
    t = np.clip((offset * along).sum(2) / (along**2).sum(1), 0, 1)
    return np.linalg.norm(offset - t[..., None] * along, axis=2).min(1)


def depth(region: Region, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """How deep N points lie inside the region, metres, N: distance to the nearest edge line, negative outside."""
    inward, offset = sides(region)
    return (points @ inward.T - offset).min(1)


def sides(region: Region) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit normals of the edges, inward, E x 2, and how far each edge lies along its normal, metres, E."""
    along = edges(region)
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]
    return inward, (region * inward).sum(1)


def inside(inner: Region, outer: Region, *, margin: float = 0.0) -> bool:
    """Whether ``inner`` lies in ``outer``, at least ``margin`` metres from its edge."""
    return bool(len(outer) >= 3 and (depth(outer, inner) >= margin).all())
