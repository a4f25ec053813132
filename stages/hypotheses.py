"""Candidates in, hypothesised scenes out: finds the support plane and enumerates combinations of candidates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from runner.contract import Context, Refused, Stage
from stages.messages import Candidates, Frame, Hypothesis, Observation
from stages.perception.combinations import count_combinations, most_confident
from stages.perception.preprocessing import preprocess


class Hypotheses(Stage):
    """Equation 2: h = C(m, N_c) hypotheses where N_c <= m, one of all m candidates otherwise."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings."""

        n_objects: int | None = None
        """N_c; None takes the number that comes with each frame (a data set's targets)."""
        max_hypotheses: int = 32
        """Cap on h, highest joint confidence first."""
        max_height: float = 0.6
        """Metres above the support plane beyond which a reading belongs to no object."""

        def __post_init__(self) -> None:
            if self.n_objects is not None and self.n_objects < 0:
                raise Refused(f"hypotheses.n_objects is {self.n_objects}; it must be 0 or more, or absent")
            if self.max_hypotheses < 1:
                raise Refused(f"hypotheses.max_hypotheses is {self.max_hypotheses}; it must be 1 or more")
            if self.max_height <= 0:
                raise Refused(f"hypotheses.max_height is {self.max_height} m; it must be above 0")

    def __init__(self, config: Config) -> None:
        self.config = config

    def on_candidates(self, frame: Frame, candidates: Candidates, ctx: Context) -> Iterator[Observation | Hypothesis]:
        """One observation, then h hypotheses, the most confident combination first."""
        yield preprocess(frame, candidates.candidates, ctx.rng, max_height=self.config.max_height)
        chosen = self._n_objects(frame)
        combinations = most_confident(candidates.candidates, chosen, self.config.max_hypotheses)
        left_out = count_combinations(len(candidates.candidates), chosen) - len(combinations)
        if left_out:
            ctx.log(
                f"{frame.name}: {len(combinations)} of {len(combinations) + left_out} hypotheses, {left_out} of the "
                "least confident left out (hypotheses.max_hypotheses)"
            )
        for index, combination in enumerate(combinations):
            yield Hypothesis(index=index, count=len(combinations), candidates=combination, left_out=left_out)

    def _n_objects(self, frame: Frame) -> int:
        for number in (self.config.n_objects, frame.n_objects):
            if number is not None:
                return number
        raise Refused(
            f"{frame.name}: the number of objects is not known; set hypotheses.n_objects to a whole number, or use a "
            "data set with a targets file"
        )
