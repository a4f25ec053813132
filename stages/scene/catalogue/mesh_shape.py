"""What a mesh's shape says of an object: how it rests, whether it holds things, how wide it is between fingers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from stages.geometry.arrays import Floats
from stages.scene.catalogue.objects import Mesh

_SAME_FACE = np.cos(np.deg2rad(20.0))
_MOST_RESTING = 12
_CELLS = 24
_VESSEL = 0.2


def axis_rotation(axis: Floats, angle: float) -> Floats:
    """3 x 3 rotation by ``angle`` radians about ``axis`` (Rodrigues' formula)."""
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def transform(R: Floats, t: Floats) -> Floats:
    """4 x 4 from a 3 x 3 rotation and a translation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def turned_up(direction: Floats) -> Floats:
    """3 x 3: the smallest rotation that turns ``direction`` to +z (to a nanoradian)."""
    direction = direction / np.linalg.norm(direction)
    axis = np.cross(direction, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3) if direction[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return axis_rotation(axis, np.arctan2(sine, direction[2]))


def resting_rotations(mesh: Mesh) -> tuple[Floats, ...]:
    """Rotations R_table_object (3 x 3) in which the object rests on a plane, the most upright first.

    An object rests on a facet of its convex hull that its centre of mass lies above (the hull's centre of mass
    stands for it). Facets that differ by less than 20 degrees count once, the larger one.
    """
    hull = ConvexHull(mesh.vertices)
    corners = hull.points[hull.simplices]
    normals = hull.equations[:, :3]
    stable = _above(corners, normals, _hull_centre(corners, normals))
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    kept: list[Floats] = []
    for index in np.argsort(-areas, kind="stable"):
        if stable[index] and all(normals[index] @ other < _SAME_FACE for other in kept):
            kept.append(normals[index])
    kept = sorted(kept[:_MOST_RESTING], key=lambda normal: round(float(normal[2]), 6))
    return tuple(turned_up(-normal) for normal in kept) or (np.eye(3),)


def _hull_centre(corners: Floats, normals: Floats) -> Floats:
    """Centre of mass of a convex solid: tetrahedra from an inner point to each facet."""
    inner = corners.reshape(-1, 3).mean(0)
    height = np.einsum("fi,fi->f", corners[:, 0] - inner, normals)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    volume = area * height
    return inner + 0.75 * (volume @ (corners.mean(1) - inner)) / volume.sum()


def _above(corners: Floats, normals: Floats, point: Floats) -> NDArray[np.bool_]:
    """Whether ``point``, projected along each facet's normal, falls into the facet."""
    edges = np.roll(corners, -1, axis=1) - corners
    sides = np.einsum("fki,fi->fk", np.cross(edges, point - corners), normals)
    return (sides >= -1e-12).all(1) | (sides <= 1e-12).all(1)


def holds_water(mesh: Mesh) -> bool:
    """Whether the upright object is a vessel: rain fills at least a fifth of its enclosing box above its footprint."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    heights = _height_map(mesh, low, high)
    footprint = heights > low[2] - 1e-9
    water = np.where(np.pad(np.ones((_CELLS, _CELLS), bool), 1), np.inf, low[2])
    ground = np.pad(np.where(footprint, heights, low[2]), 1, constant_values=low[2])
    while True:
        # The water over a cell stands at least as high as the ground and no higher than its lowest neighbour.
        around = np.minimum.reduce([np.roll(water, s, axis) for axis in (0, 1) for s in (-1, 1)])
        level = np.minimum(water, np.maximum(ground, around))
        if (level == water).all():
            break
        water = level
    filled = (water - ground)[1:-1, 1:-1][footprint].sum()
    return bool(filled > _VESSEL * footprint.sum() * (high[2] - low[2]))


def _height_map(mesh: Mesh, low: Floats, high: Floats) -> Floats:
    """Highest z over each cell of a grid across the enclosing box; -inf where there is nothing."""
    to_cells = np.array([_CELLS, _CELLS, 1.0]) / np.append((high - low)[:2], 1.0)
    points = _surface_points((mesh.vertices * to_cells)[mesh.faces], spacing=0.5)
    index = np.clip((points[:, :2] - (low * to_cells)[:2]).astype(np.int64), 0, _CELLS - 1)
    heights = np.full((_CELLS, _CELLS), -np.inf)
    np.maximum.at(heights, (index[:, 0], index[:, 1]), points[:, 2])
    return heights


def _surface_points(triangles: Floats, *, spacing: float) -> Floats:
    """Points on triangles (F x 3 x 3), at most ``spacing`` apart horizontally; N x 3."""
    edges = np.linalg.norm((triangles - np.roll(triangles, 1, axis=1))[..., :2], axis=-1)
    counts = np.maximum(np.ceil(edges.max(1) / spacing).astype(np.int64), 1)
    groups = [np.einsum("wk,fki->fwi", _weights(n), triangles[counts == n]) for n in np.unique(counts)]
    return np.concatenate([group.reshape(-1, 3) for group in groups])


def _weights(count: int) -> Floats:
    """Barycentric coordinates of a triangular grid with ``count`` steps along each edge; W x 3."""
    return np.array([[i, j, count - i - j] for i in range(count + 1) for j in range(count + 1 - i)]) / count


def width_between(mesh: Mesh, T_object_grasp: Floats, *, length: float = 0.03, breadth: float = 0.02) -> float:
    """Metres between fingers that close on the object along the grasp's y axis.

    Counts the surface that pads of ``length`` (behind the fingertips) by ``breadth`` would sweep over; the whole
    object where they would sweep over nothing.
    """
    points = (mesh.vertices - T_object_grasp[:3, 3]) @ T_object_grasp[:3, :3]
    near = (points[:, 0] > -length) & (points[:, 0] < 0) & (np.abs(points[:, 2]) < breadth / 2)
    across = np.abs(points[near, 1] if near.any() else points[:, 1])
    return float(2 * across.max())
