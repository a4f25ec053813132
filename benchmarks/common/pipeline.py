"""Runs the perception stages of a graph in one process, with the ids, seeds and bytes that its runner would give."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from benchmarks.common.datasets import Image
from runner.contract import Level, Message, Refused
from runner.graph.graph import Graph
from runner.graph.ports import Handler
from runner.message import codec
from runner.message.codec import Envelope
from runner.message.ids import MessageId
from runner.process.inbox import Inbox
from runner.process.step import Arrival, Executor, receive, step_time
from stages.messages import SceneEstimate

_GIVEN = ("camera", "detector")
"""Stages whose messages come with the image."""
_SINK = ("scene_graph", "scene_estimate")
"""The consumer of the final scene, and its port."""


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
class Step:
    """One call of a handler."""

    stage: str
    handler: Handler
    arrivals: tuple[Arrival, ...]


@dataclass(frozen=True)
class Done:
    """What a step emitted, and the time it took its process."""

    stage: str
    envelopes: tuple[Envelope, ...]
    cpu_seconds: float


class Pool(Protocol):
    """Processes that execute steps of replicated stages."""

    def submit(self, step: Step, index: int) -> Future[Done]:
        """Starts a step of image ``index`` somewhere else."""
        ...


class Pipeline:
    """The stages between boxes and the final scene, constructed once."""

    def __init__(self, graph: Graph, pool: Pool | None = None) -> None:
        self._graph = graph
        self._names = between(graph)
        local = [name for name in self._names if pool is None or not graph.nodes[name].replicated]
        self._steps = Steps(graph, local)
        self._pool = pool

    def estimate(self, image: Image) -> Estimate:
        """The scene of one image; ids are those of a run over the whole data set."""
        began, cpu = time.perf_counter(), time.process_time()
        look = _Look(self._graph, self._names, image)
        running: set[Future[Done]] = set()
        elsewhere = 0.0
        while (step := look.next()) or running:
            if step is None:
                finished, running = wait(running, return_when=FIRST_COMPLETED)
                for done in (future.result() for future in finished):
                    elsewhere += done.cpu_seconds
                    look.deliver(done.stage, done.envelopes)
            elif self._pool is not None and self._graph.nodes[step.stage].replicated:
                running.add(self._pool.submit(step, image.frame.index))
            else:
                for envelope in self._steps.run(step, image.frame.index):
                    look.deliver(step.stage, (envelope,))
        seconds = time.perf_counter() - began
        return Estimate(look.final(), tuple(look.messages), time.process_time() - cpu + elsewhere, seconds)

    def close(self) -> None:
        """Releases what the stages hold."""
        self._steps.close()


class Steps:
    """Constructed stages and how to call their handlers."""

    def __init__(self, graph: Graph, names: Sequence[str]) -> None:
        self._graph = graph
        self._stages = {name: graph.nodes[name].construct() for name in names}

    def run(self, step: Step, index: int) -> Iterator[Envelope]:
        """Yields what the handler emits, numbered as for the image ``index`` of a run over the whole data set."""
        node = self._graph.nodes[step.stage]
        executor = Executor(
            node,
            self._stages[step.stage],
            seed=self._graph.seed,
            directory=Path(),
            log=_silent,
            numbers=dict.fromkeys(node.type.outputs, index),
        )
        yield from executor.run(step.handler, step.arrivals, step_time(node, step.arrivals, 0))

    def timed(self, step: Step, index: int) -> Done:
        """Everything the handler emits, and its CPU time."""
        cpu = time.process_time()
        envelopes = tuple(self.run(step, index))
        return Done(step.stage, envelopes, time.process_time() - cpu)

    def close(self) -> None:
        """Releases what the stages hold."""
        for stage in self._stages.values():
            stage.close()


class _Look:
    """The messages of one image on their way."""

    def __init__(self, graph: Graph, names: Sequence[str], image: Image) -> None:
        self._graph = graph
        self._inboxes = {name: Inbox(graph.nodes[name]) for name in names}
        self._steps: deque[Step] = deque()
        self._final: list[Message] = []
        self.messages: list[Message] = []
        for stage, port, message in (
            ("camera", "frame", image.frame),
            ("detector", "candidates", image.candidates),
        ):
            root = f"camera.frame#{image.frame.index}"
            id = f"{stage}.{port}#{image.frame.index}"
            self.deliver(stage, (codec.envelope(message, id=id, lineage=root, time_ns=0, causes=()),))

    def deliver(self, stage: str, envelopes: Sequence[Envelope]) -> None:
        """Hands messages to every stage that consumes them."""
        for envelope in envelopes:
            port = MessageId.of(envelope.id).port
            kind = self._graph.nodes[stage].type.outputs[port]
            if stage not in _GIVEN:
                self.messages.append(codec.open_envelope(kind, envelope))
            for route in self._graph.routes(stage):
                if route.output == port:
                    self._add(route.consumer, route.input, envelope)

    def _add(self, consumer: str, port: str, envelope: Envelope) -> None:
        if (consumer, port) == _SINK:
            self._final.append(codec.open_envelope(SceneEstimate, envelope))
        if consumer in self._inboxes:
            inbox = self._inboxes[consumer]
            inbox.add(receive(self._graph.nodes[consumer].type.inputs[port], envelope))
            while (ready := inbox.pop()) is not None:
                self._steps.append(Step(consumer, ready.handler, ready.arrivals))

    def next(self) -> Step | None:
        """The next step that can run now."""
        return self._steps.popleft() if self._steps else None

    def final(self) -> SceneEstimate:
        """The scene; there is one for every image unless a stage swallows it."""
        (scene,) = self._final
        assert isinstance(scene, SceneEstimate)
        return scene


def between(graph: Graph) -> list[str]:
    """The stages that the final scene depends on, in the graph's order, without those whose messages are given."""
    if _SINK[0] not in graph.nodes:
        raise Refused(f"{graph.name}: no stage '{_SINK[0]}'; its {_SINK[1]} is what is scored")
    wanted: set[str] = set()
    waiting = [graph.nodes[_SINK[0]].inputs[_SINK[1]].stage]
    while waiting:
        name = waiting.pop()
        if name not in wanted and name not in _GIVEN:
            wanted.add(name)
            waiting += [edge.stage for edge in graph.nodes[name].inputs.values()]
    return [name for name in graph.nodes if name in wanted]


def _silent(text: str, level: Level) -> None:
    """What stages say is for a run's terminal."""
