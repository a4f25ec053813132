"""PERCH-style search: every pose of a grid over the table, its bounded two-sided cost, ICP, one object after the other.

Narayanan and Likhachev (2016) explain the image by poses of three degrees of freedom. Here each object in turn, the
nearest first, is searched exhaustively, conditioned on those before it: a grid of 4 cm and 22.5 degrees over its box
for each of its six faces (upright with 3 degrees of freedom), z from what carries it (the table or the top of an
object before). The grid is ranked with a tolerance of half a cell, the best 100 poses are refined by ICP, as PERCH
refines its states, and the one of least cost at 5 mm wins. All readings of the detector's box are to be explained,
where PERCH takes those in the volume of the object: what hides the object would cost nothing. For wrong boxes every
set would have to be searched again: the boxes are searched once, and the set of best rendered-depth agreement is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from benchmarks.common.datasets import Image
from benchmarks.comparison.baselines.common import Box, Dof, Found, best_set
from benchmarks.comparison.baselines.icp import best, on_plane, rotations, starts
from benchmarks.comparison.baselines.observed import Observed
from benchmarks.comparison.baselines.registration import Model
from stages.geometry.arrays import Floats
from stages.perception.rendering.rasteriser import Float32s, View, inverse_depth
from stages.scene.catalogue import Catalogue, CatalogueObject

_CELL = 0.04
_YAWS = 16
_NEAR = 0.005
_COARSE = 0.02
"""Metres within which points are neighbours, while poses of the grid are ranked and in the end."""
_OCCLUDER = 0.05
_LEADERS = 100
_MARGIN = 0.5
"""The image is compared in the box and this share of its size around it."""


@dataclass(frozen=True)
class Perch:
    """The estimator."""

    _known: dict[int, tuple[CatalogueObject, Model]] = field(default_factory=dict[int, "tuple[CatalogueObject, Model]"])

    def prepare(self, catalogue: Catalogue) -> None:
        """Samples every object."""
        for item in catalogue.objects.values():
            self._model(item)

    def __call__(self, image: Image, catalogue: Catalogue, *, dof: Dof = 6, seed: int = 0) -> list[Found]:
        """One pose for each of the ``image.n_objects`` boxes that explain the image best."""
        observed = Observed.of(image, seed)
        models = [self._model(catalogue[box.label]) for box in image.boxes]
        rng = np.random.default_rng([seed, *image.id])
        boxes = [Box(observed, box, model, dof, rng) for box, model in zip(image.boxes, models, strict=True)]
        found = [np.zeros((0, 4, 4))] * len(boxes)
        scene = Scene.of(observed)
        for i in sorted(range(len(boxes)), key=lambda i: _distance(boxes[i])):
            found[i] = scene.search(boxes[i])
        return best_set(observed, image.boxes, models, found, image.n_objects)

    def _model(self, item: CatalogueObject) -> Model:
        if id(item) not in self._known:
            self._known[id(item)] = item, Model.of(item)
        return self._known[id(item)][1]


@dataclass
class Scene:
    """An image at about 5 mm between points, and the objects placed so far."""

    observed: Observed
    stride: int
    view: View
    points: Floats
    """H x W x 3 readings, z = 0 where there is none."""
    foreground: NDArray[np.bool_]
    placed: Float32s
    """Inverse depth of the objects before."""
    tops: list[Floats]
    """x, y, height (table frame) and radius of each."""

    @staticmethod
    def of(observed: Observed) -> Scene:
        """An image without objects."""
        depth = float(np.median(observed.depth[observed.depth > 0]))
        stride = max(1, round(_NEAR * observed.view.fx / depth))
        view = observed.view.sampled(*observed.whole, stride)
        part = np.s_[::stride, ::stride]
        empty = np.zeros((view.height, view.width), np.float32)
        return Scene(observed, stride, view, observed.points[part], observed.foreground[part], empty, [])

    def search(self, box: Box) -> Floats:
        """The pose of least cost, which joins the scene; 1 x 4 x 4, none where the box holds no readings."""
        if len(box.observed.inside(box.candidate)) < 10:
            return np.zeros((0, 4, 4))
        grid = self._grid(box)
        if not len(grid):
            # What carries the object is farther away and not placed yet: heights are then those that are measured.
            grid = starts(box)
        leaders = grid[np.argsort(self._costs(box, grid, _COARSE), kind="stable")[:_LEADERS]]
        refined = best(box, leaders)
        if not len(refined):
            return refined
        chosen = refined[int(np.argmin(self._costs(box, refined, _NEAR)))]
        self._place(box.model, chosen)
        return chosen[None]

    def _costs(self, box: Box, poses: Floats, near: float) -> Floats:
        """Two-sided cost of P x 4 x 4 poses; the readings above the plane in the detector's box are sought."""
        x0, y0, x1, y1 = (edge // self.stride for edge in self.observed.region(box.candidate.box, _MARGIN))
        part = np.s_[y0 : y1 + 1, x0 : x1 + 1]
        left, top, right, bottom = (edge // self.stride for edge in self.observed.region(box.candidate.box))
        sought = np.zeros(self.foreground.shape, bool)
        sought[top : bottom + 1, left : right + 1] = self.foreground[top : bottom + 1, left : right + 1]
        view = self.view.sampled(x0, y0, min(x1 + 1, self.view.width), min(y1 + 1, self.view.height), 1)
        placed, points, sought = (np.ascontiguousarray(image[part]) for image in (self.placed, self.points, sought))
        rays = view.rays()
        layers = (inverse_depth(box.model.soup, T, view) for T in poses)
        return np.array([two_sided(layer, placed, points, sought, rays, near) for layer in layers])

    def _grid(self, box: Box) -> Floats:
        """Poses whose centre is in the box, on the table and on what is placed there already, P x 4 x 4."""
        T_camera_table = self.observed.T_camera_table
        x0, y0, x1, y1 = box.candidate.box
        on_table = (box.observed.inside(box.candidate) - T_camera_table[:3, 3]) @ T_camera_table[:3, :3]
        low, high = np.percentile(on_table[:, :2], [2, 98], axis=0)
        xs, ys = (np.arange(a - _CELL, b + 2 * _CELL, _CELL) for a, b in zip(low, high, strict=True))
        found: list[Floats] = []
        for R in rotations(T_camera_table, box.dof, _YAWS):
            T = np.eye(4)
            T[:3, :3] = R
            T[:3, 3] = T_camera_table[:3, 3] - R @ box.model.centre
            standing = on_plane(T[None], box.model, T_camera_table)[0]
            places = np.array([[x, y, z] for x in xs for y in ys for z in self._heights(x, y)])
            moved = np.tile(standing, (len(places), 1, 1))
            moved[:, :3, 3] += places @ T_camera_table[:3, :3].T
            at = self.observed.view.project(moved[:, :3, 3] + R @ box.model.centre)
            found.append(moved[((at >= [x0, y0]) & (at <= [x1, y1])).all(1)])
        return np.concatenate(found)

    def _heights(self, x: float, y: float) -> list[float]:
        return [0.0, *(z for a, b, z, radius in self.tops if (a - x) ** 2 + (b - y) ** 2 < radius**2)]

    def _place(self, model: Model, T: Floats) -> None:
        T_camera_table = self.observed.T_camera_table
        surface = (model.points @ T[:3, :3].T + T[:3, 3] - T_camera_table[:3, 3]) @ T_camera_table[:3, :3]
        middle = surface.mean(0)
        radius = float(np.ptp(surface[:, :2], axis=0).max() / 2)
        self.tops.append(np.array([middle[0], middle[1], surface[:, 2].max(), radius]))
        self.placed = np.maximum(self.placed, inverse_depth(model.soup, T, self.view))


def _distance(box: Box) -> float:
    readings = box.observed.inside(box.candidate)
    return float(np.median(readings[:, 2])) if len(readings) else np.inf


@numba.njit(cache=True, nogil=True)
def two_sided(rendered, placed, points, sought, rays, near):  # pyright: ignore  # noqa: PLR0917
    """Rendered points without a reading within ``near``, plus ``sought`` readings without a rendered point.

    A pixel whose reading lies 5 cm in front, or where an object before is nearer, counts for nothing.
    """
    cost = 0.0
    for v in range(rendered.shape[0]):
        for u in range(rendered.shape[1]):
            q, z = rendered[v, u], points[v, u, 2]
            if q > 0 and q > placed[v, u] and z > 0 and z >= 1.0 / q - _OCCLUDER:
                cost += 0.0 if _has_reading(rays, 1.0 / q, points, v, u, near) else 1.0
            if sought[v, u] and placed[v, u] == 0:
                cost += 0.0 if _has_rendered(points, rendered, rays, v, u, near) else 1.0
    return cost


@numba.njit(cache=True, nogil=True)
def _has_reading(rays, z, points, v, u, near):  # pyright: ignore  # noqa: PLR0917
    """Whether a reading lies within ``near`` of the rendered point of a pixel, among the pixels around it."""
    for y in range(max(0, v - 1), min(points.shape[0], v + 2)):
        for x in range(max(0, u - 1), min(points.shape[1], u + 2)):
            if points[y, x, 2] > 0 and _squared(points, y, x, rays, v, u, z) < near * near:
                return True
    return False


@numba.njit(cache=True, nogil=True)
def _has_rendered(points, rendered, rays, v, u, near):  # pyright: ignore  # noqa: PLR0917
    """Whether a rendered point lies within ``near`` of a pixel's reading, among the pixels around it."""
    for y in range(max(0, v - 1), min(rendered.shape[0], v + 2)):
        for x in range(max(0, u - 1), min(rendered.shape[1], u + 2)):
            if rendered[y, x] > 0 and _squared(points, v, u, rays, y, x, 1.0 / rendered[y, x]) < near * near:
                return True
    return False


@numba.njit(cache=True, nogil=True)
def _squared(points, v, u, rays, y, x, z):  # pyright: ignore  # noqa: PLR0917
    """Squared distance from the reading at (u, v) to the point of depth z at (x, y)."""
    total = 0.0
    for i in range(3):
        gap = points[v, u, i] - rays[y, x, i] * z
        total += gap * gap
    return total


estimate = Perch()
