"""Candidates in, hypothesised scenes out: finds the support plane and enumerates combinations of candidates."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from runner.contract import Context, Refused, Stage
from stages.geometry.poses import pose
from stages.messages import Candidate, Candidates, Frame, Hypothesis, ObjectPose, Observation, Posterior
from stages.messages.digest import Contender, DepthPatch, LoneCandidate, LoneEstimate, LonePose, Offer, Placed, Search
from stages.perception.hypotheses.combinations import (
    additions_first,
    cheapest,
    count_combinations,
    count_subsets,
    most_confident,
    ordered,
)
from stages.perception.hypotheses.composition import FirstLook, charge
from stages.perception.hypotheses.duplicates import unrepeated
from stages.perception.hypotheses.revisions import (
    Revision,
    combined,
    equalled,
    is_better,
    new_offers,
    refitted,
    relabelled,
    revisions,
    some_of_each_box,
    suggested,
)
from stages.perception.observation.preprocessing import preprocess


@dataclass(frozen=True)
class _Found:
    """A candidate and what the look at it alone found."""

    candidate: Candidate
    start: LonePose
    glimpse: DepthPatch
    share: float

    @property
    def charge(self) -> float:
        """What the object costs by being there."""
        return charge(self.candidate.box, self.start, self.share)


class Hypotheses(Stage):
    """Equation 2: h = C(m, N_c) hypotheses where N_c <= m, one of all m candidates otherwise.

    Each candidate is looked at alone first, once for all hypotheses, and those go on whose objects together would cost
    least as they stand. The paper's plain form takes no such look; the most confident combinations go on.

    Where N_c is not known, the best scene is revised while that makes it better: what it leaves unexplained may be an
    object that it leaves out, or one of its own that stands elsewhere. Alone, both may have been hidden by the others.
    """

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings."""

        n_objects: int | Literal["auto"] | None = None
        """N_c; ``auto`` finds it; None takes the number that comes with each frame (a data set's targets)."""
        max_hypotheses: int = 32
        """Cap on h without first looks, highest joint confidence first."""
        finalists: int = 8
        """Cap on h with first looks, least cost first, on the revisions and on the other labels of a round."""
        revisions: int = 4
        """Rounds in which the best scene is revised at most, where N_c is not known."""
        suggestions: bool = False
        """Whether what no box shows may be any object: what the best scene leaves unexplained beside its objects, and
        what carries those that hang. For catalogues that hold all that may be there; else it stays unknown."""
        max_height: float = 0.6
        """Metres above the support plane beyond which a reading belongs to no object."""

        def __post_init__(self) -> None:
            if self.n_objects is not None and self.n_objects != "auto" and self.n_objects < 0:
                raise Refused(f"hypotheses.n_objects is {self.n_objects}; it must be 0 or more, auto, or absent")
            for name in ("max_hypotheses", "finalists"):
                if getattr(self, name) < 1:
                    raise Refused(f"hypotheses.{name} is {getattr(self, name)}; it must be 1 or more")
            if self.revisions < 0:
                raise Refused(f"hypotheses.revisions is {self.revisions}; it must be 0 or more")
            if self.max_height <= 0:
                raise Refused(f"hypotheses.max_height is {self.max_height} m; it must be above 0")

    def __init__(self, config: Config) -> None:
        self.config = config

    def on_candidates(
        self, frame: Frame, candidates: Candidates, ctx: Context
    ) -> Iterator[Observation | LoneCandidate]:
        """One observation, then every candidate by itself, the most confident first; without a support plane none."""
        number = self._n_objects(frame)
        prospects = ordered(candidates.candidates) or [None]
        try:
            observation = preprocess(frame, candidates.candidates, ctx.rng, max_height=self.config.max_height)
        except Refused as refusal:
            ctx.log(f"{refusal}; nothing is estimated", level="warning")
            observation, prospects = _unusable(frame, str(refusal)), [None]
        yield observation
        for index, candidate in enumerate(prospects):
            yield LoneCandidate(index=index, count=len(prospects), candidate=candidate, n_objects=number)

    def on_sightings(self, sightings: list[LoneEstimate], ctx: Context) -> Iterator[Hypothesis]:
        """h hypotheses, the cheapest (in the paper's plain form the most confident) combination first."""
        number = sightings[0].n_objects
        found = [_Found(s.candidate, s.start, s.glimpse, s.share) for s in sightings if s.candidate is not None
                 and s.start is not None and s.glimpse is not None]  # fmt: skip
        if found:
            yield from self._cheapest(found, number, ctx)
        else:
            yield from self._most_confident([s.candidate for s in sightings if s.candidate is not None], number, ctx)

    def on_posteriors(self, posteriors: list[Posterior], ctx: Context) -> Iterator[Hypothesis | Contender]:
        """Revisions of the best scene so far, or all hypotheses for the ranking once these are in vain."""
        search = posteriors[0].search
        earlier = search.earlier if search else ()
        contenders = (*earlier, *map(_contender, posteriors))
        best = max(posteriors, key=lambda each: each.log_weight)
        known = max((each.log_weight for each in earlier), default=-np.inf)
        revised: list[Revision] = []
        if search:
            new = new_offers(best.suggested, search.offers)
            search = msgspec.structs.replace(search, offers=(*search.offers, *new))
        if search and search.rounds < self.config.revisions and is_better(best.log_weight, known):
            # What else made the scene better was not in vain.
            several = sum(is_better(each.log_weight, known) for each in posteriors) > 1
            before = () if several else search.unexplained
            revised = combined(posteriors, earlier, search.offers)[: self.config.finalists]
            revised += revisions(best, search.offers, before)[: self.config.finalists]
            revised += relabelled(best, search.offers, before)[: self.config.finalists]
            others = refitted(best, search.offers) + equalled(best, search.offers)
            revised += [each for each in dict.fromkeys(others) if each not in revised]
            unexplained = suggested(best, search.offers, before)
            revised += some_of_each_box(unexplained, search.offers, self.config.finalists, boxes=2)
        if search and revised:
            ctx.log(f"{len(revised)} revisions of the best scene, which leaves something unexplained or fits badly")
            following = msgspec.structs.replace(
                search, earlier=contenders, rounds=search.rounds + 1, unexplained=best.unexplained
            )
            yield from _revised(best, revised, following)
        for index, each in enumerate(() if revised else contenders):
            yield msgspec.structs.replace(each, index=index, count=len(contenders))

    def _most_confident(self, candidates: list[Candidate], number: int | None, ctx: Context) -> Iterator[Hypothesis]:
        if number is None and candidates:
            raise Refused(
                "hypotheses.n_objects is auto, which particle_filter.form paper cannot do; set a whole number"
            )
        number = number or 0
        combinations = most_confident(candidates, number, self.config.max_hypotheses)
        left_out = count_combinations(len(candidates), number) - len(combinations)
        if left_out:
            ctx.log(_left_out(len(combinations), left_out, "least confident", "max_hypotheses"))
        for index, combination in enumerate(combinations):
            yield Hypothesis(index=index, count=len(combinations), candidates=combination, left_out=left_out)

    def _cheapest(self, seen: list[_Found], number: int | None, ctx: Context) -> Iterator[Hypothesis]:
        found = _distinct(seen, ctx)
        if number is None:
            found = _not_refuted(found, ctx)
        charges = [each.charge if number is None else 0.0 for each in found]
        look = FirstLook([each.glimpse for each in found], charges)
        h = count_subsets(len(found), number)
        ranked = cheapest(look.cost, len(found), number, h)
        combinations = (ranked if number is not None else additions_first(ranked))[: self.config.finalists]
        left_out = h - len(combinations)
        if left_out:
            ctx.log(_left_out(len(combinations), left_out, "dearest at first look", "finalists"))
        incumbent = tuple(
            Placed(candidate=found[i].candidate, T_camera_object=found[i].start.T_camera_object)
            for i in combinations[0]
        )
        offers = (
            *(Offer(candidate=each.candidate, share=each.share) for each in found),
            # What shows an object once more may show another one, too.
            *(offer for each in seen for offer in _instead(each)),
        )
        search = None if number is not None else Search(offers=offers, suggestions=self.config.suggestions)
        for index, chosen in enumerate(combinations):
            yield Hypothesis(
                index=index,
                count=len(combinations),
                candidates=tuple(found[i].candidate for i in chosen),
                left_out=left_out,
                starts=tuple(found[i].start for i in chosen),
                incumbent=incumbent,
                charged=sum(charges[i] for i in chosen),
                incumbent_charged=sum(charges[i] for i in combinations[0]),
                charges=() if number is not None else tuple(charges[i] for i in chosen),
                search=search,
            )

    def _n_objects(self, frame: Frame) -> int | None:
        """N_c, or None where it is to be found."""
        if self.config.n_objects == "auto":
            return None
        for number in (self.config.n_objects, frame.n_objects):
            if number is not None:
                return number
        raise Refused(
            f"{frame.name}: the number of objects is not known; set hypotheses.n_objects to a whole number or auto, or "
            "use a data set with a targets file"
        )


def _unusable(frame: Frame, reason: str) -> Observation:
    """An observation without a reading, of a plane 1 m ahead of the camera."""
    return Observation(
        depth=np.zeros(frame.depth.shape, np.float32),
        rgb=frame.rgb,
        foreground=np.zeros(frame.depth.shape, bool),
        K=frame.K,
        T_camera_table=pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0])),
        T_base_camera=frame.T_base_camera,
        scene_id=frame.scene_id,
        image_id=frame.image_id,
        name=frame.name,
        unusable=reason,
    )


def _contender(posterior: Posterior) -> Contender:
    return Contender(
        index=posterior.index,
        count=posterior.count,
        objects=posterior.objects,
        log_weight=posterior.log_weight,
        left_out=posterior.left_out,
        lambda_r=posterior.lambda_r,
    )


def _revised(best: Posterior, revised: Sequence[Revision], search: Search) -> Iterator[Hypothesis]:
    """Hypotheses that begin with the best scene."""
    offers = search.offers
    placed = tuple(Placed(candidate=_candidate(item), T_camera_object=item.T_camera_object) for item in best.objects)
    for index, each in enumerate(revised):
        charges = tuple(best.charges[i] for i in each.kept)
        yield Hypothesis(
            index=index,
            count=len(revised),
            candidates=(*(placed[i].candidate for i in each.kept), *(offers[k].candidate for k in each.new)),
            left_out=best.left_out,
            starts=tuple(LonePose(T_camera_object=placed[i].T_camera_object, trace=best.traces[i]) for i in each.kept),
            incumbent=placed,
            charged=sum(charges),
            incumbent_charged=sum(best.charges),
            charges=charges,
            shares=tuple(offers[k].share for k in each.new),
            search=search if index == 0 else msgspec.structs.replace(search, earlier=()),
        )


def _instead(found: _Found) -> Iterator[Offer]:
    """The candidate by the labels that it may have instead."""
    for label in found.candidate.others:
        other = msgspec.structs.replace(found.candidate, label=label, others=())
        yield Offer(candidate=other, share=found.share, instead=True)


def _candidate(item: ObjectPose) -> Candidate:
    return Candidate(label=item.label, box=item.box, confidence=item.confidence)


def _distinct(found: list[_Found], ctx: Context) -> list[_Found]:
    """Those that show no object that a more confident one shows, the most confident first."""
    found = sorted(found, key=lambda each: -each.candidate.confidence)
    labels, boxes = [each.candidate.label for each in found], [each.candidate.box for each in found]
    kept = unrepeated(labels, boxes, [each.start.T_camera_object[:3, 3] for each in found])
    if len(kept) < len(found):
        ctx.log(f"{len(found) - len(kept)} of {len(found)} candidates show an object once more: left out")
    return [found[i] for i in kept]


def _not_refuted(found: list[_Found], ctx: Context) -> list[_Found]:
    """Those of which no more is asked than to explain all that they cover."""
    kept = [each for each in found if each.share < 1]
    if len(kept) < len(found):
        ctx.log(f"{len(found) - len(kept)} of {len(found)} candidates do not look like what they are called: left out")
    return kept


def _left_out(kept: int, left_out: int, which: str, setting: str) -> str:
    return f"{kept} of {kept + left_out} hypotheses, {left_out} of the {which} left out (hypotheses.{setting})"
