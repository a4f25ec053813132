"""Point-to-plane ICP between a model and readings, many starts at once, with nearest points looked up in grids."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from stages.perception.rasteriser import Soup
from stages.scene.catalogue import CatalogueObject, Floats

_SAMPLES = 6000
_RENDERED = 1000
"""Triangles of the mesh that is rendered."""


@dataclass(frozen=True)
class Grid:
    """The nearest of some points for each voxel around them (as Fitzgibbon 2003 looks distances up)."""

    points: Floats
    """N x 3 metres."""
    nearest: NDArray[np.int32]
    """Index of the nearest point per voxel, -1 where it is farther than the margin."""
    origin: Floats
    """Centre of the first voxel."""
    voxel: float
    """Metres."""

    @staticmethod
    def of(points: Floats, *, voxel: float, margin: float) -> Grid:
        """Fills a grid that reaches ``margin`` metres beyond the points."""
        low, high = points.min(0) - margin, points.max(0) + margin
        axes = [np.arange(a, b + voxel, voxel) for a, b in zip(low, high, strict=True)]
        voxels = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        _, nearest = KDTree(points).query(voxels, distance_upper_bound=margin + voxel)
        return Grid(points, np.where(nearest < len(points), nearest, -1).astype(np.int32), low, voxel)


@dataclass(frozen=True)
class Model:
    """An object made ready once."""

    grid: Grid
    """Points on its surface, object frame."""
    normals: Floats
    """N x 3, unit, outwards."""
    soup: Soup
    centre: Floats
    """Middle of the enclosing box."""
    diameter: float
    """Diagonal of the enclosing box, metres."""

    @staticmethod
    def of(item: CatalogueObject) -> Model:
        """Samples the surface evenly and fills the grid."""
        points, normals = surface(item, _SAMPLES)
        grid = Grid.of(points, voxel=0.005, margin=0.03)
        soup = Soup.of(item.simplified(_RENDERED))
        return Model(grid, normals, soup, item.bounds.mean(0), float(np.linalg.norm(item.dimensions)))

    @property
    def points(self) -> Floats:
        """N x 3 points spread evenly over the surface, in random order."""
        return self.grid.points


def surface(item: CatalogueObject, count: int) -> tuple[Floats, Floats]:
    """``count`` points spread over the surface by area, always the same, and their normals; both N x 3."""
    rng = np.random.default_rng(0)
    corners = item.mesh.vertices[item.mesh.faces]
    edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(edges, axis=1)
    chosen = rng.choice(len(corners), count, p=doubled / doubled.sum())
    u, v = rng.random((2, count, 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    a, b, c = corners[chosen].transpose(1, 0, 2)
    return a + u * (b - a) + v * (c - a), edges[chosen] / doubled[chosen, None]


def directions(dof: int, T_camera_table: Floats) -> Floats:
    """Twists (rotation, translation; camera frame) an object may make, 6 x dof: 3 keeps it upright on the plane."""
    if dof == 6:
        return np.eye(6)
    basis = np.zeros((6, 3))
    basis[:3, 0] = T_camera_table[:3, 2]
    basis[3:, 1:] = T_camera_table[:3, :2]
    return basis


def readings_to_model(model: Model, readings: Floats, poses: Floats, gates: Floats, basis: Floats) -> Floats:
    """Poses (P x 4 x 4) after one Gauss-Newton step of point-to-plane ICP per gate.

    Each reading (N x 3, camera frame) seeks the model's nearest point; pairs farther apart than the gate (metres) or
    on a side that the camera does not see take no part. Exact near the solution.
    """
    return _aligned(model, readings, model.grid, poses, gates, basis=basis, by_reading=True)


def model_to_readings(model: Model, scene: Grid, poses: Floats, gates: Floats, basis: Floats, *, count: int) -> Floats:
    """The same with ``count`` points of the model seeking the nearest reading of ``scene`` (camera frame).

    What else is in the box attracts less than with the readings seeking: right for starts that are far off.
    """
    return _aligned(model, model.points[:count], scene, poses, gates, basis=basis, by_reading=False)


def _aligned(
    model: Model, seekers: Floats, grid: Grid, poses: Floats, gates: Floats, *, basis: Floats, by_reading: bool
) -> Floats:
    moved = np.ascontiguousarray(poses, np.float64).copy()
    gates, basis = np.ascontiguousarray(gates, np.float64), np.ascontiguousarray(basis)
    _align(np.ascontiguousarray(seekers), grid.points, model.normals, grid.nearest, grid.origin, grid.voxel,
           by_reading, model.centre, moved, gates, basis)  # fmt: skip
    return moved


def thinned(points: Floats, count: int) -> Floats:
    """At most ``count`` points, evenly through the list."""
    return points[np.linspace(0, len(points) - 1, min(count, len(points))).astype(int)]


@numba.njit(cache=True, nogil=True)
def _align(seekers, targets, normals, nearest, origin, voxel, by_reading, centre, poses, gates, basis):  # pyright: ignore  # noqa: PLR0917
    """Gauss-Newton steps for each pose, in place."""
    dof = basis.shape[1]
    A = np.zeros((dof, dof))
    b = np.zeros(dof)
    for pose in poses:
        for gate in gates:
            A[:] = 0.0
            b[:] = 0.0
            used = _accumulate(seekers, targets, normals, nearest, origin, voxel, by_reading, centre, pose, gate,
                               basis, A, b)  # fmt: skip
            if used < 10:
                break
            for i in range(dof):
                A[i, i] += 1e-3 * A[i, i] + 1e-6
            _move(pose, centre, basis @ np.linalg.solve(A, b))


@numba.njit(cache=True, nogil=True)
def _accumulate(seekers, targets, normals, nearest, origin, voxel, by_reading, centre, pose, gate, basis, A, b):  # pyright: ignore  # noqa: PLR0917
    """Normal equations of n . (reading - model point), robustly weighted; returns how many pairs took part."""
    used = 0
    row = np.zeros(basis.shape[1])
    twist = np.zeros(6)
    R, t = np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])
    inverse = np.ascontiguousarray(R.T)
    middle = R @ centre + t
    for k in range(len(seekers)):
        place = inverse @ (seekers[k] - t) if by_reading else R @ seekers[k] + t
        index = _nearest(place, nearest, origin, voxel)
        if index < 0:
            continue
        reading = seekers[k] if by_reading else targets[index]
        n = R @ normals[index if by_reading else k]
        gap = reading - (R @ targets[index] + t if by_reading else place)
        if n @ reading > 0 or gap @ gap > gate * gate:
            continue
        residual = n @ gap
        arm = reading - middle
        twist[0] = arm[1] * n[2] - arm[2] * n[1]
        twist[1] = arm[2] * n[0] - arm[0] * n[2]
        twist[2] = arm[0] * n[1] - arm[1] * n[0]
        twist[3:] = n
        weight = 1.0 / (1.0 + (3 * residual / gate) ** 2) ** 2
        for i in range(len(row)):
            row[i] = 0.0
            for j in range(6):
                row[i] += basis[j, i] * twist[j]
        for i in range(len(row)):
            b[i] += weight * row[i] * residual
            for j in range(len(row)):
                A[i, j] += weight * row[i] * row[j]
        used += 1
    return used


@numba.njit(cache=True, nogil=True)
def _nearest(place, nearest, origin, voxel):  # pyright: ignore
    """Index of the point nearest to a place, -1 where there is none."""
    x = int(np.floor((place[0] - origin[0]) / voxel + 0.5))
    y = int(np.floor((place[1] - origin[1]) / voxel + 0.5))
    z = int(np.floor((place[2] - origin[2]) / voxel + 0.5))
    if not (0 <= x < nearest.shape[0] and 0 <= y < nearest.shape[1] and 0 <= z < nearest.shape[2]):
        return -1
    return nearest[x, y, z]


@numba.njit(cache=True, nogil=True)
def _move(pose, centre, twist):  # pyright: ignore
    """Turns a pose by twist[:3] about the object's centre and shifts it by twist[3:], in place."""
    angle = np.sqrt(twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2) + 1e-12
    x, y, z = twist[0] / angle, twist[1] / angle, twist[2] / angle
    s, c = np.sin(angle), np.cos(angle)
    d = 1.0 - c
    turn = np.array([
        [c + x * x * d, x * y * d - z * s, x * z * d + y * s],
        [x * y * d + z * s, c + y * y * d, y * z * d - x * s],
        [x * z * d - y * s, y * z * d + x * s, c + z * z * d],
    ])  # fmt: skip
    R = np.ascontiguousarray(pose[:3, :3])
    middle = R @ centre + pose[:3, 3]
    pose[:3, :3] = turn @ R
    pose[:3, 3] = middle + twist[3:] - turn @ R @ centre
