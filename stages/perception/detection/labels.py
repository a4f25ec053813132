"""Which objects each region of an image could be, judged against the views of a catalogue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from stages.geometry.arrays import Floats
from stages.perception.detection.appearance import Bytes, Looks, square
from stages.perception.detection.regions import ImageRegion
from stages.perception.detection.views import Views, projected, unit
from stages.perception.rendering.rasteriser import Float32s

_WEIGHTS = {"middle": 2.0, "last": 1.0, "chroma": 0.5, "light": 0.1, "outline": 0.3, "size": 0.2, "top": 0.3}
"""What each likeness counts; all are 1 at best."""
_CELLS = 2.0
"""What likeness cell by cell counts."""
_CLOSEST = 4
"""Views of each label that are compared cell by cell."""
_ELEVATION = 26.0
"""Degrees by which a view may be seen from higher or lower."""
_LOWEST = 0.005


class Judge:
    """Compares regions with views."""

    def __init__(self, views: Views) -> None:
        self._views = views
        self._middle = unit(views.middle)
        self._spread = views.last.std(0) + 1e-6
        self._last = unit((views.last - views.last.mean(0)) / self._spread)
        self._outline = views.outline.astype(np.float32)
        self._of_label = [np.flatnonzero(views.label == label) for label in range(len(views.labels))]

    @property
    def sizes(self) -> tuple[float, float]:
        """The smallest and the largest extent that a region may have, metres: half a view's, or more than one's."""
        longest = self._views.extent.max(1)
        return 0.5 * float(longest.min()), 1.25 * float(longest.max())

    def scores(self, regions: Sequence[ImageRegion], rgb: Bytes) -> Floats:
        """How much each region looks like the best view of each label, N x L; N > 0."""
        looks = Looks.of([square(_window(rgb, region), region.mask, region.whole) for region in regions])
        likeness = self._likeness(regions, looks)
        scores = np.empty((len(regions), len(self._of_label)))
        cells = projected(looks.grid, self._views.basis)
        for i, row in enumerate(likeness):
            closest = [of[np.argsort(-row[of], kind="stable")[:_CLOSEST]] for of in self._of_label]
            index = np.concatenate(closest)
            total = row[index] + _CELLS * self._by_cells(cells[i][looks.covered[i]], index)
            scores[i] = np.maximum.reduceat(total, np.cumsum([0, *map(len, closest[:-1])]))
        return scores

    def _likeness(self, regions: Sequence[ImageRegion], looks: Looks) -> Floats:
        """Sum of all likenesses but that of cells, regions x views; views from another elevation are out."""
        views = self._views
        last = unit((looks.last - looks.last.mean(0)) / self._spread)
        terms = {
            "middle": unit(looks.middle) @ self._middle.T,
            "last": last @ self._last.T,
            "chroma": looks.chroma @ views.chroma.T,
            "light": looks.light @ views.light.T,
            "outline": _overlap(looks.outline.astype(np.float32), self._outline),
            "size": self._size(regions),
            "top": self._top(np.array([region.top for region in regions])),
        }
        total = sum(weight * terms[name] for name, weight in _WEIGHTS.items())
        elevation = np.array([region.elevation for region in regions])
        return np.where(np.abs(elevation[:, None] - views.elevation) > _ELEVATION, -np.inf, total)

    def _size(self, regions: Sequence[ImageRegion]) -> Floats:
        """How far width and height are off, 0 to -2; what is partly hidden may be smaller."""
        total = np.zeros((len(regions), len(self._views.label)))
        hidden = np.array([region.hidden for region in regions])[:, None]
        for axis in (0, 1):
            extent = np.array([region.extent[axis] for region in regions])
            off = np.log(extent)[:, None] - np.log(self._views.extent[:, axis])
            total -= np.minimum(np.abs(np.where(hidden & (off < 0), 0.4 * off, off)), 1)
        return total

    def _top(self, top: Floats) -> Floats:
        """How far the height above the plane is off, 0 to -1; 0 without a plane."""
        off = np.abs(np.log(np.maximum(top, _LOWEST))[:, None] - np.log(self._views.top))
        return -np.nan_to_num(np.minimum(off, 1))

    def _by_cells(self, cells: Float32s, index: np.ndarray) -> Float32s:
        """Mean over a region's cells (K x C) of how much the most alike cell of each view is alike."""
        if not len(cells):
            return np.zeros(len(index), np.float32)
        views = torch.from_numpy(self._views.grid[index])
        alike = views.flatten(0, 1) @ torch.from_numpy(cells).T
        return alike.view(len(index), -1, len(cells)).amax(1).mean(1).numpy()


def _window(rgb: Bytes, region: ImageRegion) -> Bytes:
    x0, y0, x1, y1 = region.box.astype(int)
    return rgb[y0:y1, x0:x1]


def _overlap(a: Float32s, b: Float32s) -> Float32s:
    """Intersection over union of outlines, N x M."""
    shared = a @ b.T
    return shared / np.maximum(a.sum(1)[:, None] + b.sum(1) - shared, 1)
