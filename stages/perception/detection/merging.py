"""Joins neighbouring pieces of an image step by step, so that every object is, at some step, one piece."""

# ruff: noqa: PLR0917
# pyright: reportMissingParameterType=false
# Kernels take plain arrays by position.

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from stages.geometry.arrays import Floats

Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]

_WEIGHTS = ((1.0, 1.0, 0.3), (0.2, 1.0, 1.0), (2.5, 0.5, 0.0), (0.0, 1.0, 0.0))
"""Of colour, depth gap and concavity: an object of many colours and one that touches another need different ones."""
_Z = 5
"""Where depth stands among the values."""
_HIDES = 0.015
"""Metres by which a neighbour must be nearer to hide what is behind it."""
_COLOUR, _GAP = 25.0, 0.02
"""Differences that count one: of colour, and metres."""


@dataclass(frozen=True)
class Pieces:
    """Pieces of an image, each a set of labels."""

    labels: Labels
    """H x W, 0 where there is none."""
    members: list[NDArray[np.int64]]
    """The labels of each of N pieces."""
    boxes: Floats
    """N x 4: x0, y0, x1, y1, exclusive."""
    pixels: Floats
    """N."""
    depth: Floats
    """N: mean, metres."""
    outline: Floats
    """N x 3: shares of the outline that lie on an edge, that lie on an edge in depth, that something hides."""
    whole: bool
    """Whether depth alone separates each from all else."""


def components(labels: Labels, depth: NDArray[np.floating], edges: Mask, jumps: Mask) -> Pieces:
    """Every label a piece. ``depth`` is H x W metres; ``edges`` and ``jumps`` mark edges of any kind and in depth."""
    means, boxes = _means(labels, depth[..., None])
    pairs, shared = _pairs(labels, depth, edges, jumps)
    outlines = _outlines(len(means), pairs, shared)
    members = list(np.arange(1, len(means))[:, None])
    return Pieces(labels, members, boxes[1:], means[1:, 0], means[1:, 1], _shares(outlines[1:]), whole=True)


def merged(labels: Labels, values: Floats, edges: Mask, jumps: Mask) -> list[Pieces]:
    """What neighbours come to as those that differ least join, for each of several ideas of how they differ.

    ``values`` are H x W x 9: colour (three numbers), point (metres) and normal; otherwise as :func:`components`.
    """
    means, boxes = _means(labels, values)
    pairs, shared = _pairs(labels, values[..., _Z], edges, jumps)
    outlines = _outlines(len(means), pairs, shared)
    inner = pairs[:, 0] > 0
    found: list[Pieces] = []
    for weights in _WEIGHTS:
        tree = _merge(means, boxes, outlines, pairs[inner], shared[inner], np.array(weights))
        found.append(_nodes(labels, len(means), tree))
    return found


def _nodes(labels: Labels, count: int, tree: tuple[Floats, Floats, Floats, Labels]) -> Pieces:
    means, boxes, outlines, children = tree
    members = [np.array([i]) for i in range(count)]
    for a, b in children:
        members.append(np.concatenate([members[a], members[b]]))
    return Pieces(labels, members[1:], boxes[1:], means[1:, 0], means[1:, 1 + _Z], _shares(outlines[1:]), whole=False)


def _means(labels: Labels, values: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Pixels and mean values of each label, (n + 1) x (1 + C), and their boxes; row 0 is of no use."""
    count = int(labels.max()) + 1
    flat = labels.ravel()
    pixels = np.bincount(flat, minlength=count).astype(float)
    sums = [np.bincount(flat, values[..., k].ravel(), minlength=count) for k in range(values.shape[-1])]
    means = np.stack([pixels, *(each / np.maximum(pixels, 1) for each in sums)], 1)
    boxes = np.zeros((count, 4))
    for label, window in enumerate(find_objects(labels), 1):
        if window is not None:
            boxes[label] = window[1].start, window[0].start, window[1].stop, window[0].stop
    return means, boxes


def _pairs(labels: Labels, depth: NDArray[np.floating], edges: Mask, jumps: Mask) -> tuple[NDArray[np.int64], Floats]:
    """Labels that touch, E x 2 (the lower first), and what their common border sums up to, E x 6: pixels, those on an
    edge, those on an edge in depth, gaps in depth, pixels where the first is hidden and where the second is."""
    count = int(labels.max()) + 1
    keys: list[NDArray[Any]] = []
    values: list[Floats] = []
    for ahead, behind in ((np.s_[2:], np.s_[:-2]), (np.s_[:, 2:], np.s_[:, :-2])):
        a, b = labels[behind], labels[ahead]
        apart = a != b
        a, b, z_a, z_b = a[apart].astype(np.int64), b[apart], depth[behind][apart], depth[ahead][apart]
        step = np.where(a < b, z_a - z_b, z_b - z_a)
        on_edge, on_jump = ((marks[behind] | marks[ahead])[apart] for marks in (edges, jumps))
        keys.append(np.minimum(a, b) * count + np.maximum(a, b))
        columns = [np.ones(len(a)), on_edge, on_jump, np.abs(step), step > _HIDES, step < -_HIDES]
        values.append(np.stack(columns, 1, dtype=float, casting="unsafe"))
    unique, index = np.unique(np.concatenate(keys), return_inverse=True)
    rows = np.concatenate(values)
    sums = [np.bincount(index, rows[:, k], minlength=len(unique)) for k in range(rows.shape[1])]
    shared = np.asarray(np.stack(sums, 1), float)
    return np.stack([unique // count, unique % count], 1), shared


def _outlines(count: int, pairs: NDArray[np.int64], shared: Floats) -> Floats:
    """Each label's whole border, count x 4: pixels, those on an edge, on an edge in depth, where it is hidden."""
    outlines = np.zeros((count, 4))
    for side in (0, 1):
        for to, column in enumerate((0, 1, 2, 4 + side)):
            outlines[:, to] += np.bincount(pairs[:, side], shared[:, column], minlength=count)
    return outlines


def _shares(outlines: Floats) -> Floats:
    return outlines[:, 1:] / np.maximum(outlines[:, :1], 1)


@numba.njit(cache=True)
def _merge(means, boxes, outlines, pairs, shared, weights):
    """The given nodes and every one that merging makes of them, with the children of the latter."""
    count, edges = len(means), len(pairs)
    means, boxes, outlines = _longer(means), _longer(boxes), _longer(outlines)
    pairs, shared = pairs.copy(), shared.copy()
    children = np.zeros((count, 2), np.int32)
    costs = np.empty(edges)
    for e in range(edges):
        costs[e] = _cost(means, pairs[e, 0], pairs[e, 1], shared[e], weights)
    place = np.full(2 * count, -1)
    made = 0
    while True:
        best = -1
        for e in range(edges):
            if costs[e] < np.inf and (best < 0 or costs[e] < costs[best]):
                best = e
        if best < 0:
            break
        a, b = pairs[best]
        new = count + made
        children[made, 0], children[made, 1] = a, b
        made += 1
        _join(means, boxes, outlines, a, b, new)
        outlines[new, :3] -= 2 * shared[best, :3]
        outlines[new, 3] -= shared[best, 4] + shared[best, 5]
        costs[best] = np.inf
        for e in range(edges):
            i, j = pairs[e]
            if costs[e] == np.inf or not (i in (a, b) or j in (a, b)):
                continue
            other = j if i in (a, b) else i
            if other == i:  # The new node comes first, so what is hidden changes sides.
                shared[e, 4], shared[e, 5] = shared[e, 5], shared[e, 4]
            pairs[e, 0], pairs[e, 1] = new, other
            if place[other] >= 0:
                shared[place[other]] += shared[e]
                costs[e] = np.inf
            else:
                place[other] = e
        for e in range(edges):
            if costs[e] < np.inf and pairs[e, 0] == new:
                place[pairs[e, 1]] = -1
                costs[e] = _cost(means, new, pairs[e, 1], shared[e], weights)
    end = count + made
    return means[:end], boxes[:end], outlines[:end], children[:made]


@numba.njit(cache=True)
def _longer(rows):
    result = np.zeros((2 * len(rows), rows.shape[1]))
    result[: len(rows)] = rows
    return result


@numba.njit(cache=True)
def _join(means, boxes, outlines, a, b, new):
    share = means[a, 0] / (means[a, 0] + means[b, 0])
    means[new] = share * means[a] + (1 - share) * means[b]
    means[new, 0] = means[a, 0] + means[b, 0]
    boxes[new, :2] = np.minimum(boxes[a, :2], boxes[b, :2])
    boxes[new, 2:] = np.maximum(boxes[a, 2:], boxes[b, 2:])
    outlines[new] = outlines[a] + outlines[b]


@numba.njit(cache=True)
def _cost(means, a, b, shared, weights):
    """How much two neighbours differ; small pieces go first."""
    A, B = means[a], means[b]
    colour = np.sqrt(((A[1:4] - B[1:4]) ** 2).sum())
    way = B[4:7] - A[4:7]
    way = way / (np.sqrt((way**2).sum()) + 1e-9)
    concave = max(0.0, (way * (A[7:10] - B[7:10])).sum() / 2)
    gap = shared[3] / shared[0]
    small = 0.025 * np.log(min(A[0], B[0]))
    return weights[0] * colour / _COLOUR + weights[1] * gap / _GAP + weights[2] * 2 * concave + small
