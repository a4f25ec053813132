"""Overlap, suppression and average precision, against values worked out by hand."""

import numpy as np
import pytest

from stages.perception.detection.boxes import (
    average_precision,
    intersection_over_union,
    match,
    suppress,
)

A, B, FAR = [0.0, 0, 10, 10], [5.0, 0, 15, 10], [50.0, 50, 60, 60]


def test_overlap_of_two_half_shifted_squares_is_a_third() -> None:
    overlaps = intersection_over_union(np.array([A, FAR]), np.array([A, B]))
    np.testing.assert_allclose(overlaps, [[1, 1 / 3], [0, 0]])


def test_suppression_keeps_the_better_of_two_and_everything_apart() -> None:
    boxes, scores = np.array([A, B, FAR]), np.array([0.6, 0.9, 0.2])
    assert suppress(boxes, scores, 0.3) == [1, 2]
    assert suppress(boxes, scores, 0.4) == [1, 0, 2]


def test_suppression_within_labels_leaves_other_labels_alone() -> None:
    boxes, scores = np.array([A, A, A]), np.array([0.6, 0.9, 0.2])
    assert suppress(boxes, scores, 0.5, labels=np.array([0, 1, 0])) == [1, 0]


def test_equal_scores_keep_their_order_and_nothing_gives_nothing() -> None:
    assert suppress(np.array([A, A, FAR]), np.full(3, 0.5), 0.5) == [0, 2]
    assert suppress(np.zeros((0, 4)), np.zeros(0), 0.5) == []


@pytest.mark.parametrize(
    ("correct", "positives", "expected"),
    [([True, True], 2, 1.0), ([True, False, True], 2, (1 + 2 / 3) / 2), ([False], 1, 0.0), ([], 3, 0.0)],
)
def test_average_precision_of_short_lists(correct: list[bool], positives: int, expected: float) -> None:
    scores = -np.arange(len(correct), dtype=float)
    assert average_precision(scores, np.array(correct, bool), positives) == pytest.approx(expected)


def test_average_precision_of_an_absent_label_is_undefined() -> None:
    assert np.isnan(average_precision(np.array([0.5]), np.array([False]), 0))


def test_a_true_box_is_found_once_by_its_best_detection() -> None:
    detected = np.array([A, A, FAR])
    assert match(detected, np.array([0.5, 0.9, 0.8]), np.array([A]), 0.5).tolist() == [-1, 0, -1]
    assert match(detected, np.ones(3), np.zeros((0, 4)), 0.5).tolist() == [-1, -1, -1]
