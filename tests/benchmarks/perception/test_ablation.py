"""The ablation's intervals and variants."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.common.datasets import Truth
from benchmarks.comparison.accuracy import Score
from benchmarks.perception.ablation import DEFAULT, PAPER, Outcome, Source, chosen, difference, row, variant, wilson
from runner.contract import Refused
from stages.perception.filter.settings import IMPROVEMENTS


def outcome(name: str, *images: tuple[float, ...]) -> Outcome:
    """Position errors per object and image; rotations are right."""
    truth = Truth((1, 0), 1, np.eye(4), 1.0)
    scores = tuple(tuple(Score(truth, metres, metres, 0.0) for metres in image) for image in images)
    return Outcome(name, scores, cpu_seconds=2.0)


def test_wilson_agrees_with_the_table_of_newcombe() -> None:
    # Newcombe 1998, table I, method 3: 81 of 263, 15 of 148, 0 of 20.
    for hits, count, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611)):
        assert wilson(hits, count) == pytest.approx((low, high), abs=1e-4)


@given(hits=st.integers(0, 50), more=st.integers(0, 50))
def test_wilson_contains_the_share(hits: int, more: int) -> None:
    low, high = wilson(hits, hits + more + 1)
    assert -1e-9 <= low <= hits / (hits + more + 1) <= high <= 1 + 1e-9


def test_a_paired_difference_knows_that_variants_agree() -> None:
    hits, objects = np.array([3.0, 1.0, 4.0]), np.array([4.0, 4.0, 4.0])
    assert difference(hits, hits, objects) == (0, 0, 0)
    share, low, high = difference(hits - 1, hits, objects)
    assert share == low == high == pytest.approx(-0.25)


def test_a_row_compares_with_the_default() -> None:
    default = outcome(DEFAULT, (0.001, 0.002), (0.003, 0.004))
    worse = outcome("flips", (0.001, 0.05), (0.003, 0.015))
    text = row(worse, default)
    assert " 50.0 [" in text and "-50.0 [" in text and " 75.0 [" in text and "-25.0 [" in text and "0.50" in text


def test_every_improvement_and_the_plain_form_have_a_row() -> None:
    assert chosen([]) == (*IMPROVEMENTS, PAPER)
    assert chosen(["flips"]) == ("flips",)
    assert variant("flips").without == ("flips",) and variant(PAPER).form == "paper"
    with pytest.raises(Refused, match="--only flip: no such variant; choose bounded likelihood"):
        chosen(["flip"])


def test_degrees_of_freedom_stand_behind_a_colon() -> None:
    assert Source.parsed("../shared/data/a:3").dof == 3
    assert Source.parsed("../shared/data/a").dof == 6
    with pytest.raises(Refused, match="'a:4': '4' degrees of freedom; choose 3 or 6"):
        Source.parsed("a:4")
