"""How an object stands: its gravitational axis, height, and the regions of its bottom, top and cavity."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, rotate
from stages.geometry.regions import Region
from stages.messages.scene import SceneObject
from stages.scene.catalogue import CatalogueObject

ALIGNED = np.deg2rad(15)
"""Largest angle between gravity and an object axis that still counts as aligned, radians."""
SLAB = 0.15
"""Share of the height whose vertices make up the bottom (or top) surface: rims and bevels are not flat."""
CAVITY_SAMPLES = 40
"""Vertical rays along each side of an object that find its upper surface."""
CAVITY_SHARE = 0.35
"""A ray that ends below this share of the hollow's depth has found the floor; above, it found wall or handle."""
DISH_DEPTH = 0.004
"""Least depth of a hollow, metres."""
DISH_FILL = 0.9
"""Share of the rays over the floor that must end low: a bottle's shoulders surround its neck, not a hollow."""
TIPPED = np.deg2rad(30.0)
"""Angle by which an object's upward direction has turned if it was knocked over."""


@dataclass(frozen=True)
class Cavity:
    """The hollow of a tray, bowl or plate that stands upright, in the frame of its :class:`Stance`."""

    floor: float
    """Lowest point, metres above the object's origin."""
    region: Region
    """Where the floor is."""
    opening: Region
    """What the rim surrounds: all that is lower, seen from above."""
    samples: Floats
    """N x 3: points of the upper surface inside ``region``."""

    def height(self, region: Region) -> float:
        """Height at which a flat bottom that covers ``region`` comes to rest: the highest floor point below it."""
        xy = self._raised[:, :2]
        near = self._raised[np.all((xy >= region.min(0)) & (xy <= region.max(0)), axis=1)]
        if not len(near):
            return self.floor
        below = regions.depth(region, near[:, :2]) >= 0
        return float(near[below, 2].max()) if below.any() else self.floor

    @cached_property
    def _raised(self) -> Floats:
        """The samples that stand above the lowest: few of a tray."""
        return self.samples[self.samples[:, 2] > self.floor + 1e-9]


@dataclass(frozen=True)
class Stance:
    """A way for an object to stand. Stance frame: the object's origin, z up, yaw zero."""

    item: CatalogueObject
    R_stance_object: Floats
    aligned: bool
    """False where the object leans: no axis and no resting pose agrees with gravity."""

    @cached_property
    def vertices(self) -> Floats:
        """V x 3, metres."""
        return rotate(self.R_stance_object, self.item.mesh.vertices)

    @cached_property
    def low(self) -> float:
        """Bottom, metres above the origin (negative)."""
        return float(self.vertices[:, 2].min())

    @cached_property
    def high(self) -> float:
        """Top, metres above the origin."""
        return float(self.vertices[:, 2].max())

    @property
    def height(self) -> float:
        """h_i of the paper, metres: where an axis is aligned, the enclosing box's dimension along it."""
        return self.high - self.low

    @cached_property
    def outline(self) -> Region:
        """The whole object seen from above."""
        return regions.hull(self.vertices[:, :2])

    @cached_property
    def radius(self) -> float:
        """Of the circle about the origin that encloses the outline, metres."""
        return float(np.linalg.norm(self.outline, axis=1).max())

    @cached_property
    def bottom(self) -> Region:
        """r_b: the bottom surface; all of a leaning object, which has no bottom."""
        return self._slab(self.vertices[:, 2] <= self.low + SLAB * self.height) if self.aligned else self.outline

    @cached_property
    def top(self) -> Region:
        """r_t: the top surface, across the opening of a concave object."""
        return self._slab(self.vertices[:, 2] >= self.high - SLAB * self.height) if self.aligned else self.outline

    def _slab(self, chosen: NDArray[np.bool_]) -> Region:
        region = regions.hull(self.vertices[chosen, :2])
        return region if len(region) else self.outline

    @cached_property
    def cavity(self) -> Cavity | None:
        """The hollow whose opening points up; it holds nothing once the object is turned."""
        upright = float(self.R_stance_object[2, 2]) > np.cos(ALIGNED)
        return _cavity(self) if upright else None

    @property
    def holds(self) -> bool:
        """Whether what it carries is in it rather than on it: it is concave, and open at the top."""
        return self.item.concave and self.cavity is not None


def _cavity(stance: Stance) -> Cavity | None:
    surface = _upper_surface(stance.vertices, stance.item.mesh.faces)
    floor = float(surface[:, 2].min())
    low = surface[:, 2] < floor + CAVITY_SHARE * (stance.high - floor)
    region = regions.hull(surface[low, :2])
    if stance.high - floor < DISH_DEPTH or not len(region):
        return None
    over_floor = regions.depth(region, surface[:, :2]) >= -1e-9
    filled = float(low[over_floor].mean()) > DISH_FILL
    if not filled and not stance.item.concave:
        return None
    lower = surface[surface[:, 2] < stance.high - DISH_DEPTH, :2]
    within = regions.depth(stance.top, lower) >= 0  # A handle is beside the rim.
    return Cavity(floor, region, regions.hull(lower[within]), surface[low])


def _upper_surface(vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    """Where vertical rays on a square grid first meet the mesh from above, N x 3; rays that miss are left out."""
    corners = vertices[faces]
    corners = corners[_double_area(*corners.transpose(1, 2, 0)) > 1e-12]
    low, high = vertices.min(0), vertices.max(0)
    xs, ys = (np.linspace(low[k], high[k], CAVITY_SAMPLES + 2)[1:-1] for k in range(2))
    columns = [_column(corners, float(x), ys) for x in xs]
    return np.concatenate(columns)


def _double_area(a: Floats, b: Floats, c: Floats) -> Floats:
    """Twice the signed area of triangles seen from above; coordinates stand on the axis before the last."""
    (ax, ay), (bx, by), (cx, cy) = (np.moveaxis(p, -2, 0)[:2] for p in (a, b, c))
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


def _column(corners: Floats, x: float, ys: Floats) -> Floats:
    """The part of the upper surface at one x, N x 3, from the faces (F x 3 x 3) that reach it."""
    near = (corners[:, :, 0].min(1) <= x) & (corners[:, :, 0].max(1) >= x)
    a, b, c = (corners[near, k, :, None] for k in range(3))
    double_area = _double_area(a, b, c)
    u = ((b[:, 0] - x) * (c[:, 1] - ys) - (b[:, 1] - ys) * (c[:, 0] - x)) / double_area
    v = ((c[:, 0] - x) * (a[:, 1] - ys) - (c[:, 1] - ys) * (a[:, 0] - x)) / double_area
    hit = (u >= 0) & (v >= 0) & (u + v <= 1)
    z = np.where(hit, u * a[:, 2] + v * b[:, 2] + (1 - u - v) * c[:, 2], -np.inf).max(0, initial=-np.inf)
    met = np.isfinite(z)
    return np.stack([np.full(met.sum(), x), ys[met], z[met]], axis=1)


class Stances:
    """The stances of one kind of object, computed once each."""

    def __init__(self, item: CatalogueObject) -> None:
        self._item = item
        ups = [*(R.T[:, 2] for R in item.resting), *np.eye(3), *-np.eye(3)]
        self._ups: Floats = np.array(ups)
        self._cached = lru_cache(maxsize=None)(self._aligned)

    def of(self, R_table_object: Floats) -> tuple[Stance, float]:
        """The stance of an object turned like this, and its yaw in radians.

        An object within :data:`ALIGNED` of a resting pose or of an axis stands exactly so: a few degrees of tilt are
        noise of the estimate, and at the rim of a wide object they would move the surface by a centimetre.
        """
        agreement = self._ups @ R_table_object[2]
        best = int(agreement.argmax())
        if agreement[best] < np.cos(ALIGNED):
            return Stance(self._item, R_table_object, False), 0.0
        stance = self._cached(best)
        turn = R_table_object @ stance.R_stance_object.T
        return stance, float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))

    def _aligned(self, which: int) -> Stance:
        return Stance(self._item, rotation_between(self._ups[which], np.array([0.0, 0.0, 1.0])), True)


def rotation_between(a: Floats, b: Floats) -> Floats:
    """The smallest rotation that turns unit vector ``a`` to unit vector ``b``, 3 x 3; about x where they oppose."""
    v, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-9:
        axis = np.cross(a, [1.0, 0.0, 0.0]) if abs(a[0]) < 0.9 else np.cross(a, [0.0, 1.0, 0.0])
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + K + K @ K / (1 + cosine)


def yawed(yaw: float, position: Floats) -> Floats:
    """A 4 x 4 transform that turns about z and moves."""
    T = np.eye(4)
    c, s = np.cos(yaw), np.sin(yaw)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = position
    return T


@dataclass(frozen=True)
class Standing:
    """An object of a scene where it stands, in the table frame."""

    name: str
    stance: Stance
    T_table_stance: Floats
    T_table_leaning: Floats | None = None
    """The object's estimated pose, where it leans by more than an estimate is off."""

    @staticmethod
    def at(name: str, stances: Stances, T_table_object: Floats) -> Standing:
        """An object at an estimated pose."""
        stance, yaw = stances.of(T_table_object[:3, :3])
        return Standing(name, stance, yawed(yaw, T_table_object[:3, 3]))

    @property
    def T_table_object(self) -> Floats:
        """The pose without its few degrees of tilt."""
        T = np.eye(4)
        T[:3, :3] = self.stance.R_stance_object
        return self.T_table_stance @ T

    @property
    def z(self) -> float:
        """Height of the object's origin above the table."""
        return float(self.T_table_stance[2, 3])

    @property
    def z_bottom(self) -> float:
        """Height of the bottom above the table."""
        return self.z + self.stance.low

    @property
    def z_top(self) -> float:
        """Height of the top above the table."""
        return self.z + self.stance.high

    @property
    def z_floor(self) -> float:
        """Height of the cavity's floor above the table; the top where there is no cavity."""
        return self.z + (self.stance.cavity.floor if self.stance.cavity else self.stance.high)

    @cached_property
    def bottom(self) -> Region:
        """r_b in the table frame."""
        return regions.moved(self.stance.bottom, self.T_table_stance)

    @cached_property
    def top(self) -> Region:
        """r_t in the table frame."""
        return regions.moved(self.stance.top, self.T_table_stance)

    @cached_property
    def outline(self) -> Region:
        """The whole object from above, in the table frame."""
        return regions.moved(self.stance.outline, self.T_table_stance)

    def separation(self, other: Standing) -> float:
        """The widest gap between two outlines along any edge's normal, metres; negative where they overlap.

        Never more than :func:`stages.geometry.regions.gap` and much cheaper: enough to check a clearance.
        """
        return max(regions.beyond(self._sides, other.outline), regions.beyond(other._sides, self.outline))

    @cached_property
    def _sides(self) -> tuple[Floats, Floats]:
        return regions.sides(self.outline)

    @cached_property
    def floor(self) -> Region:
        """The cavity's floor in the table frame; empty where there is no cavity."""
        cavity = self.stance.cavity
        return regions.moved(cavity.region, self.T_table_stance) if cavity else regions.EMPTY

    @cached_property
    def middle(self) -> Floats:
        """Of the cavity's floor, which there must be: x and y in the table frame."""
        return regions.centroid(self.floor)

    def centred(self, bottom: Region) -> Region:
        """A bottom (table frame) moved to the middle of the cavity's floor; as it is where there is no cavity."""
        return bottom + self.middle - regions.centroid(bottom) if len(self.floor) else bottom

    def fits(self, bottom: Region) -> bool:
        """Whether a bottom (table frame) finds room on the cavity's floor, so that it need not lean on its wall."""
        return regions.inside(self.centred(bottom), self.floor)

    def rim_bears(self, bottom: Region, hollow: Region) -> bool:
        """Whether a bottom lies on the rim around a ``hollow`` (both in the table frame) all round or on two sides; one
        that overhangs a side would tip inwards."""
        common = regions.overlap(bottom, self.top)
        if not (len(common) and len(hollow)):
            return False
        rests = regions.hull(common[regions.depth(hollow, common) < 0])
        return regions.inside(regions.centroid(common)[None], rests)

    def lies_on_rim(self, bottom: Region) -> bool:
        """Whether a bottom (table frame) neither fits on the cavity's floor nor sinks into its opening."""
        cavity = self.stance.cavity
        if cavity is None or self.fits(bottom):
            return False
        return self.rim_bears(bottom, regions.moved(cavity.opening, self.T_table_stance))

    def rest_height(self, region: Region) -> float:
        """Height above the table at which a flat bottom over ``region`` (table frame) rests on or in this object."""
        place = region.tobytes()
        if place not in self._heights:
            self._heights[place] = self._rest_height(region)
        return self._heights[place]

    @cached_property
    def _heights(self) -> dict[bytes, float]:
        """Those that were asked for: a planner tries the same places again and again."""
        return {}

    def _rest_height(self, region: Region) -> float:
        cavity = self.stance.cavity
        if cavity is None or self.lies_on_rim(region):
            return self.z_top
        return self.z + cavity.height(regions.moved(region, inverse(self.T_table_stance)))


def standing_of(objects: Iterable[SceneObject], stances: Mapping[str, Stances], T_base_table: Floats) -> list[Standing]:
    """Objects of a scene graph where they stand."""
    T_table_base = inverse(T_base_table)
    return [Standing.at(item.name, stances[item.label], T_table_base @ item.T_base_object) for item in objects]


def turned(item: CatalogueObject, A: Floats, B: Floats) -> float:
    """Radians between the sides of an object that are up in two poses (4 x 4), modulo its symmetries."""
    return _between_ups(A, B, item.symmetries.transforms())


def is_tipped(item: CatalogueObject, A: Floats, B: Floats) -> bool:
    """Whether another side is up in two poses (4 x 4), of those that differ by more than what is printed on them."""
    return _between_ups(A, B, item.symmetries.lookalikes()) > TIPPED


def _between_ups(A: Floats, B: Floats, symmetries: Floats) -> float:
    ups = B[2, :3] @ symmetries[:, :3, :3]
    return float(np.arccos(np.clip((ups @ A[2, :3]).max(), -1.0, 1.0)))
