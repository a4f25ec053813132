"""Candidates of one photograph: regions, what each could be, and which of them are worth a look."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.perception.detection.alignment import aligned
from stages.perception.detection.appearance import Bytes
from stages.perception.detection.boxes import intersection_over_union
from stages.perception.detection.labels import Judge
from stages.perception.detection.regions import ImageRegion, regions
from stages.perception.detection.views import Views
from stages.perception.rendering.rasteriser import Float32s, View

_WIDTH = 640
"""Images are reduced to about so many columns."""
_REGIONS = 120
_OUTLINE = 0.5
"""What a clear outline counts beside likeness."""
_SHARPNESS, _BACKGROUND = 0.35, 4.5
"""Scores to confidences: the difference that counts e, and the score at which a region is as likely nothing known."""
_PLACE, _SAME = 0.5, 0.6
"""Overlap of boxes that show the same place, and of boxes that with one label are one candidate."""
_AGAIN = 0.6
"""What a candidate is worth beside one of its label, or of its place, that is chosen already."""


@dataclass(frozen=True)
class Proposals:
    """Boxes with labels, the most confident first."""

    boxes: Floats
    """N x 4: x0, y0, x1, y1 in pixels of the image."""
    labels: NDArray[np.int64]
    """N, index into the labels that were learned; boxes repeat with other labels."""
    confidences: Floats
    """N x L: of each box every label's; a row falls short of 1 by what speaks for none."""


class Proposer:
    """Proposes candidates by the views of a catalogue."""

    def __init__(self, views: Views) -> None:
        self.labels = views.labels
        self._judge = Judge(views)

    def propose(
        self, rgb: Bytes, depth: Float32s, K: Floats, rng: np.random.Generator, *, up: Floats | None, most: int
    ) -> Proposals:
        """At most ``most``, of an H x W x 3 image and its depth (metres, 0 no reading); ``up`` is the direction against
        gravity in the camera frame where it is known."""
        step = max(1, round(rgb.shape[1] / _WIDTH))
        view = View.of(K, rgb.shape[1], rgb.shape[0]).sampled(0, 0, rgb.shape[1], rgb.shape[0], step)
        sparse = np.ascontiguousarray(depth[::step, ::step])
        small = np.asarray(cv2.resize(rgb, (view.width, view.height), interpolation=cv2.INTER_AREA), np.uint8)
        small = aligned(small, sparse)
        found = regions(small, sparse, view, rng, up=up, sizes=self._judge.sizes, most=_REGIONS)
        if not found:
            return Proposals(np.zeros((0, 4)), np.zeros(0, np.int64), np.zeros((0, len(self.labels))))
        return _chosen(found, confidences(found, self._judge.scores(found, small)), step, most)


def confidences(found: list[ImageRegion], scores: Floats) -> Floats:
    """v(L_j | B_i): softmax over the labels and one class for everything else."""
    outline = np.array([region.objectness for region in found])[:, None]
    strength = np.exp((scores + _OUTLINE * outline - _BACKGROUND) / _SHARPNESS)
    return strength / (1 + strength.sum(1, keepdims=True))


def _chosen(found: list[ImageRegion], confidences: Floats, step: int, most: int) -> Proposals:
    """The most confident boxes with labels, best first.

    What has the label, or the place, of one that is chosen already is worth less: an object that is there once should
    not fill the list with pieces of itself, nor one box with all its labels.
    """
    boxes = np.stack([region.box for region in found])
    overlaps = intersection_over_union(boxes, boxes)
    worth = confidences.copy()
    chosen: list[tuple[int, int]] = []
    while len(chosen) < most and worth.max() > 0:
        region, label = divmod(int(worth.argmax()), worth.shape[1])
        chosen.append((region, label))
        worth[:, label] *= _AGAIN
        worth[overlaps[region] > _PLACE] *= _AGAIN
        worth[overlaps[region] > _SAME, label] = 0
    chosen.sort(key=lambda pair: -confidences[pair])
    which, label = np.array(chosen, np.int64).reshape(-1, 2).T
    return Proposals(step * boxes[which], label, confidences[which])
