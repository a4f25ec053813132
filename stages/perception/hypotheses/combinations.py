"""Combinations of candidates, most confident or cheapest first (paper, equation 2)."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Sequence

from stages.messages.digest import Candidate

_LEAST = 1e-12
_WIDTH = 256
"""Combinations of each size that the beam keeps: all of those of up to ten candidates, and 10 choose 5 is 252."""
Indices = tuple[int, ...]


def count_combinations(m: int, n_objects: int) -> int:
    """h of equation 2: C(m, N_c) where N_c <= m, 1 otherwise."""
    return math.comb(m, n_objects) if n_objects <= m else 1


def count_subsets(m: int, n_objects: int | None) -> int:
    """h of equation 2, or all subsets of the candidates where N_c is not known."""
    return 2**m if n_objects is None else count_combinations(m, n_objects)


def ordered(candidates: Sequence[Candidate]) -> list[Candidate]:
    """By falling confidence; equals keep their order."""
    return sorted(candidates, key=lambda candidate: -candidate.confidence)


def cheapest(cost: Callable[[Indices], float], m: int, n_objects: int | None, limit: int) -> list[Indices]:
    """Up to ``limit`` rising tuples of indices below m by rising cost; equals keep the lexical order.

    Those of ``n_objects`` (all m where there are fewer), or with None of any number. A beam search: of each size only
    the cheapest ``_WIDTH`` grow on, which is all of them for up to ten candidates.
    """
    size = m if n_objects is None else min(n_objects, m)
    if n_objects is not None and math.comb(m, size) <= _WIDTH:
        return [indices for _, indices in _by_cost(cost, set(itertools.combinations(range(m), size)))[:limit]]
    level = _by_cost(cost, {()})
    found = list(level)
    for _ in range(size):
        grown = {tuple(sorted((*kept, i))) for _, kept in level for i in range(m) if i not in kept}
        level = _by_cost(cost, grown)[:_WIDTH]
        found += level
    return [indices for _, indices in sorted(found if n_objects is None else level)[:limit]]


def additions_first(ranked: list[Indices]) -> list[Indices]:
    """The first combination, then those that add one candidate to it, then the others; order kept otherwise.

    An object that alone took another's place explains nothing while that one is there too. It finds its own only once
    both are estimated together, so where any number may be right each addition to the best deserves that.
    """
    best = set(ranked[0])
    added = [chosen for chosen in ranked if len(chosen) == len(best) + 1 and best < set(chosen)]
    return list(dict.fromkeys([ranked[0], *added, *ranked]))


def _by_cost(cost: Callable[[Indices], float], subsets: set[Indices]) -> list[tuple[float, Indices]]:
    return sorted((cost(indices), indices) for indices in subsets)


def most_confident(candidates: Sequence[Candidate], n_objects: int, limit: int) -> list[tuple[Candidate, ...]]:
    """Up to ``limit`` combinations of ``n_objects`` candidates by falling joint confidence (product).

    Candidates within each stand most confident first; equal confidences keep their order. One combination of all
    candidates where there are fewer than ``n_objects``.
    """
    sorted_ = ordered(candidates)
    size = min(n_objects, len(sorted_))
    costs = [-math.log(max(candidate.confidence, _LEAST)) for candidate in sorted_]

    def entry(indices: tuple[int, ...]) -> tuple[float, tuple[int, ...]]:
        return sum(costs[i] for i in indices), indices

    # Best first: moving one index on by one never lowers the cost, and every combination is reached that way.
    waiting = [entry(tuple(range(size)))]
    seen = {waiting[0][1]}
    found: list[tuple[Candidate, ...]] = []
    while waiting and len(found) < limit:
        _, indices = heapq.heappop(waiting)
        found.append(tuple(sorted_[i] for i in indices))
        for following in _successors(indices, len(sorted_)):
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
