"""Combinations of candidates, most confident first (paper, equation 2)."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence

from stages.messages.digest import Candidate

_LEAST = 1e-12


def count_combinations(m: int, n_objects: int) -> int:
    """h of equation 2: C(m, N_c) where N_c <= m, 1 otherwise."""
    return math.comb(m, n_objects) if n_objects <= m else 1


def most_confident(candidates: Sequence[Candidate], n_objects: int, limit: int) -> list[tuple[Candidate, ...]]:
    """Up to ``limit`` combinations of ``n_objects`` candidates by falling joint confidence (product).

    Candidates within each stand most confident first; equal confidences keep their order. One combination of all
    candidates where there are fewer than ``n_objects``.
    """
    ordered = sorted(candidates, key=lambda candidate: -candidate.confidence)
    size = min(n_objects, len(ordered))
    costs = [-math.log(max(candidate.confidence, _LEAST)) for candidate in ordered]

    def entry(indices: tuple[int, ...]) -> tuple[float, tuple[int, ...]]:
        return sum(costs[i] for i in indices), indices

    # Best first: moving one index on by one never lowers the cost, and every combination is reached that way.
    waiting = [entry(tuple(range(size)))]
    seen = {waiting[0][1]}
    found: list[tuple[Candidate, ...]] = []
    while waiting and len(found) < limit:
        _, indices = heapq.heappop(waiting)
        found.append(tuple(ordered[i] for i in indices))
        for following in _successors(indices, len(ordered)):
            if following not in seen:
                seen.add(following)
                heapq.heappush(waiting, entry(following))
    return found


def _successors(indices: tuple[int, ...], m: int) -> list[tuple[int, ...]]:
    ends = (*indices[1:], m)
    return [
        (*indices[:k], i + 1, *indices[k + 1 :]) for k, (i, end) in enumerate(zip(indices, ends, strict=False))
        if i + 1 < end
    ]  # fmt: skip
