"""Scenes put together from the layers of their objects: what they cost, what they must cost, and which come first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.geometry.masks import part_of
from stages.messages.digest import PATCH_STRIDE, DepthPatch, LonePose
from stages.perception.filter.likelihood import CostForm, ObservedScene, credits
from stages.perception.filter.particle_filter import pixels
from stages.perception.observation.plane import height_above, stands_out
from stages.perception.rendering.rasteriser import Float32s

REACH = 0.25
"""Share of a candidate's box by which it is grown to where its object may explain readings: boxes are not exact."""
_LEAST = 0.1
"""With N_c unknown an object must explain this share of what readings all over its box would cost."""


class Composition:
    """The objects of one hypothesis in one observation, each with the part of the image that it may explain.

    An object takes credit only inside its candidate's grown boxes; elsewhere it costs what it misses and leaves the
    readings as unexplained as they were. Readings outside all of the boxes therefore stay unexplained whatever the
    poses, and their credit is a lower bound of the cost (:meth:`bound`).
    """

    def __init__(self, scene: ObservedScene, form: CostForm, boxes: Sequence[Sequence[Floats]]) -> None:
        """``boxes`` are those of each object."""
        self.scene = scene
        self._form = form
        self._reaches = [_mask(scene, [pixels(box, scene, margin=REACH) for box in each]) for each in boxes]
        self.credit = credits(scene, scene.plane_inverse, form)
        """What each pixel costs with the plane alone, H x W metres."""

    def bound(self) -> float:
        """What every scene of the hypothesis costs at least."""
        inside = np.logical_or.reduce([np.zeros_like(self.scene.foreground), *self._reaches])
        return _sum(np.where(inside, 0.0, self.credit))

    def cost(self, layers: Sequence[Float32s]) -> float:
        """d(R, O) of the scene; layers are H x W inverse depths in the order of the boxes."""
        return _sum(self.pixels(layers))

    def cost_of_nothing(self) -> float:
        """The cost without any object."""
        return _sum(self.credit)

    def cost_without(self, i: int, layers: Sequence[Float32s]) -> float:
        """The cost of the scene without one of its objects."""
        return _sum(self.pixels([*layers[:i], *layers[i + 1 :]], self._reaches[:i] + self._reaches[i + 1 :]))

    def pixels(self, layers: Sequence[Float32s], reaches: Sequence[NDArray[np.bool_]] | None = None) -> Float32s:
        """Cost of every pixel, H x W metres; ``reaches`` are the masks of the layers where these are not all."""
        nearest = self.scene.plane_inverse.copy()
        allowed = np.ones_like(self.scene.foreground)
        for layer, reach in zip(layers, self._reaches if reaches is None else reaches, strict=True):
            part = part_of(layer > 0)
            nearer = layer[part] > nearest[part]
            np.copyto(nearest[part], layer[part], where=nearer)
            np.copyto(allowed[part], reach[part], where=nearer)
        return pixel_costs(self.scene, self.credit, nearest, self._form, allowed)


def scene_cost(scene: ObservedScene, layers: Sequence[Float32s], form: CostForm) -> float:
    """d(R, O) of a whole scene, metres times pixels: the same pixels count whatever the hypothesis.

    ``layers`` are the objects' inverse depths, H x W; each may explain any reading. Foreground that no object explains
    costs what it would cost with the support plane alone.
    """
    nearest = np.maximum.reduce([scene.plane_inverse, *layers])
    return _sum(pixel_costs(scene, credits(scene, scene.plane_inverse, form), nearest, form))


def pixel_costs(
    scene: ObservedScene, credit: Float32s, nearest: Float32s, form: CostForm,
    allowed: NDArray[np.bool_] | None = None,
) -> Float32s:  # fmt: skip
    """Cost of every pixel of a composed scene, H x W metres.

    ``credit`` is what they cost with the plane alone, ``nearest`` the composed inverse depth; where ``allowed`` is
    false the object in sight leaves the reading unexplained.
    """
    shown = (nearest > scene.plane_inverse) & (scene.factor > 0)
    part = part_of(shown)
    shown, before = shown[part], credit[part]
    behind = scene.factor[part] * (1.0 / np.where(shown, nearest[part], 1.0) - scene.depth[part])
    distance = np.minimum(np.abs(behind), form.truncation)
    if not form.plain:
        distance = np.maximum(distance - scene.leeway[part], 0.0)
    explained = distance if allowed is None else np.where(allowed[part], distance, before + distance)
    costs = credit.copy()
    np.copyto(costs[part], np.where(behind > form.occluder_margin, before + form.occluder_cost, explained), where=shown)
    return costs


def charge(box: Floats, start: LonePose, share: float) -> float:
    """What an object costs by being there, metres times pixels: it must explain more to be worth having.

    Always a tenth of what its box would cost, were it filled with readings as far from the plane as the object rises
    and nothing explained: a box frames what is visible of its object, so what is there explains a fifth at least, even
    where its box is loose; what is not there, or there already, next to nothing. And ``share`` of what it claims.
    """
    area = float(box[2] - box[0]) * float(box[3] - box[1])
    return max(_LEAST * area * start.rise, share * start.claim)


def claim(scene: ObservedScene, layer: Float32s, form: CostForm) -> tuple[float, float]:
    """What the readings that an object (H x W inverse depth) covers cost with the plane alone, metres times pixels, and
    the share of that which it explains. Readings in front of it belong to something else.
    """
    silhouette = layer > scene.plane_inverse
    behind = scene.factor * (1.0 / np.where(silhouette, layer, 1.0) - scene.depth)
    covered = silhouette & (scene.factor > 0) & (behind <= form.occluder_margin)
    claimed = _sum(credits(scene, scene.plane_inverse, form)[covered])
    left = _sum(np.minimum(np.abs(behind), form.truncation)[covered])
    return claimed, max(0.0, 1.0 - left / max(claimed, 1e-9))


def rise(scene: ObservedScene, layer: Float32s, form: CostForm) -> float:
    """Metres by which an object (H x W inverse depth) stands out of the plane along the rays, bounded, on average.

    What lies flat, as a tray does, cannot explain more of its box than this. Its readings are the plane's own where it
    stands out no farther than these stray: there is nothing to be explained.
    """
    shown = (layer > scene.plane_inverse) & (scene.factor > 0)
    if not shown.any():
        return form.truncation
    plane = np.where(scene.plane_inverse > 0, scene.plane_inverse, np.float32(1e-6))[shown]
    z = 1.0 / np.where(shown, layer, 1.0)
    out = scene.factor[shown] * (1.0 / plane - z[shown])
    asked = stands_out(height_above(z, scene.view, scene.T_camera_table), z)[shown]
    return float((np.minimum(out, form.truncation) * asked).mean(dtype=np.float64))


def fit(scene: ObservedScene, layer: Float32s, others: Float32s, form: CostForm) -> tuple[float, float]:
    """Mean distance over the pixels that show an object (metres, bounded) and the share of it that nothing hides.

    ``layer`` and ``others`` are H x W inverse depths of the object and of all else.
    """
    part = part_of(layer > 0)
    layer, factor = layer[part], scene.factor[part]
    silhouette = layer > 0
    behind = factor * (1.0 / np.where(silhouette, layer, 1.0) - scene.depth[part])
    shown = silhouette & ~((layer < others[part]) | (behind > form.occluder_margin))
    read = shown & (factor > 0)
    distances = np.minimum(np.abs(behind[read]), form.truncation)
    cost = float(distances.mean(dtype=np.float64)) if read.any() else form.truncation
    return cost, float(shown.sum() / max(1, silhouette.sum()))


def glimpse(scene: ObservedScene, layer: Float32s, box: Floats, form: CostForm) -> DepthPatch:
    """What one candidate's object would show alone: its H x W layer, and what the scene's cost changes by."""
    shown = layer > scene.plane_inverse
    rows, columns = part = part_of(shown[::PATCH_STRIDE, ::PATCH_STRIDE])
    composition = Composition(scene, form, [[box]])
    change = np.where(shown, composition.pixels([layer]) - composition.pixels([], []), 0.0)
    inverse, change = (np.where(shown, a, 0.0)[::PATCH_STRIDE, ::PATCH_STRIDE][part] for a in (layer, change))
    return DepthPatch(
        left=columns.start,
        top=rows.start,
        inverse=np.ascontiguousarray(inverse, np.float32),
        change=np.ascontiguousarray(change, np.float32),
    )


class FirstLook:
    """Ranks combinations of candidates by what their objects would cost together where each stands if alone."""

    def __init__(self, glimpses: Sequence[DepthPatch], charges: Sequence[float] | None = None) -> None:
        """``charges`` are what each object costs by being there, metres times pixels."""
        self._glimpses = glimpses
        self._charges = charges or [0.0] * len(glimpses)
        width = max((g.left + g.inverse.shape[1] for g in glimpses), default=0)
        height = max((g.top + g.inverse.shape[0] for g in glimpses), default=0)
        self._inverse = np.zeros((height, width), np.float32)
        self._change = np.zeros_like(self._inverse)

    def cost(self, chosen: Sequence[int]) -> float:
        """Cost of the composed scene less that of the empty one, metres times pixels at full resolution."""
        self._inverse[:] = 0.0
        self._change[:] = 0.0
        for i in chosen:
            one = self._glimpses[i]
            height, width = one.inverse.shape
            part = np.s_[one.top : one.top + height, one.left : one.left + width]
            nearer = one.inverse > self._inverse[part]
            np.copyto(self._inverse[part], one.inverse, where=nearer)
            np.copyto(self._change[part], one.change, where=nearer)
        return _sum(self._change) * PATCH_STRIDE**2 + sum(self._charges[i] for i in chosen)


def _mask(scene: ObservedScene, rectangles: Sequence[tuple[int, int, int, int]]) -> NDArray[np.bool_]:
    inside = np.zeros(scene.depth.shape, bool)
    for x0, y0, x1, y1 in rectangles:
        inside[y0:y1, x0:x1] = True
    return inside


def _sum(costs: NDArray[np.floating]) -> float:
    return float(costs.sum(dtype=np.float64))
