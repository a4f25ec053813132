"""Revisions of the best scene that other scenes of its round suggest."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from stages.geometry.arrays import Floats
from stages.messages import Candidate, ObjectPose, Posterior
from stages.messages.digest import Contender, Offer
from stages.perception.hypotheses.revisions import Revision, combined, equalled, some_of_each_box, suggested

LEFT, RIGHT = np.array([0.0, 0, 40, 60]), np.array([100.0, 0, 140, 60])


def offered(*each: tuple[str, Floats, bool]) -> tuple[Offer, ...]:
    """Offers by label and box, and whether they are another label of a box."""
    return tuple(
        Offer(candidate=Candidate(label=label, box=box, confidence=0.3), share=0.1, instead=instead)
        for label, box, instead in each
    )


OFFERS = offered(("salt_shaker", LEFT, False), ("soup_can", LEFT, True), ("cup", RIGHT, False), ("mug", RIGHT, True))
SHAKER, CAN, CUP, MUG = range(4)


def objects(*chosen: int, offers: Sequence[Offer] = OFFERS) -> tuple[ObjectPose, ...]:
    found = [offers[k].candidate for k in chosen]
    return tuple(
        ObjectPose(
            name=one.label,
            label=one.label,
            T_camera_object=np.eye(4),
            confidence=1.0,
            cost=0.0,
            box=one.box,
            visible=1.0,
        )
        for one in found
    )


def posterior(index: int, log_weight: float, *chosen: int, offers: Sequence[Offer] = OFFERS) -> Posterior:
    return Posterior(index=index, count=4, objects=objects(*chosen, offers=offers), log_weight=log_weight)


EARLIER = [Contender(index=0, count=1, objects=objects(SHAKER), log_weight=-100.0)]


def test_what_made_another_scene_better_is_done_to_the_best_one():
    relabelled, added, vain = (
        posterior(0, -90.0, CAN),
        posterior(1, -80.0, SHAKER, CUP),
        posterior(2, -99.9, SHAKER, MUG),
    )
    assert combined([relabelled, added, vain], EARLIER, OFFERS) == [Revision((1,), (CAN,))]
    best = posterior(0, -70.0, CAN)
    assert combined([best, added, vain], EARLIER, OFFERS) == [Revision((0,), (CUP,))]


def test_one_box_is_changed_in_one_way():
    assert combined([posterior(0, -90.0, SHAKER, MUG), posterior(1, -80.0, SHAKER, CUP)], EARLIER, OFFERS) == []


def test_what_another_scene_left_out_is_left_out_of_the_best_one():
    earlier = [Contender(index=0, count=1, objects=objects(SHAKER, CUP), log_weight=-100.0)]
    found = combined([posterior(0, -90.0, CUP), posterior(1, -80.0, SHAKER, MUG)], earlier, OFFERS)
    assert found == [Revision((1,), ())]


def test_the_first_round_revises_nothing():
    assert combined([posterior(0, -90.0, CAN), posterior(1, -80.0, SHAKER)], [], OFFERS) == []


def test_what_stands_in_the_box_of_another_object_may_be_an_equal_of_it():
    stack, front = np.array([0.0, 0, 60, 80]), np.array([10.0, 60, 50, 80])
    offers = offered(
        ("sponge", stack, False),
        ("tuna_can", front, False),
        ("sponge", front, True),
        ("mug", front, True),
        ("cup", RIGHT, False),
        ("sponge", RIGHT, True),
    )
    assert equalled(posterior(0, -90.0, 0, 1, 4, offers=offers), offers) == [Revision((0, 2), (2,))]
    assert equalled(posterior(0, -90.0, 0, 2, 4, offers=offers), offers) == []


def test_what_hangs_is_carried_by_something_though_a_box_below_it_leaves_something_open():
    """That box is tried first, by each label that it may have; what it may not show is tried at once."""
    below, gap = np.array([10.0, 60, 50, 80]), np.array([0.0, 50, 60, 80])
    offers = offered(("tea_box", LEFT, False), ("tuna_can", below, False), ("cup", below, True))
    offers += offered(("tuna_can", gap, True), ("sponge", gap, True))
    best = msgspec.structs.replace(posterior(0, -90.0, 0, offers=offers), unexplained=(0.0, 0.2, 0.2))
    assert suggested(best, offers) == [Revision((0,), (4,))]


def test_no_box_keeps_others_from_a_trial():
    boxes = (LEFT, RIGHT, RIGHT + 200)
    offers = offered(*((label, box, True) for box in boxes for label in ("cup", "mug", "sponge")))
    revisions = [Revision((), (k,)) for k in range(9)]
    assert [one.new[0] for one in some_of_each_box(revisions, offers, 2, boxes=3)] == [0, 1, 3, 6, 4, 7]
    assert [one.new[0] for one in some_of_each_box(revisions, offers, 2, boxes=2)] == [0, 1, 3, 6]
    assert some_of_each_box([], offers, 2, boxes=2) == []
