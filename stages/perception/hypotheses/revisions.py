"""What may be wrong with the best scene so far: ways to revise it that its unexplained readings suggest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from stages.messages.digest import Contender, Offer, Posterior
from stages.messages.scene import ObjectPose
from stages.perception.detection.boxes import intersection_over_union
from stages.perception.hypotheses.duplicates import SHARED, shared

_OPEN = 0.1
"""Share of what stands in a candidate's box from which on its object may be missing, or stand elsewhere."""
_EQUAL = 0.01
"""Difference of two such shares that is none."""
_UNSEEN = 0.05
"""Visible share of an object up to which it may well explain nothing."""
_MISFIT = 1.5
"""How many times as badly as the others (their median) an object fits from which on its label is doubted."""
_SAME = 0.5
"""Intersection over union of two boxes from which on they frame the same."""
_GAIN = 0.01
"""Share of the cost that a round must save for another one to follow."""


@dataclass(frozen=True)
class Revision:
    """Another scene: some objects of the best one stay, some offers are looked for among them."""

    kept: tuple[int, ...]
    """Indices of objects."""
    new: tuple[int, ...]
    """Indices of offers, in the order in which they are looked for."""


def revisions(best: Posterior, offers: Sequence[Offer], before: Sequence[float] = ()) -> list[Revision]:
    """Every revision of the best scene but other labels, the likelier kinds first.

    An object that others hide all but wholly is left out; an offer comes in; another object of the same kind does, for
    two of which one hides most of the other may share a box; an offer comes in, and an object in its way is looked for
    again then; an object is looked for again; it is left out. Where as much was unexplained ``before``, in the scene
    that the last round revised, that was in vain.
    """
    everything = tuple(range(len(best.objects)))
    chosen = _chosen(best.objects, offers)
    without = {k: tuple(j for j in everything if j != i) for k, i in chosen.items()}
    unseen = [k for k, i in chosen.items() if best.objects[i].visible < _UNSEEN]
    left_open = _left_open(best, before)
    missing = [k for k in left_open if k not in chosen and not offers[k].instead]
    doubtful = [k for k in left_open if k in chosen]
    met = [(k, new) for k, new in product(doubtful, missing) if _meet(offers[k], offers[new])]
    return [
        *(Revision(without[k], ()) for k in unseen),
        *(Revision(everything, (new,)) for new in missing),
        *(Revision(everything, (k,)) for k in doubtful),
        *(Revision(without[k], (new, k)) for k, new in met),
        *(Revision(without[k], (k,)) for k in doubtful),
        *(Revision(without[k], ()) for k in doubtful),
    ]


def relabelled(best: Posterior, offers: Sequence[Offer], before: Sequence[float] = ()) -> list[Revision]:
    """Revisions in which what a box leaves unexplained is an object by another label, in the place of the one that came
    from that box, if there is any; as :func:`revisions`."""
    chosen = _chosen(best.objects, offers)
    instead = [k for k in _left_open(best, before) if offers[k].instead and k not in chosen]
    taken = [{i for other, i in chosen.items() if _same_box(offers[k], offers[other])} for k in instead]
    return [
        Revision(tuple(i for i in range(len(best.objects)) if i not in gone), (k,))
        for k, gone in zip(instead, taken, strict=True)
    ]


def refitted(best: Posterior, offers: Sequence[Offer]) -> list[Revision]:
    """Revisions in which the object that fits worst gives way to one by another label: it may cover readings without
    being alike.

    The other label is one of its box; where it shares that with another object, also one of a box that shows the same.
    """
    if len(best.objects) < 2:
        return []
    *others, worst = sorted(best.objects, key=lambda item: item.cost)
    if worst.cost < _MISFIT * np.median([item.cost for item in others]):
        return []
    kept, chosen = tuple(i for i, item in enumerate(best.objects) if item is not worst), _chosen(best.objects, offers)
    doubled = any(np.array_equal(item.box, worst.box) for item in others)
    boxes = {k: offer.candidate.box for k, offer in enumerate(offers) if offer.instead and k not in chosen}
    return [
        Revision(kept, (k,))
        for k, box in boxes.items()
        if np.array_equal(box, worst.box) or (doubled and shared(box, worst.box) > SHARED)
    ]


def equalled(best: Posterior, offers: Sequence[Offer]) -> list[Revision]:
    """Revisions in which what stands in the box of another object is an equal of that: the detector frames two equal
    objects, of which one hides part of the other, as one."""
    chosen = _chosen(best.objects, offers)
    return [
        Revision(tuple(i for i in range(len(best.objects)) if i != gone), (k,))
        for other, gone in chosen.items()
        for k, offer in enumerate(offers)
        if offer.instead and k not in chosen and _same_box(offer, offers[other])
        and any(item.label == offer.candidate.label and shared(item.box, offer.candidate.box) > SHARED
                for item in best.objects)
    ]  # fmt: skip


def suggested(best: Posterior, offers: Sequence[Offer], before: Sequence[float] = ()) -> list[Revision]:
    """Revisions in which something comes in that the best scene suggests, the last of the offers; not what a box that
    leaves something unexplained itself may show, of which the other revisions take care first."""
    everything = tuple(range(len(best.objects)))
    open_boxes = [offers[k].candidate for k in _left_open(best, before)]
    return [
        Revision(everything, (k,))
        for k in range(len(best.unexplained), len(offers))
        if not any(
            shared(each.box, offers[k].candidate.box) > SHARED and each.label == offers[k].candidate.label
            for each in open_boxes
        )
    ]


def combined(posteriors: Sequence[Posterior], earlier: Sequence[Contender], offers: Sequence[Offer]) -> list[Revision]:
    """Revisions that do to the best scene of a round what made others of it better, too, the best first; but what
    concerns the boxes that it changed itself. All of them revised the best of the ``earlier`` scenes."""
    if not earlier:
        return []
    revised = max(earlier, key=lambda each: each.log_weight)
    ranked = sorted(posteriors, key=lambda each: -each.log_weight)
    best, *others = (each for each in ranked if is_better(each.log_weight, revised.log_weight))
    chosen, before = _chosen(best.objects, offers), _chosen(revised.objects, offers).keys()
    changed = before ^ chosen.keys()
    found: list[Revision] = []
    for other in others:
        after = _chosen(other.objects, offers).keys()
        gone, new = before - after, sorted(after - before)
        boxes = ((offers[k].candidate.box, offers[c].candidate.box) for k, c in product(gone | {*new}, changed))
        if not any(shared(*pair) > SHARED for pair in boxes):
            found.append(Revision(tuple(i for k, i in chosen.items() if k not in gone), tuple(new)))
    return found


def new_offers(suggestions: Sequence[Offer], offers: Sequence[Offer]) -> list[Offer]:
    """Those of some suggestions that were not made before."""
    return [each for each in suggestions if not any(_same(each, offer) for offer in offers)]


def some_of_each_box(
    revisions: Sequence[Revision], offers: Sequence[Offer], most: int, *, boxes: int
) -> list[Revision]:
    """Of revisions that bring in one offer each, the first ``most`` of the first one's box, then those of the other
    boxes in turns, ``boxes`` times as many in all: no box keeps the others from a trial."""
    boxes_of = [tuple(offers[each.new[0]].candidate.box.tolist()) for each in revisions]
    tried, turns = Counter[tuple[float, ...]](), list[tuple[int, int]]()
    for k, box in enumerate(boxes_of):
        turns += [(-1 if box == boxes_of[0] else tried[box], k)] if tried[box] < most else []
        tried[box] += 1
    return [revisions[k] for _, k in sorted(turns)[: boxes * most]]


def is_better(log_weight: float, known: float) -> bool:
    """Whether a scene saves enough of what the best one before costs."""
    return log_weight > (1 - _GAIN) * known


def _chosen(objects: Sequence[ObjectPose], offers: Sequence[Offer]) -> dict[int, int]:
    """The indices of a scene's objects by their offers."""
    return {_index(item, offers): i for i, item in enumerate(objects)}


def _left_open(best: Posterior, before: Sequence[float]) -> list[int]:
    """The offers in whose boxes something is unexplained, most first, but those that were tried in vain."""
    by_share = sorted(range(len(best.unexplained)), key=lambda k: -best.unexplained[k])
    tried = [k for k, share in enumerate(before) if share > _OPEN and abs(best.unexplained[k] - share) < _EQUAL]
    return [k for k in by_share if best.unexplained[k] > _OPEN and k not in tried]


def _index(item: ObjectPose, offers: Sequence[Offer]) -> int:
    """The offer that an object comes from."""
    return next(k for k, offer in enumerate(offers)
                if offer.candidate.label == item.label and np.array_equal(offer.candidate.box, item.box))  # fmt: skip


def _same(one: Offer, other: Offer) -> bool:
    """Whether two offers are of one label in about one box, and as much is asked of both."""
    a, b = one.candidate, other.candidate
    return (
        a.label == b.label
        and one.share == other.share
        and float(intersection_over_union(a.box[None], b.box[None])[0, 0]) > _SAME
    )


def _same_box(one: Offer, other: Offer) -> bool:
    return np.array_equal(one.candidate.box, other.candidate.box)


def _meet(one: Offer, other: Offer) -> bool:
    a, b = one.candidate.box, other.candidate.box
    return bool((np.maximum(a[:2], b[:2]) < np.minimum(a[2:], b[2:])).all())
