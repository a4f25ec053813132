"""Executes the steps of one stage again, in the order of its journal, and compares what they emit."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path

import msgspec

from runner.contract import Message, Tolerances
from runner.graph.graph import Node
from runner.graph.ports import Handler
from runner.inspect.compare import envelope_differences
from runner.inspect.summary import FieldChange, Summary
from runner.message.codec import CodecError, Envelope, Step, pack, spelled_out
from runner.message.ids import MessageId
from runner.process.step import Arrival, Executor, Log, receive, step_time
from runner.recording.migrations import without_gained_fields
from runner.recording.recording import Recording, replicated
from runner.replay.tolerances import outside

HEADER = tuple(name for name in Envelope.__struct_fields__ if name != "body")
"""What is compared of a message beside its fields."""


class Task(msgspec.Struct, frozen=True):
    """What one process executes again: one incarnation of a stage, or a share of a replicated stage's steps."""

    stage: str
    incarnation: int
    share: int = 0
    shares: int = 1

    def __str__(self) -> str:
        share = f" ({self.share + 1} of {self.shares})" if self.shares > 1 else ""
        return f"{self.stage}{_after_restart(self.incarnation)}{share}"


class Result(msgspec.Struct):
    """How a task ended, or how far it has come."""

    steps: int = 0
    compared: list[str] = msgspec.field(default_factory=list[str])
    """Ids of recorded messages."""
    seconds: float = 0.0
    """Processor time inside handlers, which does not depend on what else runs."""
    startup: float = 0.0
    """Processor time until the stage was constructed."""
    within: int = 0
    """Messages that differ, but no more than tolerances allow."""
    diverged: int = 0
    first: tuple[int, str] | None = None
    """The difference that comes first: position of its message in the recording, and where and how it differs."""
    changes: tuple[FieldChange, ...] = ()
    failure: str = ""
    """Why the stage could not be executed at all."""

    def __str__(self) -> str:
        if self.failure:
            return f"could not be executed: {self.failure}"
        words = [f"{self.diverged} DIVERGED"] if self.diverged else []
        words += [f"{self.within} within tolerances"] if self.within else []
        counts = f"{self.steps} steps, {len(self.compared)} messages, {self.seconds:.2f} s"
        return f"{counts}, {', '.join(words) or 'identical'}"


def steps_of(recording: Recording, task: Task, node: Node) -> list[Step]:
    """The steps that a task executes, in order.

    A stage that is stateful has rebuilt its state after each restart, from what its earlier processes had done: one
    task executes all of it.
    """
    steps = [step for step in recording.steps if step.stage == task.stage]
    if task.stage in replicated(recording.graph):
        return steps[task.share :: task.shares]
    if node.type.cls.stateful:
        last = max((step.incarnation for step in steps), default=0)
        lasting = (step for step in steps if step.outcome == "done" or step.incarnation == last)
        return sorted(lasting, key=lambda step: (step.incarnation, step.number))
    return sorted((step for step in steps if step.incarnation == task.incarnation), key=lambda step: step.number)


@dataclass(slots=True)
class Execution:
    """What came of one step."""

    step: Step
    arrivals: list[Arrival] = field(default_factory=list[Arrival])
    emitted: list[Envelope] = field(default_factory=list[Envelope])
    error: str = ""
    """What the handler raised."""
    refused: str = ""
    """Why it could not be executed at all."""
    ended: bool = False
    """True once the handler has nothing more to emit."""


class Reexecution:
    """A new instance of a stage and the steps it takes again."""

    def __init__(
        self,
        recording: Recording,
        node: Node,
        steps: Sequence[Step],
        *,
        seed: int,
        directory: Path,
        log: Log = lambda *_: None,
    ) -> None:
        """Constructs the stage; raises Refused where that fails."""
        self._recording = recording
        replicas = recording.graph["stages"][node.name].get("replicas", 1)
        self._node = node = replace(node, replicas=replicas)  # whether or not there were several, ids say
        self.stage = node.construct()
        numbers: dict[str, int] = {}  # where the sequence of each port went on in this incarnation
        for id in (MessageId.of(id) for step in steps for id in step.emitted):
            numbers.setdefault(id.port, id.sequence)
        self._executor = Executor(node, self.stage, seed=seed, directory=directory, log=log, numbers=numbers)
        self.seconds = 0.0

    def execute(self, step: Step) -> Execution:
        """Takes one step; what a handler raises is noted, not raised."""
        return deque(self.take(step), maxlen=1)[0]

    def take(self, step: Step) -> Iterator[Execution]:
        """Takes one step message by message: pauses after each, inside the handler, and once more at its end."""
        done = Execution(step)
        handler = next((handler for handler in self._node.type.handlers if handler.name == step.handler), None)
        try:
            done.arrivals = self._arrivals(step)
        except CodecError as error:
            done.refused = f"it cannot be executed: {error}"
        except KeyError as error:
            done.refused = f"it cannot be executed: {error.args[0]} is not recorded"
        if handler is None:
            done.refused = f"{step.handler}: the stage has no such handler any more"
        elif not done.refused:
            for sealed in self._emissions(done, handler):
                done.emitted.append(sealed)
                yield done
        done.ended = True
        yield done

    def _arrivals(self, step: Step) -> list[Arrival]:
        arrivals: list[Arrival] = []
        for port, id in step.consumed:
            if port not in self._node.type.inputs:
                raise CodecError(f"input {id}", "", f"the stage has no input {port!r} any more")
            try:
                arrivals.append(receive(self._node.type.inputs[port], self._recording.envelope(id)))
            except CodecError as error:
                raise CodecError(f"input {id}: {error.type}", error.field, error.reason) from None
        return arrivals

    def _emissions(self, done: Execution, handler: Handler) -> Iterator[Envelope]:
        """What the handler emits; a stage that was stopped is not asked for more than it had emitted."""
        step = done.step
        time_ns = step_time(self._node, done.arrivals, step.time_ns)
        wanted = len(step.emitted) if step.outcome == "stopped" else None
        emissions = itertools.islice(self._executor.run(handler, done.arrivals, time_ns), wanted)
        while True:
            began = time.process_time()
            try:
                sealed = next(emissions, None)
            except BaseException as error:  # as in a run, where also who calls sys.exit() has failed
                if isinstance(error, KeyboardInterrupt) and not step.error.startswith("KeyboardInterrupt"):
                    raise  # of who sits at the terminal
                done.error = spelled_out(f"{type(error).__name__}: {error}")
                return
            finally:
                self.seconds += time.process_time() - began
            if sealed is None:
                return
            yield sealed


def failed_so(step: Step, error: str) -> bool:
    """Whether a recorded step failed, or not, with this error; recorded it says where it was raised, too."""
    return step.error == error or step.error.startswith(f"{error} (")


class Comparison:
    """Compares what steps emit with what is recorded."""

    def __init__(self, recording: Recording, node: Node, tolerances: Tolerances) -> None:
        """``tolerances`` is empty where the fingerprint is the recording's."""
        self.result = Result()
        self._recording = recording
        self._node = node
        self._tolerances = tolerances
        self._positions = {id: position for position, id in enumerate(recording.messages)}
        self.summary = Summary()

    def add(self, done: Execution) -> None:
        """Compares one step."""
        step = done.step
        self.result.steps += 1
        if done.refused:
            self._diverge(step, step.emitted[0] if step.emitted else step.handler, done.refused)
            return
        for id, sealed in itertools.zip_longest(step.emitted, done.emitted):
            if id is None:
                self._diverge(step, sealed.id, "emitted in the replay only")
            elif sealed is None:
                self._diverge(step, id, "recorded, and not emitted in the replay")
            elif id in self._recording.messages:
                self._compare(step, self._recording.envelope(id), sealed)
        recorded_so = failed_so(step, done.error)
        if step.outcome != "stopped" and not recorded_so:
            text = f"recorded {step.error or 'no error'!r}, replayed {done.error or 'no error'!r}"
            self._diverge(step, "-", f"error: {text}")

    def _compare(self, step: Step, recorded: Envelope, replayed: Envelope) -> None:
        self.result.compared.append(recorded.id)
        kind = self._node.type.outputs[MessageId.of(replayed.id).port]
        other = what_differs(recorded, replayed, kind)
        if other is None:
            return
        found = list(envelope_differences(recorded, other, HEADER, kind))
        self.summary.add(MessageId.of(recorded.id).topic, recorded.id, found)
        beyond = next(outside(found, self._tolerances), None)
        if beyond is None:
            self.result.within += 1
        else:
            self._diverge(step, recorded.id, str(beyond))

    def _diverge(self, step: Step, message: str, difference: str) -> None:
        """``message`` is an id, or what was expected in its place."""
        position = self._positions.get(message, len(self._positions))
        found = position, f"stage {process_of(step)}, step {step.number}, message {message}: {difference}"
        self.result.diverged += 1
        self.result.first = min(self.result.first or found, found, key=itemgetter(0))


def process_of(step: Step) -> str:
    """The process that took a step, for people."""
    return f"{step.stage}[{step.replica}]{_after_restart(step.incarnation)}"


def _after_restart(incarnation: int) -> str:
    return f" after restart {incarnation}" if incarnation else ""


def what_differs(recorded: Envelope, replayed: Envelope, kind: type[Message]) -> Envelope | None:
    """A replayed message of class ``kind`` as far as the recording speaks of it; None where that is the same to the
    byte."""
    if pack(recorded) == pack(replayed):
        return None
    replayed = without_gained_fields(recorded, replayed, kind)
    return None if pack(recorded) == pack(replayed) else replayed
