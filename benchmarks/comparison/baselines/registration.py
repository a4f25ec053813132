"""Point-to-plane ICP between a model and readings, many starts at once, with nearest points looked up in grids."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from stages.geometry.arrays import Floats
from stages.perception.rendering.rasteriser import Soup
from stages.scene.catalogue import CatalogueObject

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
    """Twists (rotation, translation; camera) an object may make, 6 x dof: 4 keep it upright, 3 also on the plane."""
    if dof == 6:
        return np.eye(6)
    basis = np.zeros((6, dof))
    basis[:3, 0] = T_camera_table[:3, 2]
    basis[3:, 1:] = T_camera_table[:3, : dof - 1]
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
    A, b, step, twist = np.zeros((dof, dof)), np.zeros(dof), np.zeros(dof), np.zeros(6)
    for p in range(len(poses)):
        pose = poses[p]
        for gate in gates:
            for i in range(dof):
                b[i] = 0.0
                for j in range(dof):
                    A[i, j] = 0.0
            used = _accumulate(seekers, targets, normals, nearest, origin, voxel, by_reading, centre, pose, gate,
                               basis, A, b)  # fmt: skip
            if used < 10:
                break
            _solve(A, b, step)
            for i in range(6):
                twist[i] = 0.0
                for j in range(dof):
                    twist[i] += basis[i, j] * step[j]
            _move(pose, centre, twist)


@numba.njit(cache=True, nogil=True)
def _accumulate(seekers, targets, normals, nearest, origin, voxel, by_reading, centre, pose, gate, basis, A, b):  # pyright: ignore  # noqa: PLR0917
    """Normal equations of n . (reading - model point), robustly weighted; returns how many pairs took part."""
    used = 0
    row, twist = np.zeros(basis.shape[1]), np.zeros(6)
    mx, my, mz = _placed(pose, centre[0], centre[1], centre[2])
    for k in range(len(seekers)):
        sx, sy, sz = seekers[k, 0], seekers[k, 1], seekers[k, 2]
        if by_reading:
            x, y, z = _turned_back(pose, sx - pose[0, 3], sy - pose[1, 3], sz - pose[2, 3])
        else:
            x, y, z = _placed(pose, sx, sy, sz)
        index = _nearest(x, y, z, nearest, origin, voxel)
        if index < 0:
            continue
        tx, ty, tz = targets[index, 0], targets[index, 1], targets[index, 2]
        n = index if by_reading else k
        nx, ny, nz = _turned(pose, normals[n, 0], normals[n, 1], normals[n, 2])
        if by_reading:
            rx, ry, rz = sx, sy, sz
            x, y, z = _placed(pose, tx, ty, tz)
        else:
            rx, ry, rz = tx, ty, tz
        gx, gy, gz = rx - x, ry - y, rz - z
        if nx * rx + ny * ry + nz * rz > 0 or gx * gx + gy * gy + gz * gz > gate * gate:
            continue
        residual = nx * gx + ny * gy + nz * gz
        ax, ay, az = rx - mx, ry - my, rz - mz
        twist[0], twist[1], twist[2] = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
        twist[3], twist[4], twist[5] = nx, ny, nz
        share = 1.0 + (3 * residual / gate) ** 2
        _add(A, b, row, basis, twist, residual, 1.0 / (share * share))
        used += 1
    return used


@numba.njit(cache=True, nogil=True)
def _add(A, b, row, basis, twist, residual, weight):  # pyright: ignore  # noqa: PLR0917
    """One pair into the lower half of the normal equations."""
    for i in range(len(row)):
        row[i] = 0.0
        for j in range(6):
            row[i] += basis[j, i] * twist[j]
        b[i] += weight * row[i] * residual
        for j in range(i + 1):
            A[i, j] += weight * row[i] * row[j]


@numba.njit(cache=True, nogil=True)
def _solve(A, b, x):  # pyright: ignore
    """x of A x = b by Cholesky, with a little damping; A holds its lower half and is used up."""
    n = len(b)
    for i in range(n):
        A[i, i] += 1e-3 * A[i, i] + 1e-6
        for j in range(i + 1):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] = np.sqrt(A[i, i]) if i == j else A[i, j] / A[j, j]
        x[i] = b[i]
        for k in range(i):
            x[i] -= A[i, k] * x[k]
        x[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= A[k, i] * x[k]
        x[i] /= A[i, i]


@numba.njit(cache=True, nogil=True)
def _nearest(x, y, z, nearest, origin, voxel):  # pyright: ignore  # noqa: PLR0917
    """Index of the point nearest to a place, -1 where there is none."""
    i = int(np.floor((x - origin[0]) / voxel + 0.5))
    j = int(np.floor((y - origin[1]) / voxel + 0.5))
    k = int(np.floor((z - origin[2]) / voxel + 0.5))
    if not (0 <= i < nearest.shape[0] and 0 <= j < nearest.shape[1] and 0 <= k < nearest.shape[2]):
        return -1
    return nearest[i, j, k]


@numba.njit(cache=True, nogil=True)
def _turned(T, x, y, z):  # pyright: ignore
    """A direction after the rotation of T."""
    return (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z, T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
            T[2, 0] * x + T[2, 1] * y + T[2, 2] * z)  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _turned_back(T, x, y, z):  # pyright: ignore
    """A direction after the inverse of the rotation of T."""
    return (T[0, 0] * x + T[1, 0] * y + T[2, 0] * z, T[0, 1] * x + T[1, 1] * y + T[2, 1] * z,
            T[0, 2] * x + T[1, 2] * y + T[2, 2] * z)  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _placed(T, x, y, z):  # pyright: ignore
    """A point carried by T."""
    u, v, w = _turned(T, x, y, z)
    return u + T[0, 3], v + T[1, 3], w + T[2, 3]


@numba.njit(cache=True, nogil=True)
def _move(pose, centre, twist):  # pyright: ignore
    """Turns a pose by twist[:3] about the object's centre and shifts it by twist[3:], in place."""
    mx, my, mz = _placed(pose, centre[0], centre[1], centre[2])
    angle = np.sqrt(twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2) + 1e-12
    ax, ay, az = twist[0] / angle, twist[1] / angle, twist[2] / angle
    s, c = np.sin(angle), np.cos(angle)
    for j in range(3):
        # Rodrigues, column by column.
        x, y, z = pose[0, j], pose[1, j], pose[2, j]
        along = (1.0 - c) * (ax * x + ay * y + az * z)
        pose[0, j] = c * x + s * (ay * z - az * y) + along * ax
        pose[1, j] = c * y + s * (az * x - ax * z) + along * ay
        pose[2, j] = c * z + s * (ax * y - ay * x) + along * az
    ox, oy, oz = _turned(pose, centre[0], centre[1], centre[2])
    pose[0, 3], pose[1, 3], pose[2, 3] = mx + twist[3] - ox, my + twist[4] - oy, mz + twist[5] - oz
