"""Tests for who writes stages: one stage in this process, or a whole graph as ``runner up`` runs it."""

from __future__ import annotations

import contextlib
import itertools
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from runner.contract import Level, Message, Refused, Stage, name_of
from runner.graph.document import suggest
from runner.graph.graph import Edge, Node
from runner.graph.ports import Handler, StageType, inspect_stage, port_name
from runner.message import codec
from runner.message.codec import Envelope, open_envelope
from runner.message.ids import MessageId
from runner.process.inbox import Inbox
from runner.process.step import Arrival, Executor, Log, receive, step_time
from runner.recording.recording import Recording

M = TypeVar("M", bound=Message)
Given = Message | Mapping[str, Message | Sequence[Message]]
"""What arrives with a lineage of its own: a message, for the port of its type, or all that a step takes by port, the
parts of a gather in a list."""
PERIOD_NS = 1_000_000_000
PATIENCE_SECONDS = 120.0
GRACE_SECONDS = 10.0
"""For a graph that takes too long to end in order."""


# ---------------------------------------------------------------------------------------------- one stage


def run_stage(
    stage: Stage,
    given: Iterable[Given] = (),
    *,
    seed: int = 0,
    name: str | None = None,
    times_ns: Sequence[int] | None = None,
    folder: Path | None = None,
    log: Log | None = None,
    limit: int | None = None,
) -> list[Any]:
    """What a stage emits, in order: at its start, for what is given, and from its source where it has one.

    Steps, joins, gathers, checks of messages and contexts are those of a run. Raises what a handler raises, CodecError
    for a message that breaks its class, and Refused for one that fits no port.

    ``seed`` and ``name`` are the graph's seed and the stage's name there (by default that of its class in snake case):
    random numbers depend on both. ``times_ns`` are logical times of what is given; without, they are a second apart.
    ``folder`` is the context's directory; without, one that is gone afterwards. ``log`` takes what the stage says;
    without, it is printed. ``limit`` is how many messages are wanted, of a source that never ends.
    """
    node, say = node_of(stage, name), log or _show
    inbox, outputs = Inbox(node), node.type.outputs
    with contextlib.ExitStack() as stack:
        directory = folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        executor = Executor(node, stage, seed=seed, directory=directory, log=say)
        emitted = itertools.islice(_emitted(node, inbox, executor, given, times_ns), limit)
        messages = [open_envelope(outputs[MessageId.of(sealed.id).port], sealed) for sealed in emitted]
        for handler, lineage, lacking in inbox.incomplete():
            say(f"{handler.name} of {lineage} still lacks {', '.join(lacking)}", "debug")
        return messages


def node_of(stage: Stage, name: str | None = None) -> Node:
    """A stage as a graph would have it, with its ports open."""
    cls = type(stage)
    kind = inspect_stage(cls)
    edges = {port: Edge(f"given.{port}") for port in kind.inputs}
    return Node(name or port_name(cls), f"{cls.__module__}:{cls.__qualname__}", kind, None, edges, 1, 0)


def _emitted(
    node: Node, inbox: Inbox, executor: Executor, given: Iterable[Given], times_ns: Sequence[int] | None
) -> Iterator[Envelope]:
    """What the stage emits, without bus, journal or recording: a step is over before its first message is here."""

    def step(handler: Handler, arrivals: Sequence[Arrival] = ()) -> list[Envelope]:
        return list(executor.run(handler, arrivals, step_time(node, arrivals, time.time_ns())))

    for handler in node.type.handlers:
        if not handler.inputs:
            yield from step(handler)
    numbers = Counter[str]()
    times = itertools.count(0, PERIOD_NS) if times_ns is None else times_ns
    for item, (one, time_ns) in enumerate(zip(given, times, strict=times_ns is not None)):
        for port, message in _by_port(node.type, one):
            id, lineage = f"given.{port}#{numbers[port]}", f"given.item#{item}"
            numbers[port] += 1
            sealed = codec.envelope(message, id=id, lineage=lineage, time_ns=time_ns, causes=())
            inbox.add(receive(node.type.inputs[port], sealed))
            while (ready := inbox.pop()) is not None:
                yield from step(ready.handler, ready.arrivals)
    if (source := node.type.source) is not None:
        yield from (draft.envelope for draft in executor.advance(source, time.time_ns) if draft is not None)


def _by_port(kind: StageType, one: Given) -> Iterator[tuple[str, Message]]:
    if isinstance(one, Message):
        yield _only_port(kind, type(one)), one
        return
    for port, value in one.items():
        if port not in kind.inputs:
            raise Refused(f"{kind.cls.__name__} has no input {port!r}{suggest(port, kind.inputs)}")
        for message in [value] if isinstance(value, Message) else value:
            yield port, message


def _only_port(kind: StageType, given: type[Message]) -> str:
    ports = [port.name for port in kind.inputs.values() if port.type is given]
    if len(ports) != 1:
        inputs = ", ".join(f"{port.name} ({port.type.__name__})" for port in kind.inputs.values()) or "none"
        fits = f"fits {' and '.join(ports)}: name one, {{'{ports[0]}': ...}}" if ports else "fits no input"
        raise Refused(f"{kind.cls.__name__}: a {given.__name__} {fits}; inputs: {inputs}")
    return ports[0]


def _show(text: str, level: Level) -> None:
    print(f"{level:<8} {text}")


# ---------------------------------------------------------------------------------------------- a whole graph


@dataclass(frozen=True)
class Run:
    """A graph that has run."""

    code: int
    """Exit status of ``runner up``: 0 as wanted, 1 failed, 2 refused, 3 recording INCOMPLETE."""
    output: str
    """All that it printed."""
    folder: Path
    """Of its recording."""

    @property
    def recording(self) -> Path:
        """The file that was recorded; raises LookupError where there is none or several."""
        found = sorted(self.folder.glob("*.mcap"))
        if not found:
            raise LookupError(f"{self.folder}: no recording; it printed:\n{self.output}")
        if len(found) > 1:
            names = ", ".join(path.name for path in found)
            raise LookupError(f"{self.folder}: several recordings, {names}; valid: a folder for each run")
        return found[0]

    def messages(self, kind: type[M]) -> list[M]:
        """Every recorded message of a class, by port and number."""
        recording = Recording(self.recording)
        ids = (id for id, message in recording.messages.items() if message.type == name_of(kind))
        return [open_envelope(kind, recording.envelope(id)) for id in sorted(ids, key=MessageId.of)]


def run_graph(
    graph: Path | str, *settings: str, folder: Path, seconds: float = PATIENCE_SECONDS, options: Sequence[str] = ()
) -> Run:
    """Runs a graph with ``runner up`` in a process of its own and returns how it ended.

    ``graph`` is a file, or as a string the text of one; ``settings`` are ``stage.key=value``, ``options`` further
    options of ``runner up``. The recording lands in ``folder``. Raises TimeoutError, with all that was printed, where
    the graph takes longer than ``seconds``; it is ended then.
    """
    return finish(start_graph(graph, *settings, folder=folder, options=options), folder, seconds=seconds)


def start_graph(graph: Path | str, *settings: str, folder: Path, options: Sequence[str] = ()) -> subprocess.Popen[str]:
    """Starts what :func:`run_graph` runs, for tests that meddle with it; :func:`finish` waits for its end."""
    if isinstance(graph, str):
        path = folder / "graph.yaml"
        path.write_text(graph)
        graph = path
    changes = [part for setting in settings for part in ("--set", setting)]
    return runner("up", str(graph), "--recordings", str(folder), *changes, *options)


def runner(*arguments: str) -> subprocess.Popen[str]:
    """A command of the runner, started; what it prints comes in a pipe, and it imports what can be imported here."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-m", "runner.cli", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


def read_until(process: subprocess.Popen[str], text: str, *, seconds: float = PATIENCE_SECONDS) -> str:
    """What a graph prints up to the line that contains a text, for example ``processes are ready``.

    Raises TimeoutError, with all that was printed, where it ends or ``seconds`` pass without; it is ended then.
    """
    assert process.stdout is not None
    seen = ""
    limit = threading.Timer(seconds, process.kill)
    limit.start()
    try:
        for line in process.stdout:
            seen += line
            if text in line:
                return seen
    finally:
        limit.cancel()
    process.communicate()
    raise TimeoutError(f"{text!r} never appeared; it printed:\n{seen}")


def finish(process: subprocess.Popen[str], folder: Path, *, before: str = "", seconds: float = PATIENCE_SECONDS) -> Run:
    """Waits for the end of a graph; ``before`` is what was read of its output already."""
    try:
        output, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        output = before + _ended(process)
        raise TimeoutError(f"the graph took longer than {seconds:g} s; it printed:\n{output}") from None
    finally:
        process.kill()
    return Run(process.returncode, before + output, folder)


def _ended(process: subprocess.Popen[str]) -> str:
    """Ends a graph, in order if it can, and returns what it printed."""
    process.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        return process.communicate(timeout=GRACE_SECONDS)[0]
    process.kill()
    return process.communicate()[0]
