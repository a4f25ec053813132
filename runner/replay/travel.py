"""Time travel: executes a stage again up to one message, shows it with its causes and opens a prompt with its state."""

from __future__ import annotations

import code
import importlib
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from runner.contract import Refused, Stage
from runner.graph.graph import SUPERVISOR, Graph
from runner.inspect.causes import Causes
from runner.inspect.compare import clipped, envelope_differences
from runner.inspect.echo import array_text
from runner.inspect.info import table
from runner.message.codec import Envelope, Step
from runner.message.ids import MessageId
from runner.message.packet import Process
from runner.process.step import arguments_of
from runner.recording.recording import Recording, kind_of, opened, replicated
from runner.replay.expression import Expression
from runner.replay.replay import change
from runner.replay.tasks import HEADER, Execution, Reexecution, Task, process_of, steps_of, what_differs

SHOWN = 76
"""Characters of a value that are shown."""
DIFFERENCES = 5
PROMPT = "[Enter] next message, p prompt, q quit > "


def travel(
    path: Path,
    *,
    assignments: Sequence[str],
    swaps: Sequence[str],
    until: str | None,
    condition: str | None,
    step: bool,
    prompt: bool,
) -> int:
    """Stops at message ``until``, or where ``condition`` first holds, or with ``step`` at one message after another.

    A Python prompt opens where ``prompt`` says so or the terminal is a person's. Returns 1 where nothing satisfies the
    condition. Raises Refused for a message, stage or port that does not exist, or where there are no messages.
    """
    recording = Recording(path)
    recording.require_messages()
    if not recording.messages:
        raise Refused(f"{path}: holds no messages: there is none to stop at")
    graph = change(recording, assignments, swaps)
    if until is not None:
        recording.require(until)
        start = until
    elif condition is not None:
        start = first_match(recording, graph, condition)
    else:
        start = next(iter(recording.messages))
    if start is None:
        print(f"{condition!r} holds for no message of {path}")
        return 1
    prompt = prompt or (sys.stdin.isatty() and sys.stdout.isatty())
    with tempfile.TemporaryDirectory() as folder:
        traveller = Traveller(recording, graph, Path(folder))
        try:
            traveller.go(start, step=step, prompt=prompt)
        finally:
            traveller.close()
    return 0


def first_match(recording: Recording, graph: Graph, condition: str) -> str | None:
    """The first recorded message after which a condition holds for the newest messages of its lineage."""
    ports = {name: graph.outputs_of(name) for name in (*graph.nodes, SUPERVISOR)}
    expression = Expression(condition, ports)
    newest: dict[str, dict[str, Any]] = defaultdict(dict)
    for id, located in recording.messages.items():
        if located.topic in expression.topics:
            newest[located.lineage][located.topic] = opened(graph, recording.envelope(id))
            if expression.holds(newest[located.lineage]):
                return id
    return None


@dataclass(frozen=True, slots=True)
class _Stop:
    """A message that was reached."""

    sealed: Envelope
    """As it was executed; as recorded where it was not."""
    step: Step | None
    """Of which it is."""
    names: dict[str, Any]
    """What there is to look at."""
    notes: list[str]
    """What came of it."""


class Traveller:
    """Goes from message to message; stages are constructed when the first of their messages is reached."""

    def __init__(self, recording: Recording, graph: Graph, folder: Path) -> None:
        self._recording = recording
        self._graph = graph
        self._folder = folder
        self._causes = Causes(recording)
        self._log: list[str] = []
        self._processes: dict[Process, tuple[Stage, Iterator[Execution]]] = {}

    def close(self) -> None:
        """Closes the stages that were constructed."""
        for stage, _ in self._processes.values():
            with suppress(Exception):  # and goes on with the others
                stage.close()

    def go(self, start: str, *, step: bool, prompt: bool) -> None:
        """Shows a message, with ``step`` the ones after it too for as long as somebody presses Enter."""
        ids = list(self._recording.messages)
        for id in ids[ids.index(start) :]:
            stop = self._reach(id)
            print("\n".join(self._described(stop)), flush=True)
            if prompt:
                _prompt(stop.names)
            if not step or not _goes_on(stop.names):
                return
            prompt = False

    def _reach(self, id: str) -> _Stop:
        """Executes the stage that emitted a message up to it. Of devices, which are not executed, there is no stage."""
        step, recorded = self._causes.step_of(id), self._recording.envelope(id)
        node = self._graph.nodes.get(MessageId.of(id).stage)
        names: dict[str, Any] = {"stage": None, "message": None, "arrivals": {}, "recording": self._recording}
        if node is None or node.type.cls.device or step is None:
            why = "taken from the recording: " + ("no step of it is journalled" if step is None else "a device")
            return _Stop(recorded, step, {**names, "message": opened(self._graph, recorded)}, [why])
        names["stage"], executions = self._process_of(step)
        execution = next((done for done in executions if _reached(done, step, id)), Execution(step))
        names["arrivals"] = arguments_of(execution.arrivals)
        sealed = next((sealed for sealed in execution.emitted if sealed.id == id), None)
        names["message"] = opened(self._graph, sealed) if sealed else None
        notes = [*self._notes(execution, step, recorded, sealed), *self._log]
        return _Stop(sealed or recorded, execution.step, names, notes)

    def _process_of(self, step: Step) -> tuple[Stage, Iterator[Execution]]:
        """The process that took a step, as far as it has been executed again."""
        node = self._graph.nodes[step.stage]
        stateful = node.type.cls.stateful
        process = step.process._replace(incarnation=0) if stateful else step.process
        if process not in self._processes:
            steps = steps_of(self._recording, Task(step.stage, step.incarnation), node)
            if step.stage in replicated(self._recording.graph):
                own = (one for one in steps if one.process == process)
                steps = sorted(own, key=lambda one: one.number)
            files = Path(tempfile.mkdtemp(dir=self._folder))
            again = Reexecution(self._recording, node, steps, seed=self._graph.seed, directory=files, log=self._hear)
            self._processes[process] = again.stage, self._executions(again, steps)
        return self._processes[process]

    def _executions(self, again: Reexecution, steps: Sequence[Step]) -> Iterator[Execution]:
        """All steps of a process, message by message; the log is that of the step at hand."""
        for step in steps:
            self._log.clear()
            yield from again.take(step)

    def _hear(self, text: str, level: str) -> None:
        self._log.append(f"{level} of the stage: {text}")

    def _notes(self, done: Execution, step: Step, recorded: Envelope, sealed: Envelope | None) -> Iterator[str]:
        """What became of a message that was recorded as one of ``step``."""
        if done.step is not step:
            yield f"recorded in another: {_place(step)}"
        if done.refused or done.error:
            yield done.refused or f"the handler raised {done.error}"
        if sealed is None:
            yield "recorded, and not emitted in the replay"
            return
        kind = kind_of(self._graph, sealed.id)
        assert kind is not None  # It has just been emitted.
        if (other := what_differs(recorded, sealed, kind)) is None:
            yield "executed again: identical to the recording"
        else:
            found = [str(difference) for difference in envelope_differences(recorded, other, HEADER, kind)]
            yield f"executed again: {len(found)} fields differ from the recording"
            yield from found[:DIFFERENCES]

    def _described(self, stop: _Stop) -> Iterator[str]:
        """A message, what became of it, and its causes, as lines."""
        id, step, message = stop.sealed.id, stop.step, stop.names["message"]
        yield f"{id}  {stop.sealed.type}, of {stop.sealed.lineage}"
        if step is not None:
            yield f"  {_place(step)}"
        yield from (f"  {note}" for note in stop.notes)
        fields = message.__struct_fields__ if message is not None else ()
        yield from (f"    {name} = {brief(getattr(message, name))}" for name in fields)
        if step is not None and step.consumed:
            tree = f" (the whole tree: runner why {id} {self._recording.path})"
            yield f"  causes{tree if step is self._causes.step_of(id) else ''}"
            known = self._recording.messages
            rows = [(port, id, known[id].type if id in known else "not recorded") for port, id in step.consumed]
            yield from (f"    {line}" for line in table(("port", "id", "type"), rows)[1:])


def _place(step: Step) -> str:
    return f"step {step.number} of {process_of(step)}, {step.handler}"


def _prompt(names: dict[str, Any]) -> None:
    """A Python prompt; its end goes on."""
    with suppress(ImportError):
        importlib.import_module("readline")  # line editing for people
    with suppress(SystemExit):
        code.interact(f"{', '.join(names)} are here; Ctrl-D goes on", local=dict(names), exitmsg="")


def _goes_on(names: dict[str, Any]) -> bool:
    while True:
        try:
            answer = input(PROMPT).strip()
        except EOFError:
            return False
        if answer != "p":
            return answer != "q"
        _prompt(names)


def _reached(done: Execution, step: Step, id: str) -> bool:
    """True at the message, and at the end of its step where the message did not come."""
    at_message = bool(done.emitted) and done.emitted[-1].id == id
    return at_message or (done.step is step and done.ended)


def brief(value: Any) -> str:
    """A value in one line."""
    if isinstance(value, np.ndarray):
        return array_text(value)
    if isinstance(value, list | tuple) and value and isinstance(value[0], msgspec.Struct | np.ndarray):
        return f"{len(value)} x {clipped(brief(value[0]), SHOWN)}"
    if isinstance(value, msgspec.Struct):
        fields = (f"{name}={brief(getattr(value, name))}" for name in value.__struct_fields__)
        return clipped(f"{type(value).__name__}({', '.join(fields)})", SHOWN)
    return clipped(repr(value), SHOWN)
