"""Executes some stages of a recording again while all others stay as recorded; joins and gathers are made anew.

Every stage executes in a process of its own. What happens does not depend on which of them is faster: a stage takes
the steps that its journal names in their order, and where it waits for one that will not come any more, everything
stands still before the oldest step that could run is taken instead.
"""

from __future__ import annotations

import heapq
import itertools
from collections import Counter, defaultdict, deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import cast

import msgspec

from runner.contract import Part, Refused
from runner.graph.graph import Edge, Graph, Node
from runner.message.codec import CodecError, Envelope, Step, decode_untyped, spelled_out
from runner.message.ids import MessageId
from runner.message.packet import Process
from runner.process.inbox import Inbox, Mismatched, Ready
from runner.process.step import Arrival, Executor, receive, step_time
from runner.recording.recording import Recording, replicated
from runner.replay.tasks import failed_so
from runner.replay.workers import Worker

AHEAD = 16
"""Recorded messages that are delivered while steps run; more would only wait in memory."""
END = b""
"""A request that is the last: the stage is closed."""
Key = tuple[str, str, str, int]
"""A step by what it is, whatever it consumes: stage, handler, lineage, and how many such steps come before it; of those
that come in any order, the sequence of what drives it."""


class Request(msgspec.Struct, frozen=True):
    """A step that a stage's process is to take."""

    handler: str
    inputs: tuple[tuple[str, Envelope], ...]
    """By port."""
    time_ns: int
    most: int | None = None
    """Messages after which the handler is stopped, as it was when the graph ended."""


class Answer(msgspec.Struct, frozen=True):
    """What came of it."""

    emitted: tuple[Envelope, ...] = ()
    error: str = ""


def serve(node: Node, seed: int, directory: Path, connection: Connection) -> None:
    """Runs one stage in this process; every request on the connection is a step."""
    try:
        stage = node.construct()
    except Refused as refusal:
        connection.send_bytes(msgspec.msgpack.encode(Answer(error=str(refusal))))
        return
    executor = Executor(node, stage, seed=seed, directory=directory, log=lambda *_: None)
    connection.send_bytes(msgspec.msgpack.encode(Answer()))
    while (request := connection.recv_bytes()) != END:
        answer = _answer(node, executor, msgspec.msgpack.decode(request, type=Request))
        connection.send_bytes(msgspec.msgpack.encode(answer))
    stage.close()


def _answer(node: Node, executor: Executor, request: Request) -> Answer:
    emitted, error = list[Envelope](), ""
    handler = next(handler for handler in node.type.handlers if handler.name == request.handler)
    try:
        arrivals = [receive(node.type.inputs[port], sealed) for port, sealed in request.inputs]
        emitted += itertools.islice(executor.run(handler, arrivals, request.time_ns), request.most)
    except BaseException as problem:  # as in a run, where also who calls sys.exit() has failed
        error = spelled_out(f"{type(problem).__name__}: {problem}")
    return Answer(tuple(emitted), error)


@dataclass(slots=True)
class _Stage:
    """One executed stage, as the scheduler sees it."""

    node: Node
    inbox: Inbox
    expected: deque[Key]
    """The recorded steps that are still to come, in order."""
    unordered: Mapping[tuple[str, str], str]
    """The ports that drive steps which come in any order, by stage and handler."""
    idle: list[Worker] = field(default_factory=list[Worker])
    ready: dict[Key, Ready] = field(default_factory=dict[Key, Ready])
    counts: Counter[tuple[str, str]] = field(default_factory=Counter[tuple[str, str]])
    """Steps that became ready, by handler and lineage."""

    def add(self, ready: Ready) -> None:
        """Takes a step that can run."""
        lineage = ready.arrivals[0].envelope.lineage if ready.arrivals else ""
        place = (ready.handler.name, lineage)
        consumed = ((arrival.port.name, arrival.envelope.id) for arrival in ready.arrivals)
        driven = _sequence(consumed, self.unordered.get((self.node.name, ready.handler.name)))
        self.ready[self.node.name, *place, self.counts[place] if driven is None else driven] = ready
        self.counts[place] += 1

    def permitted(self) -> Key | None:
        """The step to take now: the next of the journal; replicas have no memory and take any."""
        if not self.idle or not self.ready:
            return None
        if self.node.replicated:
            return next(iter(self.ready))
        return self.expected[0] if self.expected and self.expected[0] in self.ready else None

    def take(self, key: Key) -> tuple[Ready, Worker]:
        """Hands a step to a process; recorded ones before it will not be waited for any more."""
        if not self.node.replicated and key in self.expected:
            while self.expected.popleft() != key:
                pass
        return self.ready.pop(key), self.idle.pop()


class PartialReplay:
    """The executed part of a graph, between what is recorded and what is compared."""

    def __init__(
        self,
        recording: Recording,
        graph: Graph,
        names: Collection[str],
        *,
        changed: Collection[str],
        workers: int,
        folder: Path,
    ):
        """Starts the processes of all ``names``, of which those ``changed`` are not as recorded; raises Refused where a
        stage cannot be constructed."""
        self.emitted: dict[str, Envelope] = {}
        """By id, in the order of emission."""
        self.errors: list[str] = []
        self._recording = recording
        self._graph = graph
        self._workers = workers
        self._unordered = _unordered(recording, graph)
        # A stage that was changed may go on where it failed.
        lost = {name: processes for name, processes in _lost(recording).items() if name not in changed}
        self._journal = _journal(recording, self._unordered, {one for each in lost.values() for one in each})
        self._ranks = {key: rank for rank, key in enumerate(self._journal)}
        self._consumed = {(step.stage, port, id) for step in self._journal.values() for port, id in step.consumed}
        left = {(end.stage, port, id) for end in recording.ends for port, id in end.left}
        self._left = (left | _arrived(recording, graph, lost)) - self._consumed
        """What had come when the graph ended, or the stage was lost, and no step had taken."""
        emitted = {id for step in recording.steps for id in step.emitted}
        self.unexplained = {id for id in recording.messages if MessageId.of(id).stage in lost} - emitted
        """What a process sent that was killed in the midst of a step."""
        self.frozen = Frozen(recording, names, self.unexplained)
        self._ahead = 0
        self._running: dict[Connection, tuple[_Stage, Key, Worker]] = {}
        self._processes: list[Worker] = []
        self._stages = {name: self._start(graph.nodes[name], folder) for name in graph.nodes if name in names}

    def run(self) -> None:
        """Executes until nothing is left to do, and leaves no process behind."""
        try:
            for child in self._processes:
                if error := _answer_of(child, child.log.stem).error:
                    raise Refused(error)
            while self._advance():
                pass
            for child in self._processes:
                child.send(END)
            for child in self._processes:
                child.end()
        finally:
            for child in self._processes:
                child.kill()

    # ------------------------------------------------------------------------------------ processes

    def _start(self, node: Node, folder: Path) -> _Stage:
        node = replace(node, inputs={port: Edge(edge.source, queue=edge.queue) for port, edge in node.inputs.items()})
        files = folder / node.name
        files.mkdir()
        node.prepare()
        stage = _Stage(node, Inbox(node), deque(self._expected(node)), self._unordered)
        for _ in range(self._workers if node.replicated else 1):
            log = folder / f"{node.name}-{len(self._processes)}.txt"
            stage.idle.append(Worker(lambda connection: serve(node, self._graph.seed, files, connection), log))
            self._processes.append(stage.idle[-1])
        for handler in node.type.handlers:
            if not handler.inputs:
                stage.add(Ready(handler, ()))
        return stage

    def _expected(self, node: Node) -> list[Key]:
        """The recorded steps of a stage, in order: the journal's, or where replicas shared them, that of the looks."""
        keys = [key for key in self._ranks if key[0] == node.name]
        if node.name not in replicated(self._recording.graph):
            return keys
        place = {handler.name: index for index, handler in enumerate(node.type.handlers)}
        return sorted(keys, key=lambda key: (MessageId.of(key[2]), place.get(key[1], len(place)), key[3]))

    # ------------------------------------------------------------------------------------ scheduling

    def _advance(self) -> bool:
        """Takes one action; False where there is none left."""
        if len(self._running) < self._workers:
            for stage in self._stages.values():
                key = stage.permitted()
                if key is not None:
                    self._dispatch(stage, key)
                    return True
            waiting = sum(len(stage.ready) for stage in self._stages.values())
            ahead = max(self._ahead, waiting) if self._running else 0
            if ahead < AHEAD and (sealed := self.frozen.next()) is not None:
                self._ahead += bool(self._running)
                self._deliver(sealed)
                return True
        if self._running:
            self._collect()
            return True
        return self._force()

    def _force(self) -> bool:
        """Takes the oldest step that could run though others were recorded before it: those will not come."""
        keys = [key for stage in self._stages.values() for key in stage.ready]
        if keys:
            key = min(keys, key=self._rank)
            self._dispatch(self._stages[key[0]], key)
        return bool(keys)

    def _rank(self, key: Key) -> tuple[int, MessageId, Key]:
        """Where a step stands in the recording; new ones come last, by lineage."""
        return self._ranks.get(key, len(self._ranks)), MessageId.of(key[2]), key

    def _dispatch(self, stage: _Stage, key: Key) -> None:
        ready, child = stage.take(key)
        inputs = tuple((arrival.port.name, arrival.envelope) for arrival in ready.arrivals)
        step = self._journal.get(key)
        time_ns = step_time(stage.node, ready.arrivals, step.time_ns if step else 0)
        most = len(step.emitted) if step and step.outcome == "stopped" else None
        child.send(msgspec.msgpack.encode(Request(ready.handler.name, inputs, time_ns, most)))
        self._running[child.connection] = (stage, key, child)

    def _collect(self) -> None:
        stage, key, child = self._running.pop(cast("Connection", wait(list(self._running))[0]))
        name = f"{key[0]}.{key[1]} of {key[2] or 'the start'}"
        answer = _answer_of(child, name)
        self._ahead = 0
        stage.idle.append(child)
        step = self._journal.get(key)
        if answer.error and (step is None or not failed_so(step, answer.error)):
            self.errors.append(f"{name}: {answer.error}")
        for sealed in answer.emitted:
            self.emitted[sealed.id] = sealed
            self.frozen.note(sealed.id)
            self._deliver(sealed)

    def _deliver(self, sealed: Envelope) -> None:
        id, recorded = MessageId.of(sealed.id), sealed.id in self._recording.messages
        for route in self._graph.routes(id.stage):
            stage = self._stages.get(route.consumer)
            if route.output != id.port or stage is None:
                continue
            if recorded and route.policy == "latest" and (route.consumer, route.input, sealed.id) not in self._consumed:
                continue  # a newer one replaced it
            self._add(stage, route.input, sealed)

    def _add(self, stage: _Stage, port: str, sealed: Envelope) -> None:
        try:
            stage.inbox.add(receive(stage.node.type.inputs[port], sealed))
        except (CodecError, Mismatched) as error:
            self.errors.append(f"{stage.node.name}.{port}: {sealed.id} refused: {error}")
        while ready := stage.inbox.pop():
            if not self._was_left(stage.node, ready):
                stage.add(ready)

    def _was_left(self, node: Node, ready: Ready) -> bool:
        """Whether a step could have run in the recorded run, too, which ended before."""
        left = any((node.name, arrival.port.name, arrival.envelope.id) in self._left for arrival in ready.arrivals)
        return left and all(map(self._was_there, ready.arrivals))

    def _was_there(self, arrival: Arrival) -> bool:
        """Whether a message was recorded as one of the same lineage and, where it is gathered, of as many."""
        recorded = self._recording.messages.get(arrival.envelope.id)
        if recorded is None or recorded.lineage != arrival.envelope.lineage:
            return False
        if arrival.port.kind == "one":
            return True
        then = decode_untyped(self._recording.envelope(recorded.id).body)
        return then.get("count") == cast("Part", arrival.message).count


def _answer_of(child: Worker, what: str) -> Answer:
    """What a process sends next; raises Refused where it has ended instead, naming ``what`` it was to do."""
    try:
        return msgspec.msgpack.decode(child.connection.recv_bytes(), type=Answer)
    except (EOFError, ConnectionResetError):
        raise Refused(f"{what}: {child.end()}") from None


class Frozen:
    """The messages that stay as recorded: each comes once all that it answers has come."""

    def __init__(self, recording: Recording, names: Collection[str], others: Collection[str]) -> None:
        """Those of all stages but ``names``, and ``others`` by their ids."""
        self.came: set[str] = set()
        """Ids of all that has come, recorded or new."""
        self._recording = recording
        self._positions = {id: position for position, id in enumerate(recording.messages)}
        frozen = (id for id in recording.messages if id in others or MessageId.of(id).stage not in names)
        self._free = [(self._positions[id], id) for id in frozen]
        """A heap: what may come, oldest first."""
        self._waiting: dict[str, list[str]] = defaultdict(list)
        """Ids by the cause that has not come yet."""

    def next(self) -> Envelope | None:
        """The oldest message whose causes have all come; None where there is none at present."""
        while self._free:
            _, id = heapq.heappop(self._free)
            sealed = self._recording.envelope(id)
            lacking = (one for one in sealed.causes if one in self._positions and one not in self.came)
            if (cause := next(lacking, None)) is None:
                self.note(id)
                return sealed
            self._waiting[cause].append(id)
        return None

    def note(self, id: str) -> None:
        """Takes note of a message that has come."""
        self.came.add(id)
        for waiting in self._waiting.pop(id, ()):
            heapq.heappush(self._free, (self._positions[waiting], waiting))

    def blocked(self) -> list[str]:
        """What has not come, in order."""
        return sorted((id for ids in self._waiting.values() for id in ids), key=self._positions.__getitem__)


def _lost(recording: Recording) -> dict[str, set[Process]]:
    """By stage, its last processes that were lost: they say not what they left."""
    newest: dict[tuple[str, int], int] = {}
    for one in (*recording.steps, *recording.ends, *recording.lost):
        newest[one.process.place] = max(one.incarnation, newest.get(one.process.place, 0))
    lost = defaultdict[str, set[Process]](set)
    for one in recording.lost:
        if one.incarnation == newest[one.process.place]:
            lost[one.stage].add(one.process)
    return lost


def _arrived(recording: Recording, graph: Graph, names: Collection[str]) -> set[tuple[str, str, str]]:
    """(stage, port, id) of all that there was for some stages."""
    return {
        (route.consumer, route.input, id)
        for id in recording.messages
        for route in graph.routes(MessageId.of(id).stage)
        if route.consumer in names and route.output == MessageId.of(id).port
    }


def _unordered(recording: Recording, graph: Graph) -> dict[tuple[str, str], str]:
    """The ports that drive steps which come in any order, by stage and handler: what replicas emit, one at a time."""
    replicas = replicated(recording.graph) | {name for name, node in graph.nodes.items() if node.replicated}
    return {
        (node.name, handler.name): port.name
        for node in graph.nodes.values()
        for handler in node.type.handlers
        if (port := handler.driver) is not None and port.kind == "one"
        if port.name in node.inputs and node.inputs[port.name].stage in replicas
    }


def _sequence(consumed: Iterable[tuple[str, str]], port: str | None) -> int | None:
    """Of the message that a step consumed on a port; None where there is none."""
    return next((MessageId.of(id).sequence for name, id in consumed if name == port), None)


def _journal(
    recording: Recording, unordered: Mapping[tuple[str, str], str], lost: Collection[Process]
) -> dict[Key, Step]:
    """Every step that was done, or stopped at the end of the graph, in their order; and those by which processes failed
    that are ``lost``, for no successor took them again."""
    taken = [
        step
        for step in recording.steps
        if step.handler != "source" and (step.outcome in ("done", "stopped") or step.process in lost)
    ]
    taken.sort(key=lambda step: step.incarnation)  # stable: within a process the journal has them in order
    counts: Counter[tuple[str, str, str]] = Counter()
    journal: dict[Key, Step] = {}
    for step in taken:
        known = (recording.messages[id].lineage for _, id in step.consumed if id in recording.messages)
        place = (step.stage, step.handler, next(known, ""))
        driven = _sequence(step.consumed, unordered.get((step.stage, step.handler)))
        key = (*place, counts[place] if driven is None else driven)
        counts[place] += 1
        journal.setdefault(key, step)  # each replica takes a step for what they do not share
    return journal
