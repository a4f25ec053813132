"""Candidates in, hypothesised scenes out: finds the support plane and enumerates combinations of candidates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from runner.contract import Context, Refused, Stage
from stages.messages import Candidate, Candidates, Frame, Hypothesis, Observation
from stages.messages.digest import Glimpse, Placed, Prospect, Sighting, Start
from stages.perception.hypotheses.combinations import (
    additions_first,
    cheapest,
    count_combinations,
    count_subsets,
    most_confident,
    ordered,
)
from stages.perception.hypotheses.composition import FirstLook, charge
from stages.perception.hypotheses.duplicates import distinct
from stages.perception.observation.preprocessing import preprocess


@dataclass(frozen=True)
class _Found:
    """A candidate and what the look at it alone found."""

    candidate: Candidate
    start: Start
    glimpse: Glimpse
    share: float

    @property
    def charge(self) -> float:
        """What the object costs by being there."""
        return charge(self.candidate.box, self.start, self.share)


class Hypotheses(Stage):
    """Equation 2: h = C(m, N_c) hypotheses where N_c <= m, one of all m candidates otherwise.

    Each candidate is looked at alone first, once for all hypotheses, and those go on whose objects together would cost
    least as they stand. The paper's plain form takes no such look; the most confident combinations go on.
    """

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings."""

        n_objects: int | Literal["auto"] | None = None
        """N_c; ``auto`` finds it; None takes the number that comes with each frame (a data set's targets)."""
        max_hypotheses: int = 32
        """Cap on h without first looks, highest joint confidence first."""
        finalists: int = 8
        """Cap on h with first looks, least cost first."""
        max_height: float = 0.6
        """Metres above the support plane beyond which a reading belongs to no object."""

        def __post_init__(self) -> None:
            if self.n_objects is not None and self.n_objects != "auto" and self.n_objects < 0:
                raise Refused(f"hypotheses.n_objects is {self.n_objects}; it must be 0 or more, auto, or absent")
            for name in ("max_hypotheses", "finalists"):
                if getattr(self, name) < 1:
                    raise Refused(f"hypotheses.{name} is {getattr(self, name)}; it must be 1 or more")
            if self.max_height <= 0:
                raise Refused(f"hypotheses.max_height is {self.max_height} m; it must be above 0")

    def __init__(self, config: Config) -> None:
        self.config = config

    def on_candidates(self, frame: Frame, candidates: Candidates, ctx: Context) -> Iterator[Observation | Prospect]:
        """One observation, then every candidate by itself, the most confident first."""
        number = self._n_objects(frame)
        yield preprocess(frame, candidates.candidates, ctx.rng, max_height=self.config.max_height)
        prospects = ordered(candidates.candidates) or [None]
        for index, candidate in enumerate(prospects):
            yield Prospect(index=index, count=len(prospects), candidate=candidate, n_objects=number)

    def on_sightings(self, sightings: list[Sighting], ctx: Context) -> Iterator[Hypothesis]:
        """h hypotheses, the cheapest (in the paper's plain form the most confident) combination first."""
        number = sightings[0].n_objects
        found = [_Found(s.candidate, s.start, s.glimpse, s.share) for s in sightings if s.candidate is not None
                 and s.start is not None and s.glimpse is not None]  # fmt: skip
        if found:
            yield from self._cheapest(_distinct(found, ctx), number, ctx)
        else:
            yield from self._most_confident([s.candidate for s in sightings if s.candidate is not None], number, ctx)

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

    def _cheapest(self, found: list[_Found], number: int | None, ctx: Context) -> Iterator[Hypothesis]:
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


def _distinct(found: list[_Found], ctx: Context) -> list[_Found]:
    """Those that show no object that a more confident one shows, the most confident first."""
    found = sorted(found, key=lambda each: -each.candidate.confidence)
    labels, boxes = [each.candidate.label for each in found], [each.candidate.box for each in found]
    kept = distinct(labels, boxes, [each.start.T_camera_object[:3, 3] for each in found])
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
