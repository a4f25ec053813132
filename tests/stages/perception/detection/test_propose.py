"""Objects on a table are proposed with their labels; what is proposed does not repeat itself."""

import numpy as np
import pytest

from stages.perception.detection.boxes import intersection_over_union
from stages.perception.detection.propose import Proposals, Proposer
from tests.stages.perception.detection.scenes import NAMES, K, Photograph, photograph, views


@pytest.fixture(scope="module")
def proposer() -> Proposer:
    return Proposer(views())


def proposed(proposer: Proposer, seen: Photograph, most: int = 10) -> Proposals:
    return proposer.propose(seen.rgb, seen.depth, K, np.random.default_rng(0), up=None, most=most)


@pytest.mark.parametrize("name", NAMES)
def test_each_object_has_a_candidate_with_its_label_and_no_better_label(proposer: Proposer, name: str) -> None:
    seen = photograph(*NAMES)
    found = proposed(proposer, seen)
    right = found.labels == NAMES.index(name)
    overlaps = intersection_over_union(seen.boxes[name][None], found.boxes)[0]
    hits = np.flatnonzero(right & (overlaps > 0.6))
    assert len(hits)
    row = found.confidences[hits[0]]
    assert NAMES[int(row.argmax())] == name


def test_candidates_come_best_first_and_each_row_leaves_room_for_none_of_them(proposer: Proposer) -> None:
    found = proposed(proposer, photograph(*NAMES))
    assert len(found.boxes) == len(found.labels) == len(found.confidences) == 10
    chosen = found.confidences[np.arange(10), found.labels]
    assert (np.diff(chosen) <= 0).all()
    assert (found.confidences >= 0).all() and (found.confidences.sum(1) < 1).all()


def test_boxes_of_one_label_do_not_repeat_and_a_box_may_have_several(proposer: Proposer) -> None:
    found = proposed(proposer, photograph(*NAMES), most=30)
    overlaps = intersection_over_union(found.boxes, found.boxes)
    same = found.labels[:, None] == found.labels[None]
    assert (np.triu(overlaps * same, 1) <= 0.6).all()
    assert (np.triu(overlaps > 0.99, 1) & ~same).any()


def test_an_image_is_reduced_and_its_boxes_are_those_of_the_whole(proposer: Proposer) -> None:
    seen = photograph(*NAMES)
    large = Photograph(seen.rgb.repeat(4, 0).repeat(4, 1), seen.depth.repeat(4, 0).repeat(4, 1), {})
    K_large = np.diag([4.0, 4.0, 1.0]) @ K
    found = proposer.propose(large.rgb, large.depth, K_large, np.random.default_rng(0), up=None, most=10)
    for name, box in seen.boxes.items():
        overlaps = intersection_over_union(4 * box[None], found.boxes[found.labels == NAMES.index(name)])
        assert overlaps.max() > 0.6


def test_nothing_read_is_nothing_proposed(proposer: Proposer) -> None:
    blank = photograph()
    nothing = proposed(proposer, Photograph(blank.rgb, np.zeros_like(blank.depth), {}))
    assert nothing.boxes.shape == (0, 4) and nothing.confidences.shape == (0, 3)
