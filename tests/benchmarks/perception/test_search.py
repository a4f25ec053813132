"""All ways of searching the hypotheses of an image come to the same winner."""

from __future__ import annotations

import itertools

import pytest

from benchmarks.perception.search import WAYS, Outcome, Search, chosen_images, line, search
from tests.stages.perception.scenes import DATA

DATASET = DATA / "household-layout"


def an_outcome(*, poses: bytes = b"poses", seconds: float = 2.0) -> Outcome:
    return Outcome((0, 1), poses, 5, 1, 50, 8, 9, seconds, 400.0)


@pytest.mark.skipif(not DATASET.exists(), reason="the data sets are not beside the repository (../shared/data)")
def test_a_row_says_whether_the_winner_is_the_same() -> None:
    (image,) = chosen_images(DATASET, 3, 1)
    assert len(image.boxes) == 3
    assert [a.confidence >= b.confidence for a, b in itertools.pairwise(image.boxes)] == [True, True]
    same = line(image, "shared", an_outcome(), an_outcome(seconds=4.0)).split()
    assert same[2:] == ["5", "1", "50", "8", "9", "2.0", "0.50", "400", "the", "same", "bytes"]
    assert line(image, "shared", an_outcome(poses=b"other"), an_outcome()).endswith("ANOTHER")


@pytest.mark.slow
@pytest.mark.skipif(not DATASET.exists(), reason="the data sets are not beside the repository (../shared/data)")
def test_all_ways_find_the_same_winner() -> None:
    (image,) = chosen_images(DATASET, 4, 1)
    outcomes = {way: search(Search(DATASET, image, 2, way, 2)) for way in WAYS}
    assert len({(one.winner, one.poses) for one in outcomes.values()}) == 1
    assert {one.estimated + one.dropped + one.left_out for one in outcomes.values()} == {6}
    assert outcomes["apart"].runs >= 12 > 4 + 2 >= outcomes["shared, dropped"].runs
    assert outcomes["first look"].left_out == 4
