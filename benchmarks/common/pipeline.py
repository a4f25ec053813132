"""Runs the perception stages of a graph in one process, with the seeds and bytes that its runner would give."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, Protocol, TypeVar

from benchmarks.common.datasets import Image
from runner.contract import Message, Refused
from runner.graph.graph import Graph
from runner.process.step import step_seed
from stages.estimate import FiltersHere, Quiet, SceneEstimator
from stages.messages import Hypothesis, Observation, Posterior, SceneEstimate
from stages.messages.digest import LoneCandidate, LoneEstimate
from stages.particle_filter import ParticleFilter

STAGES = ("hypotheses", "particle_filter", "ranker", "refiner")
"""Of a graph: those between the candidates and the final scene."""
Answer = TypeVar("Answer", LoneEstimate, Posterior)


@dataclass(frozen=True)
class Estimate:
    """What perception made of one image."""

    scene: SceneEstimate
    messages: tuple[Message, ...]
    """Everything that was emitted on the way: observation, hypotheses, posteriors, ..."""
    cpu_seconds: float
    """Of all processes together."""
    seconds: float
    """Wall time from the image with its boxes to the final scene."""


@dataclass(frozen=True)
class Part:
    """What one particle filter is asked."""

    handler: Literal["on_prospect", "on_hypothesis"]
    message: LoneCandidate | Hypothesis
    observation: Observation


@dataclass(frozen=True)
class Done(Generic[Answer]):
    """Its answer, and the time that it took its process."""

    answer: Answer
    cpu_seconds: float


class Pool(Protocol):
    """Processes with a particle filter each."""

    def submit(self, part: Part) -> Future[Done[Any]]:
        """Has the next free one answer."""
        ...


@dataclass
class PooledFilters:
    """Particle filters in other processes."""

    pool: Pool
    cpu_seconds: float = field(default=0.0, init=False)
    """What they have computed so far."""

    def look(self, prospects: Sequence[LoneCandidate], observation: Observation) -> list[LoneEstimate]:
        """All looks at once."""
        return self._answers([Part("on_prospect", prospect, observation) for prospect in prospects])

    def estimate(self, hypotheses: Sequence[Hypothesis], observation: Observation) -> list[Posterior]:
        """All hypotheses at once."""
        return self._answers([Part("on_hypothesis", hypothesis, observation) for hypothesis in hypotheses])

    def _answers(self, parts: Sequence[Part]) -> list[Any]:
        done = [future.result() for future in [self.pool.submit(part) for part in parts]]
        self.cpu_seconds += sum(each.cpu_seconds for each in done)
        return [each.answer for each in done]


def answered(stage: ParticleFilter, part: Part) -> Done[Any]:
    """What a particle filter makes of its part."""
    cpu = time.process_time()
    answer = getattr(stage, part.handler)(part.message, part.observation, Quiet())
    return Done(answer, time.process_time() - cpu)


class Pipeline:
    """The stages between boxes and the final scene, constructed once."""

    def __init__(self, graph: Graph, pool: Pool | None = None) -> None:
        """Raises Refused where the graph lacks one of the stages."""
        for name in STAGES:
            if name not in graph.nodes:
                raise Refused(f"{graph.name}: no stage '{name}'; there are {', '.join(graph.nodes)}")
        self._seed = graph.seed
        made: dict[str, Any] = {name: graph.nodes[name].construct() for name in STAGES if name != "particle_filter"}
        self._pooled = None if pool is None else PooledFilters(pool)
        filters = self._pooled or FiltersHere(constructed_filter(graph))
        appraiser: Any = graph.nodes["appraiser"].construct() if "appraiser" in graph.nodes else None
        self._estimator = SceneEstimator(made["hypotheses"], filters, made["ranker"], made["refiner"], appraiser)

    def estimate(self, image: Image) -> Estimate:
        """The scene of one image; random numbers are those of a run over the whole data set."""
        began, cpu = time.perf_counter(), self._cpu_seconds()
        # Of all steps only the one that answers the frame asks for random numbers.
        ctx = Quiet(step_seed(self._seed, "hypotheses", f"camera.frame#{image.frame.index}"))
        messages = tuple(self._estimator.messages(image.frame, image.candidates, ctx))
        final = messages[-1]
        assert isinstance(final, SceneEstimate)
        return Estimate(final, messages, self._cpu_seconds() - cpu, time.perf_counter() - began)

    def _cpu_seconds(self) -> float:
        return time.process_time() + (self._pooled.cpu_seconds if self._pooled else 0.0)


def constructed_filter(graph: Graph) -> ParticleFilter:
    """The graph's particle filter."""
    stage: Any = graph.nodes["particle_filter"].construct()
    return stage
