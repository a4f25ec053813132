"""Arrays of numbers: which rows are equal, which measurements say most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


def distinct_rows(rows: NDArray[Any]) -> tuple[Indices, Indices]:
    """Where each distinct row (of N x K) stands first, in the rows' order, and which of these every row equals, N.

    ``np.unique`` along an axis says the same, but compares rows as strings of bytes: it takes seven times as long.
    """
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    new = np.append(True, (ordered[1:] != ordered[:-1]).any(1))
    which = np.empty(len(rows), np.intp)
    which[order] = np.cumsum(new) - 1
    return order[new], which


def most_telling(informations: Sequence[Floats], known: Floats) -> Iterator[int]:
    """Indices of measurements, each the one that leaves least uncertainty after those before it (D-optimal, greedy).

    ``informations`` are K x K each, ``known`` is what is known before any of them.
    """
    left = list(range(len(informations)))
    while left:
        best = max(left, key=lambda k: np.linalg.slogdet(known + informations[k])[1])
        known = known + informations[best]
        left.remove(best)
        yield best
