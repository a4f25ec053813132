"""Finds the support plane in a depth image by RANSAC."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.geometry.poses import along, pose
from stages.geometry.regions import Region, hull
from stages.perception.rendering.rasteriser import Float32s, View

_SAMPLES = 6000
_TRIALS = 400
_TILT = np.cos(np.deg2rad(12.0))
"""A support plane is horizontal within 12 degrees, where gravity is known."""
_REFITS = 4
_REACH = 0.2
"""Metres from an object within which its support plane shows."""
_LEADERS = 12
_FEWEST = 100
_SHARE = 0.1
"""Of the readings near the objects as many must lie on the support plane; on real tables a third and more do."""
_BELOW = 0.5
"""What a reading below the plane takes away, in readings on it."""
_CLEARANCE = 0.003
"""Metres above the plane's noise up to which a reading may be the plane's own."""
_CELL = 0.01
_WIDE = 3.0
"""A cell of the support surface is 1 cm wide, or so many pixels where these are wider, ..."""
_PER_CELL = 3
"""... and is seen by so many readings."""
_BRIDGED = 0.11
"""Metres across which parts of one surface may lie apart, because of what stands between."""
_TALLEST = 0.3
"""Metres above the plane below which the middle of an object lies."""


def find_plane(
    depth: Float32s, view: View, rng: np.random.Generator, *, objects: Floats, up: Floats | None
) -> Floats | None:
    """T_camera_table of the support plane, 4 x 4: z up, origin on the surface below the middle of the readings.

    ``depth`` is H x W metres (0 invalid), ``objects`` C x 4 spheres in which objects may be (middle and radius, camera
    frame, metres), ``up`` the direction against gravity in the camera frame where it is known. Of the planes near the
    objects that one wins which most readings agree with and most objects stand on. None where there are too few
    readings, or none that agree on a plane.
    """
    points = _points(depth, view, objects)
    if len(points) < _FEWEST:
        return None
    sample = points[rng.choice(len(points), min(_SAMPLES, len(points)), replace=False)]
    best = _best_trial(sample, objects[:, :3], rng, up)
    if best is None:
        return None
    plane = _refit(best, points)
    return _frame(plane, points) if _near(plane, points).mean() >= _SHARE else None


def height_above(depth: NDArray[np.floating], view: View, T_camera_table: Floats) -> Float32s:
    """Height of every reading above the plane, H x W metres; meaningless where there is no reading."""
    normal, origin = T_camera_table[:3, 2], T_camera_table[:3, 3]
    slope = along(view.rays(), normal)
    return (slope * depth - (normal * origin).sum()).astype(np.float32)


def support_region(depth: Float32s, view: View, T_camera_table: Floats) -> Region | None:
    """Where the support surface is seen: the corners of its convex hull in the table's frame, K x 2 metres.

    Readings on the plane are counted on a grid of 1 cm, wider where pixels are few, so that single stray ones do not
    widen it. Of several parts far from each other, which are other surfaces at the same height, the one with most cells
    counts. None where no part is seen.
    """
    on_it = (depth > 0) & (np.abs(height_above(depth, view, T_camera_table)) < noise(depth))
    points = (view.rays()[on_it] * depth[on_it][:, None] - T_camera_table[:3, 3]) @ T_camera_table[:3, :2]
    if not len(points):
        return None
    cell = max(_CELL, _WIDE * float(np.median(depth[on_it])) / view.fx)
    cells = np.floor(points / cell).astype(np.int64)
    low = cells.min(0)
    counts = np.zeros(cells.max(0) - low + 1, np.int64)
    np.add.at(counts, tuple((cells - low).T), 1)
    rows, columns = np.nonzero(_largest_part(counts >= _PER_CELL, bridged=max(1, round(_BRIDGED / cell))))
    region = hull((np.stack([rows, columns], 1) + low + 0.5) * cell)
    return region if len(region) else None


def _largest_part(cells: NDArray[np.bool_], *, bridged: int) -> NDArray[np.bool_]:
    """The cells of the part that has most; what objects hide, ``bridged`` cells, does not part a surface."""
    disc = np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (bridged, bridged)), np.uint8)
    padded = np.pad(cells, bridged).astype(np.uint8)
    _, labels = cv2.connectedComponents(cv2.dilate(padded, disc), connectivity=8)
    inner = labels[bridged:-bridged, bridged:-bridged]
    sizes = np.bincount(inner[cells], minlength=1)
    return cells & (inner == sizes.argmax())


def noise(z: NDArray[np.floating]) -> NDArray[np.floating]:
    """How far a reading of a structured-light sensor at depth ``z`` strays from a plane, metres (about 2 sigma)."""
    return 0.003 + 0.003 * z**2


def stands_out(height: NDArray[np.floating], z: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which surfaces at depth ``z`` are too far above the plane for their readings to be the plane's own."""
    return height > noise(z) + _CLEARANCE


def _points(depth: Float32s, view: View, objects: Floats) -> Floats:
    """Readings near where objects may be, N x 3: a floor or a wall beyond the table may be larger than the table."""
    points = (view.rays() * depth[..., None])[depth > 0]
    near = np.zeros(len(points), bool)
    for *middle, radius in objects:
        offset = points - middle
        near |= along(offset, offset) < (radius + _REACH) ** 2
    return points[near] if near.any() else points


def _best_trial(points: Floats, middles: Floats, rng: np.random.Generator, up: Floats | None) -> Floats | None:
    """Of planes (unit normal towards the camera, offset) through three points the one with the best score."""
    planes = _through(points[rng.integers(len(points), size=(_TRIALS, 3))], up)
    if not len(planes):
        return None
    scores = _scores(planes, points, middles)
    leaders = planes[np.argsort(-scores, kind="stable")[:_LEADERS]]
    refitted = np.stack([_refit(plane, points) for plane in leaders])
    return refitted[int(np.argmax(_scores(refitted, points, middles)))]


def _scores(planes: Floats, points: Floats, middles: Floats) -> Floats:
    """How well planes (P x 4) support the objects: readings on them, less those below, times objects above.

    Nothing is below what carries the objects: a plane that cuts through a tray and its table has readings there.
    """
    tolerance = noise(points[:, 2])
    scores = np.empty(len(planes))
    for k, plane in enumerate(planes):
        height = (along(points, plane) + plane[3]) / tolerance
        agreeing = np.clip(1.0 - height**2, 0.0, None).sum() - _BELOW * (height < -1.0).sum()
        standing = (middles * plane[:3]).sum(1) + plane[3]
        scores[k] = agreeing * (0.1 + ((standing > -0.01) & (standing < _TALLEST)).sum())
    return scores


def _through(corners: Floats, up: Floats | None) -> Floats:
    """Planes through N x 3 x 3 points that do not lie on a line, those that are level where ``up`` is known; M x 4."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.sqrt((normals**2).sum(1))
    normals = normals / np.maximum(lengths, 1e-12)[:, None]
    normals *= np.where((normals * corners[:, 0]).sum(1) > 0, -1.0, 1.0)[:, None]
    allowed = lengths > 1e-4
    if up is not None:
        allowed &= (normals * up).sum(1) > _TILT
    return np.column_stack([normals, -(normals * corners[:, 0]).sum(1)])[allowed]


def _near(plane: Floats, points: Floats, share: float = 1.0) -> NDArray[np.bool_]:
    """Which points lie on a plane, within a share of the noise."""
    return np.abs(along(points, plane) + plane[3]) < share * noise(points[:, 2])


def _refit(plane: Floats, points: Floats) -> Floats:
    """Least squares over the readings that agree, repeated with a falling tolerance."""
    for share in np.linspace(1.0, 0.6, _REFITS):
        near = points[_near(plane, points, share)]
        if len(near) < 3:
            break
        centre = near.mean(0)
        offset = near - centre
        covariance = (offset[:, :, None] * offset[:, None, :]).sum(0)
        normal = np.linalg.eigh(covariance)[1][:, 0]
        normal = -normal if normal @ centre > 0 else normal
        plane = np.append(normal, -(normal * centre).sum())
    return plane


def _frame(plane: Floats, points: Floats) -> Floats:
    """A frame on the plane: x along the camera's x axis as far as the plane allows."""
    normal = plane[:3]
    x: Floats = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.sqrt((x**2).sum())
    centre = points[_near(plane, points)].mean(0)
    origin = centre - ((centre * normal).sum() + plane[3]) * normal
    y: Floats = np.cross(normal, x)
    return pose(np.stack([x, y, normal], 1), origin)
