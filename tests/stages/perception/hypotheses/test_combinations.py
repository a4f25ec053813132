"""Equation 2 and the order of combinations."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.messages import Candidate
from stages.perception.hypotheses.combinations import (
    additions_first,
    cheapest,
    count_combinations,
    count_subsets,
    most_confident,
)


def candidates(*confidences: float) -> list[Candidate]:
    return [Candidate(box=np.zeros(4), label=f"{i}", confidence=c) for i, c in enumerate(confidences)]


@pytest.mark.parametrize(
    ("m", "n", "h"), [(5, 3, 10), (4, 4, 1), (8, 5, 56), (3, 0, 1), (2, 5, 1), (0, 3, 1), (0, 0, 1)]
)
def test_equation_2(m: int, n: int, h: int) -> None:
    assert count_combinations(m, n) == h
    assert len(most_confident(candidates(*np.linspace(0.2, 0.9, m)), n, 1000)) == h


@given(st.lists(st.floats(0.01, 1), min_size=1, max_size=7), st.integers(1, 7), st.integers(1, 12))
def test_the_best_come_first(confidences: list[float], n: int, limit: int) -> None:
    found = most_confident(candidates(*confidences), n, limit)
    size = min(n, len(confidences))
    scores = sorted((np.prod(c) for c in itertools.combinations(confidences, size)), reverse=True)[:limit]
    assert [np.prod([c.confidence for c in combination]) for combination in found] == pytest.approx(scores)
    assert len({tuple(c.label for c in combination) for combination in found}) == len(found)
    for combination in found:
        assert [c.confidence for c in combination] == sorted((c.confidence for c in combination), reverse=True)


@given(st.integers(0, 7), st.one_of(st.none(), st.integers(0, 8)), st.integers(1, 200), st.integers(0, 99))
def test_the_cheapest_come_first(m: int, n: int | None, limit: int, seed: int) -> None:
    costs = {chosen: float(cost) for size in range(m + 1) for chosen, cost in zip(
        itertools.combinations(range(m), size), np.random.default_rng(seed + size).integers(9, size=1000), strict=False
    )}  # fmt: skip
    sizes = range(m + 1) if n is None else [min(n, m)]
    expected = sorted((costs[chosen], chosen) for size in sizes for chosen in itertools.combinations(range(m), size))
    assert cheapest(costs.__getitem__, m, n, limit) == [chosen for _, chosen in expected[:limit]]
    assert count_subsets(m, n) == len(expected)


def test_many_candidates_are_searched_with_a_beam() -> None:
    worth = np.random.default_rng(0).normal(size=40)
    asked = 0

    def cost(chosen: tuple[int, ...]) -> float:
        nonlocal asked
        asked += 1
        return -float(worth[list(chosen)].sum())

    best = cheapest(cost, 40, 6, 1)[0]
    assert best == tuple(sorted(np.argsort(-worth)[:6].tolist()))
    assert asked < 60_000


def test_additions_to_the_best_come_first() -> None:
    ranked = [(1, 2), (1,), (0, 1), (1, 2, 3), (0, 2), (0, 1, 2), ()]
    assert additions_first(ranked) == [(1, 2), (1, 2, 3), (0, 1, 2), (1,), (0, 1), (0, 2), ()]
    assert additions_first([()]) == [()]
