"""Turns a method for one box into an estimator of whole images: models, boxes side by side, the best set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import combinations
from typing import Generic, Literal, Protocol, TypeVar

import numpy as np

from benchmarks.common.datasets import Image
from benchmarks.comparison.baselines.observed import Crop, Observed
from benchmarks.comparison.baselines.registration import Model
from stages.geometry.arrays import Floats
from stages.messages import Candidate
from stages.perception.rendering.rasteriser import Float32s, inverse_depth
from stages.scene.catalogue import Catalogue, CatalogueObject

Dof = Literal[3, 4, 6]
"""Upright on the plane, upright at any height, or free."""
Found = tuple[str, Floats, float]
"""Label, T_camera_object (4 x 4) and score."""
_CORES = 2


class Estimator(Protocol):
    """A baseline: what an image and its boxes hold, at most ``image.n_objects`` objects."""

    def __call__(self, image: Image, catalogue: Catalogue, *, dof: Dof = 6, seed: int = 0) -> list[Found]:
        """The best set of boxes with one pose each; the same for the same seed."""
        ...

    def prepare(self, catalogue: Catalogue) -> None:
        """What is done once per object, before the first image."""
        ...


@dataclass(frozen=True)
class Box:
    """One box as a method gets it."""

    observed: Observed
    candidate: Candidate
    model: Model
    dof: Dof
    rng: np.random.Generator


M = TypeVar("M")


@dataclass(frozen=True)
class PerBox(Generic[M]):
    """Estimates every box alone, then keeps the set of boxes whose rendered depths agree best with the image."""

    poses: Callable[[Box, M], Floats]
    """K x 4 x 4 of one box, best first; empty where nothing was found."""
    trained: Callable[[Model], M]
    """What the method learns of an object beforehand."""
    _known: dict[int, tuple[CatalogueObject, Model, M]] = field(
        default_factory=dict[int, "tuple[CatalogueObject, Model, M]"]
    )

    def prepare(self, catalogue: Catalogue) -> None:
        """Samples every object and trains the method."""
        for item in catalogue.objects.values():
            self._prepared(item)

    def __call__(self, image: Image, catalogue: Catalogue, *, dof: Dof = 6, seed: int = 0) -> list[Found]:
        """Poses of each box, then the set of ``image.n_objects`` boxes that explains the image best."""
        observed = Observed.of(image, seed)
        prepared = [self._prepared(catalogue[box.label]) for box in image.boxes]

        def poses(i: int) -> Floats:
            _, model, trained = prepared[i]
            rng = np.random.default_rng([seed, *image.id, i])
            return self.poses(Box(observed, image.boxes[i], model, dof, rng), trained)

        with ThreadPoolExecutor(_CORES) as pool:
            found = list(pool.map(poses, range(len(prepared))))
        return best_set(observed, image.boxes, [model for _, model, _ in prepared], found, image.n_objects)

    def _prepared(self, item: CatalogueObject) -> tuple[CatalogueObject, Model, M]:
        # Keyed by identity, and the object kept alive: catalogues are compared by value nowhere else.
        if id(item) not in self._known:
            model = Model.of(item)
            self._known[id(item)] = item, model, self.trained(model)
        return self._known[id(item)]


def best_set(
    observed: Observed, boxes: Sequence[Candidate], models: Sequence[Model], poses: Sequence[Floats], n_objects: int
) -> list[Found]:
    """Of all sets of ``n_objects`` boxes the one whose common rendering agrees best, each box at its first pose."""
    crop = Crop.whole(observed, 2)
    seen = [i for i in range(len(boxes)) if len(poses[i])]
    layers = {i: inverse_depth(models[i].soup, poses[i][0], crop.view) for i in seen}
    sets = list(combinations(seen, min(n_objects, len(seen))))
    chosen = max(sets, key=lambda indices: _together(crop, [layers[i] for i in indices]))
    return [(boxes[i].label, poses[i][0], crop.agreement(layers[i])) for i in chosen]


def _together(crop: Crop, layers: Sequence[Float32s]) -> float:
    return crop.agreement(np.maximum.reduce(list(layers))) if layers else 0.0


def untrained(model: Model) -> None:
    """For methods that learn nothing."""
    del model
