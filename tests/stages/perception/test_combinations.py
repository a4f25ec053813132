"""Equation 2 and the order of combinations."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.messages import Candidate
from stages.perception.combinations import count_combinations, most_confident


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
