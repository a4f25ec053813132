"""Arithmetic on axis-aligned image boxes: overlap, suppression, average precision."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats


def intersection_over_union(a: Floats, b: Floats) -> Floats:
    """Overlap of each pair of boxes; N x 4 and M x 4 (x0, y0, x1, y1) to N x M."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=-1)
    union = area(a)[:, None] + area(b)[None] - shared
    return shared / np.maximum(union, 1e-9)


def area(boxes: Floats) -> Floats:
    """Square pixels of each box; N x 4 to N."""
    return np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=-1)


def suppress(boxes: Floats, scores: Floats, overlap: float, *, labels: NDArray[np.int64] | None = None) -> list[int]:
    """Indices of the boxes that greedy non-maximum suppression keeps, best first.

    A box goes when a better one overlaps it by more than ``overlap`` (of the same label, where labels are
    given). Equal scores keep their order, so the result is deterministic.
    """
    return list(survivors(boxes, scores, overlap, labels=labels))


def survivors(
    boxes: Floats, scores: Floats, overlap: float, *, labels: NDArray[np.int64] | None = None
) -> Iterator[int]:
    """As :func:`suppress`, one after the other: who needs only the first of thousands does not pay for the rest."""
    alive = np.ones(len(boxes), bool)
    for i in np.argsort(-scores, kind="stable"):
        if alive[i]:
            yield int(i)
            gone = intersection_over_union(boxes[i : i + 1], boxes)[0] > overlap
            alive &= ~gone if labels is None else ~(gone & (labels == labels[i]))


def average_precision(scores: Floats, correct: NDArray[np.bool_], positives: int) -> float:
    """Area under the interpolated precision-recall curve of one label (Pascal VOC 2010 and COCO)."""
    if positives == 0:
        return float("nan")
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(correct[order])
    precision = hits / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(envelope * correct[order]) / positives)


def match(detected: Floats, scores: Floats, truth: Floats, overlap: float) -> NDArray[np.int64]:
    """Index of the true box each detection finds, -1 where none; the best-scored detection of a box counts.

    ``detected`` N x 4, ``scores`` N, ``truth`` M x 4; result N.
    """
    found = np.full(len(detected), -1)
    overlaps = intersection_over_union(detected, truth)
    for i in np.argsort(-scores, kind="stable"):
        if len(truth) and overlaps[i].max() >= overlap:
            found[i] = best = int(overlaps[i].argmax())
            overlaps[:, best] = -1.0
    return found
