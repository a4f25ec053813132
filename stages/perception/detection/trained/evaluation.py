"""How good a detector is: average precision per label, and recall against false boxes at a threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.perception.detection.boxes import average_precision, intersection_over_union, match
from stages.perception.detection.trained.network import DetectionNetwork, Detections, detect
from stages.perception.detection.trained.training_images import Example

_OVERLAP = 0.5
_LOWEST = 0.02  # Threshold at which the precision-recall curve ends.


@dataclass(frozen=True)
class OperatingPoint:
    """What a threshold means for the stages that follow."""

    threshold: float
    recall: float
    """Share of the objects that have a box of their label."""
    complete: float
    """Share of the images in which no object is missed."""
    false_boxes: float
    """Boxes per image that belong to no object or carry another label."""


@dataclass(frozen=True)
class Evaluation:
    """Figures over a set of examples; a box is right with its label and an overlap of 0.5."""

    precision: dict[str, float]
    """Average precision of each label, nan where the set does not contain it."""
    points: tuple[OperatingPoint, ...]
    images: int
    objects: int

    @property
    def mean_precision(self) -> float:
        """mAP50."""
        return float(np.nanmean(list(self.precision.values())))


@dataclass(frozen=True)
class _Judged:
    """The boxes of one image that count, and which are right."""

    scores: NDArray[np.float64]
    labels: NDArray[np.int64]
    right: NDArray[np.bool_]
    objects: NDArray[np.int64]
    """Labels of the objects that have to be found."""


def evaluate(
    network: DetectionNetwork, examples: Sequence[Example], *, thresholds: Sequence[float] = (0.1, 0.2, 0.3, 0.5, 0.7)
) -> Evaluation:
    """Runs the network over all examples and scores its boxes."""
    judged = [_judge(detect(network, one.image, threshold=_LOWEST, keep=40), one) for one in examples]
    precision = {label: _precision(judged, index) for index, label in enumerate(network.labels)}
    points = tuple(_operating_point(judged, threshold) for threshold in thresholds)
    return Evaluation(precision, points, len(examples), sum(len(one.objects) for one in judged))


def _judge(found: Detections, example: Example) -> _Judged:
    """Right boxes of an image; boxes on ignored objects do not count at all."""
    scores, labels = found.scores, found.confidences.argmax(axis=1).astype(np.int64)
    wanted = ~example.ignored
    right = np.zeros(len(scores), bool)
    for label in np.unique(labels):
        rows = labels == label
        truth = example.boxes[wanted & (example.labels == label)]
        right[rows] = match(found.boxes[rows], scores[rows], truth, _OVERLAP) >= 0
    same_label = labels[:, None] == example.labels[example.ignored][None]
    overlaps = intersection_over_union(found.boxes, example.boxes[example.ignored]) * same_label
    counts = right | (overlaps.max(axis=1, initial=0.0) < 0.3)
    return _Judged(scores[counts], labels[counts], right[counts], example.labels[wanted])


def _precision(judged: Sequence[_Judged], label: int) -> float:
    scores = np.concatenate([one.scores[one.labels == label] for one in judged])
    right = np.concatenate([one.right[one.labels == label] for one in judged])
    return average_precision(scores, right, sum(int((one.objects == label).sum()) for one in judged))


def _operating_point(judged: Sequence[_Judged], threshold: float) -> OperatingPoint:
    hits = np.array([(one.right & (one.scores >= threshold)).sum() for one in judged])
    false = np.array([(~one.right & (one.scores >= threshold)).sum() for one in judged])
    objects = np.array([len(one.objects) for one in judged])
    return OperatingPoint(
        threshold=threshold,
        recall=float(hits.sum() / max(objects.sum(), 1)),
        complete=float((hits == objects).mean()),
        false_boxes=float(false.mean()),
    )
