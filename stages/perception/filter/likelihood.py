"""Likelihood of one object's pose given everything else in the image (paper, equations 8 and 9).

Rendered and observed point of a pixel lie on one ray, so their distance is |z_R - z_O| times the length of the ray
with unit depth, a factor known in advance. The cost of a pose is the cost of the background (support plane and
objects estimated before) plus, over the pixels where the object is in front of that background, what the object
costs there less what the background had cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from stages.geometry.arrays import Floats
from stages.geometry.poses import along
from stages.perception.observation.plane import height_above, stands_out
from stages.perception.rendering.kernels import change_of_cost, evidence, gauss_newton
from stages.perception.rendering.rasteriser import Float32s, Soup, View, inverse_depth
from stages.scene.catalogue import Mesh

_STRAY = 4.0
"""A centre one apparent diameter outside costs so many times what the window costs without the object."""
_FAR = 10.0
"""Where no surface is, one is taken to be this far away, metres: a renderer's far plane."""
_SLACK = 0.2
"""Apparent diameters that a detector's box may be off by."""


@dataclass(frozen=True, kw_only=True)
class CostForm:
    """What a pixel costs where the object is visible; distances in metres.

    * No reading: nothing. Invalid depth is not evidence.
    * A reading more than ``occluder_margin`` in front of the rendered surface: something unknown hides the object.
      The pixel stays as unexplained as it was and costs ``occluder_cost`` besides.
    * Otherwise the distance between the two points, at most ``truncation``.
    * A reading of the plane costs nothing, though it misses the plane by the sensor's noise: whatever covers it, such
      as the floor of a tray, may miss it by as much.

    ``plain`` is the paper's plain sum: a pixel is worth explaining by all that the background misses it by.
    """

    truncation: float = 0.03
    occluder_margin: float = 0.03
    occluder_cost: float = 0.004
    contact_slack: float = 0.015
    """How far an object may reach below the plane before that costs: a sensor's bias lifts the plane it sees."""
    plain: bool = False

    @staticmethod
    def paper() -> CostForm:
        """Equation 9 as it stands: unbounded, no occluders, no contact."""
        return CostForm(truncation=100.0, occluder_margin=100.0, occluder_cost=0.0, contact_slack=100.0, plain=True)

    def truncated(self, truncation: float) -> CostForm:
        """The same form with a tighter bound; what is measured against the bound shrinks with it."""
        share = truncation / self.truncation
        return replace(
            self,
            truncation=truncation,
            occluder_margin=self.occluder_margin * share,
            occluder_cost=self.occluder_cost * share,
        )


@dataclass(frozen=True)
class ObservedScene:
    """A depth image made ready: H x W arrays at full resolution."""

    view: View
    depth: Float32s
    """Metres, 0 where there is no reading."""
    factor: Float32s
    """Length of the pixel's ray with unit depth; 0 where there is no reading."""
    foreground: NDArray[np.bool_]
    plane_inverse: Float32s
    """1/z of the support plane, 0 above its horizon."""
    leeway: Float32s
    """By how much readings of the plane miss it, metres; 0 for all others."""
    T_camera_table: Floats

    @staticmethod
    def of(depth: Float32s, foreground: NDArray[np.bool_], K: Floats, T_camera_table: Floats) -> ObservedScene:
        """Prepares an observation (metres, 0 invalid; intrinsics in pixels)."""
        height, width = depth.shape
        view = View.of(K, width, height)
        rays = view.rays()
        normal, origin = T_camera_table[:3, 2], T_camera_table[:3, 3]
        inverse = np.maximum(along(rays, normal) / (normal * origin).sum(), 0.0)
        factor = np.sqrt(along(rays, rays)) * (depth > 0)
        of_plane = ~foreground & ~stands_out(np.abs(height_above(depth, view, T_camera_table)), depth)
        miss = np.abs(factor * (1.0 / np.maximum(inverse, 1 / _FAR) - depth))
        return ObservedScene(
            view,
            np.ascontiguousarray(depth, np.float32),
            factor.astype(np.float32),
            foreground & (depth > 0),
            inverse.astype(np.float32),
            np.where(of_plane, miss, 0.0).astype(np.float32),
            np.asarray(T_camera_table, float),
        )

    @property
    def plane(self) -> Float32s:
        """Unit normal and offset: n . p + offset is a point's height above the plane, metres."""
        normal = self.T_camera_table[:3, 2]
        return np.append(normal, -(normal * self.T_camera_table[:3, 3]).sum()).astype(np.float32)


@dataclass(frozen=True)
class Shape:
    """A mesh at one level of detail, ready for the kernel."""

    soup: Soup
    support: Float32s
    """S x 3 vertices of the convex hull: one of them is the lowest point, whatever the orientation."""
    centre: Floats
    """Middle of the enclosing box, object frame, metres."""
    diameter: float
    """Diagonal of the enclosing box, metres."""

    @staticmethod
    def of(mesh: Mesh) -> Shape:
        """Prepares a mesh."""
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        hull = mesh.vertices[ConvexHull(mesh.vertices).vertices]
        return Shape(
            Soup.of(mesh), hull.astype(np.float32), (low + high) / 2, float(np.sqrt(((high - low) ** 2).sum()))
        )


@dataclass(frozen=True)
class Window:
    """The part of a scene that one object's filter looks at, every ``stride``-th pixel of it."""

    view: View
    inverse_background: Float32s
    observed: Float32s
    factor: Float32s
    credit: Float32s
    """What the background costs where the object may take credit for explaining it: inside its box. Where it costs
    nothing though it misses the reading, what it misses it by, below zero."""
    box: Floats
    """The candidate's box x0, y0, x1, y1 in pixels of this window."""
    reach: tuple[float, float]
    """Smallest and largest depth of what the object may explain, metres, outliers apart."""

    @property
    def base(self) -> float:
        """Cost of the window without the object, metres times pixels."""
        return float(np.maximum(self.credit, 0.0).sum(dtype=np.float64))

    @staticmethod
    def of(
        scene: ObservedScene,
        background: Float32s,
        box: tuple[int, int, int, int],
        region: tuple[int, int, int, int],
        *,
        stride: int,
        form: CostForm,
    ) -> Window:
        """Cuts ``region`` (x0, y0, x1, y1 pixels, exclusive) out of a scene.

        ``background`` is the H x W inverse depth of everything known; credit is given inside ``box``.
        """
        x0, y0, x1, y1 = region
        part = np.s_[y0:y1:stride, x0:x1:stride]
        credit = np.zeros((y1 - y0, x1 - x0), np.float32)
        rows, columns = slice(box[1], box[3]), slice(box[0], box[2])
        credit[box[1] - y0 : box[3] - y0, box[0] - x0 : box[2] - x0] = credits(scene, background, form, (rows, columns))
        if not form.plain:
            credit -= scene.leeway[y0:y1, x0:x1]
        credit = credit[::stride, ::stride]
        open_depths = scene.depth[part][credit > 0]
        low, high = np.percentile(open_depths, [2, 98]) if len(open_depths) else (0.0, np.inf)
        corner = np.array([x0, y0, x0, y0], float)
        return Window(
            scene.view.sampled(*region, stride),
            *(np.ascontiguousarray(a) for a in (background[part], scene.depth[part], scene.factor[part], credit)),
            box=(np.array(box, float) - corner) / stride,
            reach=(float(low), float(high)),
        )


def credits(
    scene: ObservedScene, background: Float32s, form: CostForm, part: tuple[slice, slice] = np.s_[:, :]
) -> Float32s:
    """What each pixel of a part costs with the background alone, metres: what an object gains by explaining it."""
    behind = 1.0 / np.maximum(background[part], 1 / _FAR) - scene.depth[part]
    miss = scene.factor[part] * behind
    if form.plain:
        return np.abs(miss).astype(np.float32)
    # Only readings in front of the background ask for an explanation; the plane's own noise does not.
    return (np.clip(miss, 0.0, form.truncation) * scene.foreground[part]).astype(np.float32)


class Evaluator(Protocol):
    """Weighs and polishes poses P x 3 x 4 of one shape in one window, on whichever device."""

    def changes(self, poses: Floats) -> Float32s:
        """By how much each pose changes the window's cost, P."""
        ...

    def refined(self, poses: Floats, directions: Floats, *, steps: int, gate: float) -> Floats:
        """As :meth:`ObjectLikelihood.refine`."""
        ...


MakeEvaluator = Callable[[Shape, Window, Float32s, CostForm], Evaluator]
"""Makes one from a shape, a window, the plane (unit normal and offset) and the form of the cost."""


class CpuEvaluator:
    """On one core."""

    def __init__(self, shape: Shape, window: Window, plane: Float32s, form: CostForm) -> None:
        self._shape, self._window, self._plane = shape, window, plane
        limits = form.truncation, form.occluder_margin, form.occluder_cost, form.contact_slack
        self._limits = np.array(limits, np.float32)
        self._evidence = evidence(
            window.inverse_background.ravel(), window.observed.ravel(), window.factor.ravel(), window.credit.ravel(),
            window.view.numbers,
        )  # fmt: skip

    def changes(self, poses: Floats) -> Float32s:
        """As in :class:`Evaluator`."""
        out = np.zeros(len(poses), np.float32)
        soup = self._shape.soup
        change_of_cost(
            soup.lanes, soup.blocks, soup.corners, self._shape.support, np.ascontiguousarray(poses, np.float32),
            self._window.view.numbers, self._evidence, self._plane, self._limits, out,
        )  # fmt: skip
        return out

    def refined(self, poses: Floats, directions: Floats, *, steps: int, gate: float) -> Floats:
        """As in :class:`Evaluator`."""
        moved = np.array(poses, np.float64)
        soup, window = self._shape.soup, self._window
        gauss_newton(
            soup.lanes, soup.blocks, soup.corners, self._shape.centre, moved, steps, gate, window.view.numbers,
            window.inverse_background.ravel(), window.observed.ravel(), window.factor.ravel(),
            np.ascontiguousarray(directions),
        )  # fmt: skip
        return moved


class ObjectLikelihood:
    """Costs of poses of one object in one window."""

    def __init__(
        self, shape: Shape, window: Window, scene: ObservedScene, form: CostForm, *,
        evaluator: MakeEvaluator = CpuEvaluator,
    ) -> None:  # fmt: skip
        self.shape = shape
        self.window = window
        self.form = form
        self.plane = scene.plane
        """Unit normal and offset of the support plane."""
        self.base = window.base
        self._evaluator = evaluator(shape, window, self.plane, form)

    def costs(self, poses: Floats) -> Floats:
        """d(R, O) of equation 9 in metres times pixels for poses P x 3 x 4 (rows of T_camera_object)."""
        return self.base + self._evaluator.changes(poses).astype(np.float64)

    def energies(self, poses: Floats) -> Floats:
        """Costs and what the candidate's box says against a pose, by which particles are weighted, P.

        An object that shows nothing cannot have made the detector see a box. The plain form has no such prior.
        """
        costs = self.costs(poses)
        return costs if self.form.plain else costs + self.base * (_STRAY * self._stray(poses) + (costs == self.base))

    def _stray(self, poses: Floats) -> Floats:
        """How far each pose's centre is from where the box and its readings allow it, in diameters, P.

        The box touches what is visible of the object on all four sides, and nothing visible is farther from the
        centre than half a diameter. Without this an object that leaves the window would explain nothing for free.
        """
        view, box, (near, far) = self.window.view, self.window.box, self.window.reach
        centres = (poses[:, :, :3] * self.shape.centre).sum(-1) + poses[:, :, 3]
        z = np.maximum(centres[:, 2:], 0.05)
        apparent = self.shape.diameter * view.fx / z
        at = view.project(np.concatenate([centres[:, :2], z], -1))
        ends = np.stack([box[2:] - apparent / 2, box[:2] + apparent / 2])
        outside = np.maximum(ends.min(0) - at, at - ends.max(0)) / apparent - _SLACK
        half = self.shape.diameter / 2
        beyond = np.maximum(near - half - z, z - far - half) / self.shape.diameter - _SLACK
        return np.clip(np.concatenate([outside, beyond], -1), 0.0, 1.0).sum(-1)

    def refine(self, poses: Floats, directions: Floats, *, steps: int, gate: float) -> Floats:
        """Poses after ``steps`` Gauss-Newton steps of projective point-to-plane ICP, K x 3 x 4.

        ``directions`` are the D twists (rotation about the object's centre, translation; camera frame) in which the
        object may move, 6 x D. Readings farther than ``gate`` metres from the rendered surface take no part.
        """
        return self._evaluator.refined(poses, directions, steps=steps, gate=gate)


def with_object(background: Float32s, soup: Soup, T_camera_object: Floats, view: View) -> Float32s:
    """The inverse depth of a background and one more object, H x W."""
    return np.maximum(background, inverse_depth(soup, T_camera_object, view))
