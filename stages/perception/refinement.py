"""Refines the winning scene: every object polished against all others at full resolution, flips settled by colour.

The filters of the hypotheses look at coarse windows and simplified meshes, one object after the other. What follows
is done once, for the winner alone, with finer meshes and every pixel. A pose changes only where the cost of the whole
scene (equation 9) agrees, or where depth cannot tell two poses apart and colour can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stages.perception.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.particle_filter import Rectangle
from stages.perception.proposals import Dof, Proposals
from stages.perception.rasteriser import Float32s, inverse_depth
from stages.perception.scene_filter import scene_cost
from stages.scene.catalogue import Catalogue, CatalogueObject, Floats

_GAIN = 1e-3
"""Share of its own cost by which a moved object must lower the scene's."""


@dataclass(frozen=True, kw_only=True)
class RefinementSettings:
    """How the winner is refined."""

    dof: Dof = 6
    cost: CostForm = field(default_factory=CostForm)
    triangles: int = 2000
    """Detail of the meshes."""
    rounds: int = 3
    """Times that every object is polished at most, the others fixed."""
    steps: int = 6
    """Gauss-Newton steps of a polish."""
    gate: float = 0.01
    """Metres between a reading and the surface beyond which it takes no part in a polish."""


@dataclass(frozen=True)
class Placed:
    """An object of the scene as it was estimated."""

    label: str
    T_camera_object: Floats
    """3 x 4 or 4 x 4."""


@dataclass(frozen=True)
class Alternative:
    """A pose that was considered."""

    T_camera_object: Floats
    """3 x 4."""
    depth: float
    """What it adds to the cost of the scene, metres times pixels."""


@dataclass(frozen=True)
class RefinedObject:
    """One object of the refined scene."""

    label: str
    T_camera_object: Floats
    """3 x 4."""
    layer: Float32s
    """H x W inverse depth of the object alone."""
    cost: float
    """Mean distance over the pixels that show it, metres, bounded."""
    visible: float
    """Share of its silhouette that nothing hides."""
    alternatives: tuple[Alternative, ...]
    """What was chosen first, then the other poses that were considered, cheapest first."""


@dataclass(frozen=True)
class RefinedScene:
    """The winner, refined."""

    objects: tuple[RefinedObject, ...]
    cost: float
    """d(R, O) of equation 9 over the whole image, metres times pixels."""


class SceneRefiner:
    """Refines scenes of one catalogue's objects."""

    def __init__(self, catalogue: Catalogue, settings: RefinementSettings) -> None:
        self._catalogue = catalogue
        self._settings = settings
        self._models: dict[str, _Model] = {}

    def warm_up(self) -> None:
        """Lays out every object, so that the first image waits for nothing."""
        for label in self._catalogue.objects:
            self._model(label)

    def refine(self, scene: ObservedScene, rgb: NDArray[np.uint8], placed: Sequence[Placed]) -> RefinedScene:
        """Polishes all objects together; ``rgb`` is H x W x 3, sRGB, registered to the depth image."""
        poses = [np.array(item.T_camera_object[:3], float) for item in placed]
        joint = _Joint(scene, [self._model(item.label) for item in placed], poses, self._settings)
        joint.polish()
        return joint.result()

    def _model(self, label: str) -> _Model:
        if label not in self._models:
            self._models[label] = _Model(self._catalogue[label], self._settings)
        return self._models[label]


class _Model:
    """What the refiner knows of one catalogue object."""

    def __init__(self, item: CatalogueObject, settings: RefinementSettings) -> None:
        self.label = item.name
        self.shape = Shape.of(item.simplified(settings.triangles))
        self.proposals = Proposals(item, settings.dof)


class _Joint:
    """All objects of a scene while they are refined."""

    def __init__(
        self, scene: ObservedScene, models: list[_Model], poses: list[Floats], settings: RefinementSettings
    ) -> None:
        self._scene = scene
        self._models = models
        self._poses = poses
        self._settings = settings
        self._layers = [self._layer(i) for i in range(len(models))]

    def polish(self) -> None:
        """Moves one object after the other, the others fixed, until a whole round changes nothing."""
        stale = set(range(len(self._models)))
        for _ in range(self._settings.rounds):
            moved = {i for i in sorted(stale) if self._polish(i)}
            stale = {j for i in moved for j in range(len(self._models)) if self._touches(i, j)}

    def result(self) -> RefinedScene:
        """The scene as it stands."""
        found = tuple(self._found(i) for i in range(len(self._models)))
        return RefinedScene(found, scene_cost(self._scene, self._layers, self._settings.cost))

    def _polish(self, i: int) -> bool:
        likelihood = self._likelihood(i)
        directions = self._models[i].proposals.directions(self._scene.T_camera_table)
        start = self._poses[i][None]
        moved = likelihood.refine(start, directions, steps=self._settings.steps, gate=self._settings.gate)
        before, after = likelihood.costs(np.concatenate([start, moved])).tolist()
        if not after < before - _GAIN * abs(before):
            return False
        self._poses[i] = moved[0]
        self._layers[i] = self._layer(i)
        return True

    def _likelihood(self, i: int) -> ObjectLikelihood:
        """Costs of poses of one object about where it is, with all others fixed, at full resolution.

        Credit is given everywhere, so that costs differ by as much as the scene's.
        """
        x0, y0, x1, y1 = region = _around(self._models[i].shape, self._poses[i], self._scene)
        part = np.s_[y0:y1, x0:x1]
        scene = _cropped(self._scene, region)
        others = [layer[part] for j, layer in enumerate(self._layers) if j != i]
        background = np.maximum.reduce([scene.plane_inverse, *others])
        everything = (0, 0, x1 - x0, y1 - y0)
        window = Window.of(scene, background, everything, everything, stride=1, form=self._settings.cost)
        return ObjectLikelihood(self._models[i].shape, window, scene, self._settings.cost)

    def _found(self, i: int) -> RefinedObject:
        others = [self._scene.plane_inverse, *(layer for j, layer in enumerate(self._layers) if j != i)]
        cost, visible = fit(self._scene, self._layers[i], np.maximum.reduce(others), self._settings.cost)
        return RefinedObject(self._models[i].label, self._poses[i], self._layers[i], cost, visible, ())

    def _layer(self, i: int) -> Float32s:
        return inverse_depth(self._models[i].shape.soup, self._poses[i], self._scene.view)

    def _touches(self, i: int, j: int) -> bool:
        """Whether another object stands near enough for its pose to depend on this one's."""
        a, b = (_around(self._models[k].shape, self._poses[k], self._scene) for k in (i, j))
        return i != j and a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def fit(scene: ObservedScene, layer: Float32s, others: Float32s, form: CostForm) -> tuple[float, float]:
    """Mean distance over the pixels that show an object (metres, bounded) and the share of it that nothing hides.

    ``layer`` and ``others`` are H x W inverse depths of the object and of all else.
    """
    silhouette = layer > 0
    behind = scene.factor * (1.0 / np.where(silhouette, layer, 1.0) - scene.depth)
    shown = silhouette & ~((layer < others) | (behind > form.occluder_margin))
    read = shown & (scene.factor > 0)
    distances = np.minimum(np.abs(behind[read]), form.truncation)
    cost = float(distances.mean(dtype=np.float64)) if read.any() else form.truncation
    return cost, float(shown.sum() / max(1, silhouette.sum()))


def _around(shape: Shape, pose: Floats, scene: ObservedScene) -> Rectangle:
    """The part of the image that the object's enclosing sphere may cover, whatever its orientation; never empty."""
    centre = (pose[:, :3] * shape.centre).sum(-1) + pose[:, 3]
    z = max(float(centre[2]), 0.1)
    u, v = scene.view.project(np.array([centre[0], centre[1], z]))
    reach = 0.55 * shape.diameter / z * scene.view.fx + 8
    x0, x1 = _span(float(u), reach, scene.view.width)
    y0, y1 = _span(float(v), reach, scene.view.height)
    return x0, y0, x1, y1


def _span(middle: float, reach: float, size: int) -> tuple[int, int]:
    first = int(np.clip(np.floor(middle - reach), 0, size - 2))
    return first, int(np.clip(np.ceil(middle + reach), first + 2, size))


def _cropped(scene: ObservedScene, region: Rectangle) -> ObservedScene:
    x0, y0, x1, y1 = region
    part = np.s_[y0:y1, x0:x1]
    return ObservedScene(
        scene.view.sampled(*region, 1), scene.depth[part], scene.factor[part], scene.foreground[part],
        scene.plane_inverse[part], scene.T_camera_table,
    )  # fmt: skip
