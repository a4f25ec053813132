"""What rigid objects cannot do: reach into one another, sink into the table, or float.

Every object is a signed distance grid, built once: negative inside its material, so that what lies in a bowl is
outside of it. Points of one object are looked up in the grid of the other (Fuhrmann et al., 2003).
"""

# ruff: noqa: PLR0917
# pyright: reportMissingParameterType=false
# Kernels take plain arrays by position.

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import ConvexHull

from stages.geometry.arrays import Floats
from stages.geometry.poses import compose, rotate
from stages.perception.rendering.rasteriser import INLINED, KERNEL, Float32s
from stages.scene.catalogue import CatalogueObject, Mesh

_SAMPLES = 300
_HULL = 100
"""Vertices of the convex hull at most: the corners that sampling misses."""
_CELLS = 48
_SPACING = (0.0025, 0.005)
"""Metres between the nodes of a grid, at least and at most."""
_TOUCH = 0.0003
"""Metres from a surface at which something touches it."""
_SLOPE = 0.5
"""A surface carries something if its normal rises by this share of its length."""
_FAR = 10.0
_HALF = 0.5001 * np.sqrt(3.0)
"""Half the diagonal of a cell, and a little more."""
_ON = 1e-6
"""Metres from the surface within which rounding decides the side."""
_f = np.float32


@dataclass(frozen=True, kw_only=True)
class ContactForm:
    """What contact that cannot be costs. Up to a slack it costs nothing: sensors are biased and surfaces rough."""

    penetration_slack: float = 0.006
    """Metres that two objects may reach into one another."""
    plane_slack: float = 0.015
    """Metres that an object may lie below or above the plane: a sensor's bias lifts the plane it sees."""
    penetration_weight: float = 0.5
    floating_weight: float = 0.1
    """Mild: what carries an object need not be in the catalogue."""
    most: float = 0.03
    """Metres beyond the slack from which more costs no more."""


@dataclass(frozen=True)
class Solid:
    """An object's surface points and the signed distance to its surface."""

    points: Float32s
    """P x 3, object frame, metres."""
    grid: Float32s
    """X x Y x Z signed distances at the nodes, metres, negative inside."""
    origin: Float32s
    """Position of the first node, object frame, metres."""
    spacing: float
    shadow: float
    """Mean area of the shadow of the convex hull, square metres: a quarter of its surface (Cauchy)."""

    @staticmethod
    def of(item: CatalogueObject) -> Solid:
        """Samples an object; takes some tenths of a second."""
        mesh = item.simplified(500)
        hull = ConvexHull(mesh.vertices)
        corners = mesh.vertices[hull.vertices]
        points = np.concatenate([_surface_points(mesh), corners[:: -(-len(corners) // _HULL)]])
        spacing = float(np.clip(np.sqrt((item.dimensions**2).sum()) / _CELLS, *_SPACING))
        low = item.bounds[0] - 2 * spacing
        shape = tuple(int(n) for n in np.ceil(item.dimensions / spacing) + 5)
        grid = np.empty(shape, np.float32)
        _fill_grid(mesh.vertices[mesh.faces], low, spacing, grid)
        return Solid(points.astype(np.float32), grid, low.astype(np.float32), spacing, float(hull.area) / 4)


@dataclass(frozen=True)
class Contacts:
    """How the N objects of a scene touch, metres."""

    penetration: Floats
    """N x N, symmetric: how deep a surface point of one lies inside the other."""
    sunk: Floats
    """N: how far the lowest point lies below the plane."""
    gap: Floats
    """N: how far the object would fall before the plane or another object carries it."""


def contacts(solids: Sequence[Solid], poses: Floats, T_camera_table: Floats) -> Contacts:
    """Measures every pair of objects at poses N x 3 x 4 (or N x 4 x 4, T_camera_object) above a plane."""
    count = len(solids)
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    up, origin = T_camera_table[:3, 2], T_camera_table[:3, 3]
    lowest = np.array([_lowest(solid, pose[:3], up, origin) for solid, pose in zip(solids, poses, strict=True)])
    penetration, gap = np.zeros((count, count)), np.maximum(lowest, 0.0)
    for b in range(count):
        inverse = R[b].T
        up_in_b = rotate(inverse, up)
        for a in range(count):
            if a == b:
                continue
            into_b = np.concatenate([compose(inverse, R[a]), rotate(inverse, t[a] - t[b])[:, None]], 1)
            deep, fall, rise = _probed(solids[a], solids[b], into_b, up_in_b)
            penetration[a, b] = penetration[b, a] = max(penetration[a, b], deep)
            gap[a], gap[b] = min(gap[a], fall), min(gap[b], rise)
    return Contacts(penetration, np.maximum(-lowest, 0.0), gap)


def penalty(found: Contacts, pixels: Floats, form: ContactForm | None = None) -> float:
    """What the contacts cost, metres times pixels as the costs of equation 9.

    ``pixels`` are the objects' apparent sizes (:func:`apparent`), N; a pair counts as much as its smaller object.
    """
    form = form or ContactForm()
    pairs = np.minimum(pixels[:, None], pixels[None])
    reach = np.triu(_beyond(found.penetration, form.penetration_slack, form.most) * pairs, 1)
    alone = form.penetration_weight * _beyond(found.sunk, form.plane_slack, form.most)
    alone += form.floating_weight * _beyond(found.gap, form.plane_slack, form.most)
    return float(form.penetration_weight * reach.sum() + (alone * pixels).sum())


def apparent(solids: Sequence[Solid], poses: Floats, focal: float) -> Floats:
    """Pixels that each object covers where nothing hides it, whatever its orientation, N."""
    shadows = np.array([solid.shadow for solid in solids])
    return shadows * (focal / np.maximum(poses[:, 2, 3], 0.05)) ** 2


def _beyond(metres: Floats, slack: float, most: float) -> Floats:
    return np.clip(metres - slack, 0.0, most)


def _lowest(solid: Solid, pose: Floats, up: Floats, origin: Floats) -> float:
    """Height of the lowest point above the plane, metres."""
    slope = (pose[:, :3] * up[:, None]).sum(0)
    return float((solid.points * slope).sum(1).min() + ((pose[:, 3] - origin) * up).sum())


def _probed(a: Solid, b: Solid, T_b_a: Floats, up: Floats) -> tuple[float, float, float]:
    found = _probe(a.points, b.grid, b.origin, _f(b.spacing), T_b_a.astype(np.float32), up.astype(np.float32))
    return float(found[0]), float(found[1]), float(found[2])


def _surface_points(mesh: Mesh) -> Floats:
    """Points spread evenly over the surface by area: systematic along the triangles, a Kronecker sequence inside."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    share = np.cumsum(np.sqrt((normals**2).sum(1)))
    index = np.arange(_SAMPLES)
    chosen = np.searchsorted(share / share[-1], (index + 0.5) / _SAMPLES)
    u, v = (index * 0.7548776662466927) % 1.0, (index * 0.5698402909980532) % 1.0
    root = np.sqrt(u)
    weights = np.stack([1 - root, root * (1 - v), root * v], -1)
    return (corners[np.minimum(chosen, len(corners) - 1)] * weights[..., None]).sum(1)


@numba.njit(**KERNEL)
def _probe(points, grid, origin, spacing, T, up):
    """Looks points of object a up in the grid of b (T: T_b_a, ``up`` in the frame of b).

    Returns how deep they are inside b, how far a falls before b carries it, and how far b falls before a carries it.
    """
    deep, fall, rise = _f(0), _f(_FAR), _f(_FAR)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3] - origin[0]
        py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3] - origin[1]
        pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3] - origin[2]
        deep = max(deep, -_distance(grid, px / spacing, py / spacing, pz / spacing))
        fall = _march(grid, spacing, px, py, pz, -up[0], -up[1], -up[2], fall)
        rise = _march(grid, spacing, px, py, pz, up[0], up[1], up[2], rise)
    return deep, fall, rise


@numba.njit(**INLINED)
def _march(grid, spacing, px, py, pz, dx, dy, dz, reach):
    """How far a point travels along a unit direction before a surface that faces it stops it, ``reach`` at most:
    sphere tracing (Hart, 1996) inside the grid's box."""
    t, leave = _f(0), reach
    for k in range(3):
        p = px if k == 0 else (py if k == 1 else pz)
        d = dx if k == 0 else (dy if k == 1 else dz)
        size = spacing * _f(grid.shape[k] - 1)
        d = d if abs(d) > _f(1e-6) else _f(1e-6)
        first, second = -p / d, (size - p) / d
        t, leave = max(t, min(first, second)), min(leave, max(first, second))
    while t < leave:
        x, y, z = (px + t * dx) / spacing, (py + t * dy) / spacing, (pz + t * dz) / spacing
        distance = _distance(grid, x, y, z)
        if distance < _f(_TOUCH):
            h = _f(0.5)
            gx = _distance(grid, x + h, y, z) - _distance(grid, x - h, y, z)
            gy = _distance(grid, x, y + h, z) - _distance(grid, x, y - h, z)
            gz = _distance(grid, x, y, z + h) - _distance(grid, x, y, z - h)
            facing = -(gx * dx + gy * dy + gz * dz)
            return t if facing > _f(_SLOPE) * np.sqrt(gx * gx + gy * gy + gz * gz) else reach
        t += distance
    return reach


@numba.njit(**INLINED)
def _distance(grid, x, y, z):
    """Signed distance at a position in cells from the first node, trilinear; far outside of the grid."""
    nx, ny, nz = grid.shape
    if not (x >= 0 and y >= 0 and z >= 0 and x < nx - 1 and y < ny - 1 and z < nz - 1):
        return _f(_FAR)
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - _f(i), y - _f(j), z - _f(k)
    a = grid[i, j, k] * (_f(1) - w) + grid[i, j, k + 1] * w
    b = grid[i, j + 1, k] * (_f(1) - w) + grid[i, j + 1, k + 1] * w
    c = grid[i + 1, j, k] * (_f(1) - w) + grid[i + 1, j, k + 1] * w
    d = grid[i + 1, j + 1, k] * (_f(1) - w) + grid[i + 1, j + 1, k + 1] * w
    return (a * (_f(1) - v) + b * v) * (_f(1) - u) + (c * (_f(1) - v) + d * v) * u


@numba.njit(**KERNEL)
def _fill_grid(triangles, low, spacing, grid):
    """Signed distances of every node: distance to the nearest triangle, inside where the winding number says so.

    Along a row the sign can only change where the surface is nearer than the next node.
    """
    distances = np.empty(grid.shape)
    _fill_distances(triangles, low, spacing, distances)
    sides = np.empty((9, triangles.shape[0]))
    for t in range(triangles.shape[0]):
        for c in range(9):
            sides[c, t] = triangles[t, c // 3, c % 3]
    p = np.empty(3)
    for i in range(grid.shape[0]):
        for j in range(grid.shape[1]):
            before, inside = 1e9, False
            for k in range(grid.shape[2]):
                distance = distances[i, j, k]
                if k == 0 or before <= spacing:
                    p[0], p[1], p[2] = low[0] + i * spacing, low[1] + j * spacing, low[2] + k * spacing
                    inside = _is_inside(p, triangles, sides, distance)
                before = distance
                grid[i, j, k] = -distance if inside else distance


@numba.njit(**INLINED)
def _fill_distances(triangles, low, spacing, distances):
    """Distance of every node to the nearest triangle, by blocks of 4 x 4 x 4 nodes and blocks of 2 x 2 x 2 in them.

    Only triangles that are nearly as near to the middle of a block as the nearest one can be the nearest of a node in
    it: two points' distances to a triangle differ by no more than the way between them.
    """
    count = triangles.shape[0]
    everything, spheres = np.arange(count), _spheres(triangles)
    some, few, away = np.empty(count, np.intp), np.empty(count, np.intp), np.empty(count)
    middle, p = np.empty(3), np.empty(3)
    wide, narrow = _HALF * 3.0 * spacing, _HALF * spacing
    for block in np.ndindex(
        (distances.shape[0] + 3) // 4, (distances.shape[1] + 3) // 4, (distances.shape[2] + 3) // 4
    ):
        for c in range(3):
            middle[c] = low[c] + (4 * block[c] + 1.5) * spacing
        n, _ = _near(middle, triangles, everything, count, 2.0 * wide, some, away)
        for part in np.ndindex(2, 2, 2):
            x, y, z = 4 * block[0] + 2 * part[0], 4 * block[1] + 2 * part[1], 4 * block[2] + 2 * part[2]
            if x >= distances.shape[0] or y >= distances.shape[1] or z >= distances.shape[2]:
                continue
            middle[0], middle[1], middle[2] = (
                low[0] + (x + 0.5) * spacing,
                low[1] + (y + 0.5) * spacing,
                low[2] + (z + 0.5) * spacing,
            )
            m, nearest = _near(middle, triangles, some, n, 2.0 * narrow, few, away)
            for i in range(x, min(x + 2, distances.shape[0])):
                for j in range(y, min(y + 2, distances.shape[1])):
                    for k in range(z, min(z + 2, distances.shape[2])):
                        p[0], p[1], p[2] = low[0] + i * spacing, low[1] + j * spacing, low[2] + k * spacing
                        distances[i, j, k] = _nearest(p, triangles, spheres, few, m, nearest + narrow)


@numba.njit(**INLINED)
def _near(p, triangles, among, count, slack, kept, away):
    """Writes which of the triangles are farther from p than the nearest by no more than ``slack``, and how far."""
    nearest = 1e9
    for n in range(count):
        away[n] = np.sqrt(_squared_distance(p, triangles[among[n]]))
        nearest = min(nearest, away[n])
    found = 0
    for n in range(count):
        if away[n] <= nearest + slack:
            kept[found], away[found] = among[n], away[n]
            found += 1
    return found, nearest


@numba.njit(**INLINED)
def _nearest(p, triangles, spheres, few, count, bound):
    """Distance to the nearest of a few triangles, none farther than ``bound``."""
    best = bound * bound
    for n in range(count):
        t = few[n]
        away = (p[0] - spheres[t, 0]) ** 2 + (p[1] - spheres[t, 1]) ** 2 + (p[2] - spheres[t, 2]) ** 2
        if np.sqrt(away) - spheres[t, 3] < np.sqrt(best):
            best = min(best, _squared_distance(p, triangles[t]))
    return np.sqrt(best)


@numba.njit(**INLINED)
def _spheres(triangles):
    """Middle and radius of a sphere around each triangle, T x 4."""
    spheres = np.zeros((triangles.shape[0], 4))
    for t in range(triangles.shape[0]):
        for k in range(3):
            spheres[t, k] = (triangles[t, 0, k] + triangles[t, 1, k] + triangles[t, 2, k]) / 3.0
        for c in range(3):
            s = 0.0
            for k in range(3):
                s += (triangles[t, c, k] - spheres[t, k]) ** 2
            spheres[t, 3] = max(spheres[t, 3], np.sqrt(s))
    return spheres


@numba.njit(**INLINED)
def _is_inside(p, triangles, sides, distance):
    """Whether the winding number exceeds a half; roughly where that tells."""
    if distance > _ON:
        rough = _roughly_winding(p, sides)
        if abs(rough - 0.5) > 0.1:
            return rough > 0.5
    return _winding(p, triangles) > 0.5


@numba.njit(**INLINED)
def _roughly_winding(p, sides):
    """The winding number to 1e-5 a triangle, without a branch: the arc tangent is Abramowitz and Stegun's 4.4.47."""
    total = 0.0
    x, y, z = p[0], p[1], p[2]
    for t in range(sides.shape[1]):
        ax, ay, az = sides[0, t] - x, sides[1, t] - y, sides[2, t] - z
        bx, by, bz = sides[3, t] - x, sides[4, t] - y, sides[5, t] - z
        cx, cy, cz = sides[6, t] - x, sides[7, t] - y, sides[8, t] - z
        a, b, c = (np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz),
                   np.sqrt(cx * cx + cy * cy + cz * cz))  # fmt: skip
        volume = ax * (by * cz - bz * cy) - ay * (bx * cz - bz * cx) + az * (bx * cy - by * cx)
        ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
        solid = a * b * c + ab * c + bc * a + ca * b
        high, wide = abs(volume), abs(solid)
        steep = high > wide
        r = wide / high if steep else high / wide
        q = r * r
        angle = r * (0.9998660 + q * (-0.3302995 + q * (0.1801410 + q * (-0.0851330 + q * 0.0208351))))
        angle = 0.5 * np.pi - angle if steep else angle
        angle = np.pi - angle if solid < 0.0 else angle
        total += angle if volume > 0.0 else -angle
    return total / (2.0 * np.pi)


@numba.njit(**INLINED)
def _squared_distance(p, triangle):
    """To a triangle (Ericson, Real-Time Collision Detection, 5.1.5)."""
    ax, ay, az = triangle[0, 0] - p[0], triangle[0, 1] - p[1], triangle[0, 2] - p[2]
    bx, by, bz = triangle[1, 0] - p[0], triangle[1, 1] - p[1], triangle[1, 2] - p[2]
    cx, cy, cz = triangle[2, 0] - p[0], triangle[2, 1] - p[1], triangle[2, 2] - p[2]
    ux, uy, uz = bx - ax, by - ay, bz - az
    wx, wy, wz = cx - ax, cy - ay, cz - az
    d1, d2 = -(ux * ax + uy * ay + uz * az), -(wx * ax + wy * ay + wz * az)
    d3, d4 = -(ux * bx + uy * by + uz * bz), -(wx * bx + wy * by + wz * bz)
    d5, d6 = -(ux * cx + uy * cy + uz * cz), -(wx * cx + wy * cy + wz * cz)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0 and d2 <= 0:
        v, w = 0.0, 0.0
    elif d3 >= 0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        v, w = d1 / (d1 - d3), 0.0
    elif d6 >= 0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        v, w = 0.0, d2 / (d2 - d6)
    elif va <= 0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        total = va + vb + vc
        v, w = vb / total, vc / total
    x, y, z = ax + v * ux + w * wx, ay + v * uy + w * wy, az + v * uz + w * wz
    return x * x + y * y + z * z


@numba.njit(**INLINED)
def _winding(p, triangles):
    """Winding number of a mesh about a point, which small holes do not upset (Jacobson et al., 2013)."""
    total = 0.0
    for t in range(triangles.shape[0]):
        ax, ay, az = triangles[t, 0, 0] - p[0], triangles[t, 0, 1] - p[1], triangles[t, 0, 2] - p[2]
        bx, by, bz = triangles[t, 1, 0] - p[0], triangles[t, 1, 1] - p[1], triangles[t, 1, 2] - p[2]
        cx, cy, cz = triangles[t, 2, 0] - p[0], triangles[t, 2, 1] - p[1], triangles[t, 2, 2] - p[2]
        a, b, c = (np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz),
                   np.sqrt(cx * cx + cy * cy + cz * cz))  # fmt: skip
        volume = ax * (by * cz - bz * cy) - ay * (bx * cz - bz * cx) + az * (bx * cy - by * cx)
        ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
        total += np.arctan2(volume, a * b * c + ab * c + bc * a + ca * b)
    return total / (2.0 * np.pi)
