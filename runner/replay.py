"""Executes the stages of a recording again from what they consumed and compares every message they emitted.

Devices are not executed: what they emitted is taken from the recording. Each task, one stage's process as it
lived, runs in a fresh process of its own.
"""

from __future__ import annotations

import itertools
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec

from runner.children import die_with_parent, ending, last_lines, spawn
from runner.codec import CodecError, Envelope, Step, decode, pack
from runner.compare import differences
from runner.contract import Message, Refused
from runner.document import Document
from runner.graph import Graph, Node, graph_from_json, node_entry, node_from_entry
from runner.info import seconds, table
from runner.ports import Handler
from runner.provenance import machine, package_versions, revision
from runner.recording import Recording, replicated, split_id, topic_of
from runner.step import Arrival, Executor, receive, step_time

WORKERS = 2
"""Processes that replay at the same time."""
HEADER = tuple(name for name in Envelope.__struct_fields__ if name != "body")
Say = Callable[[str], None]


class Divergence(msgspec.Struct, frozen=True):
    """A difference between the recording and the replay."""

    position: int
    """Of the message in the recording: the lowest comes first."""
    stage: str
    replica: int
    incarnation: int
    step: int
    message: str
    """Id, or what was expected in its place."""
    difference: str

    def __str__(self) -> str:
        process = f"{self.stage}[{self.replica}]" + (f" after restart {self.incarnation}" if self.incarnation else "")
        return f"stage {process}, step {self.step}, message {self.message}: {self.difference}"


class Task(msgspec.Struct, frozen=True):
    """What one process executes again: one incarnation of a stage, or a share of a replicated stage's steps."""

    path: str
    stage: str
    entry: dict[str, Any]
    """The stage's part of the graph, with the settings of this replay applied."""
    seed: int
    incarnation: int
    share: int = 0
    shares: int = 1


class Result(msgspec.Struct, frozen=True):
    """How a task ended."""

    stage: str
    steps: int = 0
    messages: int = 0
    seconds: float = 0.0
    """Time inside handlers."""
    diverged: int = 0
    first: Divergence | None = None
    failure: str = ""
    """Why the stage could not be executed at all."""


def replay(
    path: Path, *, verify: bool, assignments: Sequence[str] = (), workers: int = WORKERS, say: Say = print
) -> int:
    """Replays a recording and returns the exit status: 0 where every message is identical.

    Without ``verify`` only says what a replay would execute. ``assignments`` change settings, for example
    the place of a file that has moved. Raises Refused where the file is no recording.
    """
    recording = Recording(path)
    graph = graph_from_json(_with_settings(recording, assignments), str(path))
    say(f"{path}: {recording.verdict}")
    if not verify:
        _say_plan(recording, graph, say)
        return 0
    _say_changes(recording, say)
    results = _run_all(_tasks(recording, graph, workers), workers, say)
    return _conclude(recording, graph, results, say)


def _with_settings(recording: Recording, assignments: Sequence[str]) -> str:
    document = Document(str(recording.path), Path.cwd(), recording.graph)
    for assignment in assignments:
        document.set(assignment)
    return json.dumps(document.values)


# ------------------------------------------------------------------------------------ planning


def _executed(graph: Graph) -> list[Node]:
    return [node for node in graph.nodes.values() if not node.type.cls.device]


def _tasks(recording: Recording, graph: Graph, workers: int) -> list[Task]:
    """Longest first, so that the workers end together."""
    cost: dict[tuple[str, int], int] = defaultdict(int)
    shared = replicated(recording.graph)
    names = {node.name for node in _executed(graph)}
    for step in recording.steps:
        if step.stage in names:
            cost[step.stage, 0 if step.stage in shared else step.incarnation] += step.computed_ns
    tasks: list[Task] = []
    for stage, incarnation in sorted(cost, key=lambda key: -cost[key]):
        shares = workers if stage in shared else 1
        entry = node_entry(graph.nodes[stage])
        tasks += [Task(str(recording.path), stage, entry, graph.seed, incarnation, i, shares) for i in range(shares)]
    return tasks


def _say_plan(recording: Recording, graph: Graph, say: Say) -> None:
    executed = {node.name for node in _executed(graph)}
    rows: list[tuple[str, ...]] = []
    for name in graph.nodes:
        steps = [step for step in recording.steps if step.stage == name]
        plan = "executed again" if name in executed else "device: its messages are taken from the recording"
        rows.append((name, plan, str(len(steps)), seconds(sum(step.computed_ns for step in steps))))
    for line in table(("stage", "in a replay", "steps", "computed"), rows):
        say(line)


def _say_changes(recording: Recording, say: Say) -> None:
    """Names what may explain a difference: other source, other packages, another machine."""
    then = recording.aspect("packages", dict[str, str]())
    now = package_versions()
    changed = [f"{name} {then[name]} -> {now.get(name, 'absent')}" for name in then if now.get(name) != then[name]]
    before = recording.aspect("machine", dict[str, str]())
    changed += [
        f"{key} {before[key]} -> {value}" for key, value in machine().items() if before.get(key, value) != value
    ]
    source = recording.run.get("revision", "")
    changed += [f"source {source or 'unknown'} -> {revision()}"] if source != revision() else []
    if changed:
        say(f"changed since the recording: {'; '.join(changed)}")


# ------------------------------------------------------------------------------------ running


def _run_all(tasks: Sequence[Task], workers: int, say: Say) -> list[Result]:
    def run(task: Task) -> Result:
        result = _run_in_process(task)
        share = f" ({task.share + 1} of {task.shares})" if task.shares > 1 else ""
        restart = f" after restart {task.incarnation}" if task.incarnation else ""
        say(f"{result.stage}{restart}{share}: {_outcome(result)}")
        return result

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(run, tasks))


def _run_in_process(task: Task) -> Result:
    with tempfile.TemporaryDirectory() as folder:
        answer, log = Path(folder) / "result", Path(folder) / "log"
        child = spawn("runner.replay", task=msgspec.json.encode((task, str(answer))), log=log)
        try:
            code = child.wait()
        finally:
            child.kill()
        if not answer.exists():
            return Result(task.stage, failure=": ".join([f"its process {ending(code)}", *last_lines(log, 1)]))
        return msgspec.json.decode(answer.read_bytes(), type=Result)


def _outcome(result: Result) -> str:
    if result.failure:
        return f"could not be executed: {result.failure}"
    counts = f"{result.steps} steps, {result.messages} messages, {result.seconds:.2f} s"
    return f"{counts}, {f'{result.diverged} DIVERGED' if result.diverged else 'identical'}"


def _conclude(recording: Recording, graph: Graph, results: Sequence[Result], say: Say) -> int:
    found = sorted((result.first for result in results if result.first), key=lambda found: found.position)
    if found:
        say(f"DIVERGED first at {found[0]}")
    compared = sum(result.messages for result in results)
    expected = _emitted_by([node.name for node in _executed(graph)], recording)
    bad = bool(found) or any(result.failure for result in results) or not recording.verdict.complete
    if not bad:
        say(f"IDENTICAL: {compared} messages of {len(_executed(graph))} stages")
    elif not found:
        say(f"NOT VERIFIED: {compared} of {expected} messages compared, none differs; {recording.verdict}")
    return int(bad)


def _emitted_by(stages: Sequence[str], recording: Recording) -> int:
    return sum(message.topic.partition("/")[0] in stages for message in recording.messages.values())


# ------------------------------------------------------------------------------------ one task


class Replayer:
    """Executes the steps of one task and compares what they emit."""

    def __init__(self, task: Task, directory: Path) -> None:
        """Constructs the stage; raises Refused where that fails."""
        self._recording = Recording(Path(task.path))
        self._node = node_from_entry(task.stage, task.entry)
        self._steps = _steps_of(self._recording, task)
        self._positions = {id: position for position, id in enumerate(self._recording.messages)}
        self._stage = self._node.construct()
        numbers = _first_numbers(self._steps)
        self._executor = Executor(
            self._node, self._stage, seed=task.seed, directory=directory, log=lambda *_: None, numbers=numbers
        )
        self._seconds = 0.0
        self._messages = 0

    def run(self) -> Result:
        """Executes every step, in the order of the journal."""
        found = [divergence for step in self._steps for divergence in self._differences(step)]
        self._stage.close()
        first = min(found, key=lambda divergence: divergence.position, default=None)
        name = self._node.name
        return Result(name, len(self._steps), self._messages, self._seconds, len(found), first)

    def _differences(self, step: Step) -> Iterator[Divergence]:
        """One per message that differs."""
        handler = next((handler for handler in self._node.type.handlers if handler.name == step.handler), None)
        if handler is None:
            yield self._divergence(step, step.handler, "the stage has no such handler any more")
            return
        try:
            arrivals = self._arrivals(step)
        except (CodecError, KeyError) as error:
            yield self._divergence(step, step.emitted[0] if step.emitted else "-", _input_error(error))
            return
        replayed, error = self._execute(step, handler, arrivals)
        yield from self._compared(step, replayed)
        if step.outcome != "stopped" and not (step.error.startswith(error) if error else not step.error):
            text = f"recorded {step.error or 'no error'!r}, replayed {error or 'no error'!r}"
            yield self._divergence(step, "-", f"error: {text}")

    def _arrivals(self, step: Step) -> list[Arrival]:
        ports = self._node.type.inputs
        arrivals: list[Arrival] = []
        for port, id in step.consumed:
            try:
                arrivals.append(receive(ports[port], self._recording.envelope(id)))
            except CodecError as error:
                raise CodecError(f"input {id}: {error.type}", error.field, error.reason) from None
        return arrivals

    def _execute(self, step: Step, handler: Handler, arrivals: list[Arrival]) -> tuple[list[Envelope], str]:
        time_ns = step_time(self._node, arrivals, step.time_ns)
        wanted = len(step.emitted) if step.outcome == "stopped" else None
        replayed: list[Envelope] = []
        began = time.perf_counter()
        try:
            for sealed in itertools.islice(self._executor.run(handler, arrivals, time_ns), wanted):
                replayed.append(sealed)
        except Exception as error:
            return replayed, f"{type(error).__name__}: {error}"
        finally:
            self._seconds += time.perf_counter() - began
        return replayed, ""

    def _compared(self, step: Step, replayed: list[Envelope]) -> Iterator[Divergence]:
        for id, sealed in itertools.zip_longest(step.emitted, replayed):
            if id is None:
                yield self._divergence(step, sealed.id, "emitted in the replay only")
            elif sealed is None:
                yield self._divergence(step, id, "recorded, and not emitted in the replay")
            elif id in self._recording.messages:
                self._messages += 1
                text = _difference(self._kind(id), self._recording.envelope(id), sealed)
                if text:
                    yield self._divergence(step, id, text)

    def _kind(self, id: str) -> type[Message] | None:
        return self._node.type.outputs.get(topic_of(id).partition("/")[2])

    def _divergence(self, step: Step, message: str, difference: str) -> Divergence:
        position = self._positions.get(message, len(self._positions))
        return Divergence(position, step.stage, step.replica, step.incarnation, step.number, message, difference)


def _steps_of(recording: Recording, task: Task) -> list[Step]:
    steps = [step for step in recording.steps if step.stage == task.stage]
    if task.stage in replicated(recording.graph):
        return steps[task.share :: task.shares]
    return sorted((step for step in steps if step.incarnation == task.incarnation), key=lambda step: step.number)


def _first_numbers(steps: Sequence[Step]) -> dict[str, int]:
    """Where the sequence of each port went on in this incarnation."""
    numbers: dict[str, int] = {}
    for id in (id for step in steps for id in step.emitted):
        numbers.setdefault(topic_of(id).partition("/")[2], split_id(id)[1])
    return numbers


def _input_error(error: CodecError | KeyError) -> str:
    if isinstance(error, CodecError):
        return f"it cannot be executed: {error}"
    return f"it cannot be executed: {error.args[0]} is not recorded"


def _difference(kind: type[Message] | None, recorded: Envelope, replayed: Envelope) -> str:
    """Where two messages differ, or nothing where every byte is the same."""
    if pack(recorded) == pack(replayed):
        return ""
    headers = (differences(getattr(recorded, name), getattr(replayed, name), name) for name in HEADER)
    found = next(itertools.chain.from_iterable(headers), None)
    if found is None and kind is not None:
        try:
            found = next(differences(decode(kind, recorded.body), decode(kind, replayed.body)), None)
        except CodecError as error:
            return f"the recorded message cannot be read: {error}"
    return str(found or "the same values in other bytes")


def _work(task: Task) -> Result:
    with tempfile.TemporaryDirectory() as folder:
        try:
            return Replayer(task, Path(folder)).run()
        except Refused as error:
            return Result(task.stage, failure=str(error))


def main() -> None:
    """Executes the task on stdin and writes its result to the file named there too."""
    die_with_parent()
    task, answer = msgspec.json.decode(sys.stdin.buffer.read(), type=tuple[Task, str])
    Path(answer).write_bytes(msgspec.json.encode(_work(task)))


if __name__ == "__main__":
    main()
