"""Proves from the records of a recording, one by one in the order of the file, that nothing is missing."""

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
from isal import isal_zlib

from runner.graph.graph import SUPERVISOR, command_port
from runner.message.codec import Envelope, LogLine, Lost, Step
from runner.message.ids import numbered
from runner.recording.intervals import Intervals

Record = str | Step | Lost | LogLine
"""What is recorded; a message is its id."""
MOST_NAMED = 100_000
"""Ids of missing messages that are named: one with an absurd number must not take all memory."""
MOST_RANGES = 2**15
"""Where a replicated stage leaves more parts than this unanswered, the oldest of them are settled."""
FEW = 3
"""Findings that are shown, and records that one finding names."""


class _Input(msgspec.Struct, frozen=True):
    source: str = msgspec.field(name="from")
    policy: str = "block"


class _Stage(msgspec.Struct, frozen=True):
    """What a recorded graph says of a stage, as :func:`runner.graph.graph.node_entry` writes it."""

    inputs: dict[str, _Input] = {}
    replicas: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 1
    commands: tuple[str, ...] = ()
    shares: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class _Edge:
    """Where a stage gets the messages of one port from, and which of them it has had."""

    source: str
    shared: bool
    taken: defaultdict[int, Intervals]
    """By replica; under 0 for all that share them."""
    done: defaultdict[tuple[int, str], Intervals]
    """By replica and handler, the only messages of steps that were done: no other step may have them."""


@dataclass(slots=True)
class _Process:
    """What is known of one process."""

    steps: Intervals = field(default_factory=Intervals)
    heard: int = 0
    """One more than the largest step number that was heard of, recorded or not."""
    ended: int | None = None
    """Number of its last step, which says that it is the last."""
    lost: bool = False

    def problems(self, name: str) -> Iterator[str]:
        stop = max(self.steps.stop, self.heard)
        for start, end in self.steps.gaps(0, stop):
            yield f"{name} has no step {_span(start, end)}"
        if self.ended is None and not self.lost:
            yield f"nothing says how {name} ended"
        if self.ended is not None and self.ended < stop - 1:
            yield f"{name} went on after its end, step {self.ended}"


class Proof:
    """The accounts of one recording; ``docs/runner/recordings.md`` has the rules.

    Numbers are kept as ranges: nothing grows with the recording while nothing is missing.
    """

    def __init__(self, graph: Mapping[str, Any]) -> None:
        """``graph`` is the recorded one; raises msgspec.ValidationError where it is not what is recorded of graphs."""
        self._stages = msgspec.convert(graph.get("stages"), dict[str, _Stage])
        self._edges = dict(_edges(self._stages))
        names = ((name, replica) for name, stage in self._stages.items() for replica in range(stage.replicas))
        self._processes = {name: defaultdict[int, _Process](_Process) for name in ((SUPERVISOR, 0), *names)}
        """By stage and replica, and by incarnation."""
        self._recorded = defaultdict[str, Intervals](Intervals)
        """By output port, as all that follow."""
        self._emitted = defaultdict[str, Intervals](Intervals)
        self._awaited = defaultdict[str, Intervals](Intervals)
        """Named by a step and not recorded, or not yet."""
        self._excused = defaultdict[str, Intervals](Intervals)
        """Recorded, and emitted by no step before a process of the stage was lost."""
        self._contents: dict[str, int] = {}
        """Checksums, by id, of the messages that may come again: no step has emitted them yet."""
        self._ambiguous: dict[str, None] = {}
        """Ids of those that came again as something else."""
        self._again: list[str] = []
        """Findings: messages that a step has done after another one had."""
        self._newest_ns = -1
        self._misplaced = 0
        """Records that do not follow the one before them in time, and the first of them:"""
        self._disorder: list[str] = []
        self._found = Counter[str]()
        self._dropped = Counter[str]()

    # ------------------------------------------------------------------------------------ what is entered

    def enter(self, topic: str, log_time_ns: int, record: Record, content: int = 0) -> None:
        """The next record of the file, see :func:`to_enter`."""
        if log_time_ns <= self._newest_ns:
            self._misplaced += 1
            self._disorder += [_name(topic, record)] if self._misplaced <= FEW else []
        self._newest_ns = max(log_time_ns, self._newest_ns)
        match record:
            case str():
                self.message(record, content)
            case Step():
                self.step(record)
            case Lost():
                self.lost(record)
            case LogLine():
                pass
        self._found[topic] += 1

    def drop(self, topic: str, record: Record) -> None:
        """A record that came and is not in the file."""
        match record:
            case str():
                self.want(record)
            case Step():
                process = self._process(record)
                process.heard = max(process.heard, record.number + 1)
                for id in (*record.emitted, *(id for _, id in record.consumed)):
                    self.want(id)
            case _:
                pass
        self._dropped[topic] += 1

    def want(self, id: str) -> None:
        """A message that should be recorded."""
        self._want(*numbered(id))

    def message(self, id: str, content: int = 0) -> None:
        """A recorded message."""
        port, number = numbered(id)
        if number not in self._emitted[port]:
            self._contents.setdefault(id, content)
        if self._contents.get(id, content) != content:
            self._ambiguous[id] = None
        recorded = self._recorded[port]
        recorded.add(number)
        if port in self._awaited:
            self._awaited[port].discard(number)
        if len(recorded) > MOST_RANGES and self._shares_numbering(port):
            self._settle(port)

    def step(self, step: Step) -> None:
        """A recorded step."""
        process = self._process(step)
        process.steps.add(step.number)
        if step.outcome == "ended":
            process.ended = step.number
        for id in step.emitted:
            port, number = numbered(id)
            self._emitted[port].add(number)
            self._want(port, number)
            if step.outcome != "failed":
                self._contents.pop(id, None)
        for input, id in step.consumed:
            port, number = numbered(id)
            self._take(step, input, port, number)
            self._want(port, number)
        for input, id in step.left:
            self._take(step, input, *numbered(id))

    def lost(self, lost: Lost) -> None:
        """A process that was killed may have sent messages of a step that it never journalled."""
        self._process(lost).lost = True
        for port in [port for port in self._recorded if _stage_of(port) == lost.stage]:
            self._excused[port] |= self._recorded[port] - self._emitted[port]

    def _process(self, of: Step | Lost) -> _Process:
        return self._processes.setdefault(of.process.place, defaultdict(_Process))[of.incarnation]

    def _want(self, port: str, number: int) -> None:
        if number not in self._recorded[port]:
            self._awaited[port].add(number)

    def _take(self, step: Step, input: str, port: str, number: int) -> None:
        edge = self._edges.get((step.stage, input))
        if edge is None or edge.source != port:
            return
        replica = 0 if edge.shared else step.replica
        edge.taken[replica].add(number)
        # A part may be dealt again while a replica works on it: to another one, by the successor of who sent it.
        if step.outcome == "done" and len(step.consumed) == 1 and not edge.shared:
            done = edge.done[replica, step.handler]
            if number in done and len(self._again) < MOST_NAMED:
                self._again.append(f"{_name('', step)} has done {port}#{number} again")
            done.add(number)
            done.keep(MOST_RANGES)

    def _shares_numbering(self, port: str) -> bool:
        """Whether replicas number what they answer by the part that they answer, so that there may be gaps."""
        stage = self._stages.get(_stage_of(port))
        return stage is not None and stage.replicas > 1

    def _settle(self, port: str) -> None:
        """Fills the older half of the gaps everywhere: what was not answered by then never will be."""
        gaps = list(self._recorded[port].gaps(0, self._recorded[port].stop))
        older = gaps[: len(gaps) // 2]
        for accounts in (self._recorded, self._emitted):
            accounts[port] |= older
        for edge in self._edges.values():
            if edge.source == port:
                edge.taken.update({replica: taken | older for replica, taken in edge.taken.items()})

    # ------------------------------------------------------------------------------------ what is found

    @property
    def counts(self) -> dict[str, int]:
        """Records that came, by topic."""
        return dict(sorted((self._found + self._dropped).items()))

    def missing(self) -> tuple[str, ...]:
        """Ids of messages that should be there and are not, by port and number; not more than ``MOST_NAMED``."""
        lacking = ((port, start, stop) for port in sorted(self._recorded) for start, stop in self._lacking(port))
        ids = (f"{port}#{number}" for port, start, stop in lacking for number in range(start, stop))
        return tuple(itertools.islice(ids, MOST_NAMED))

    def problems(self, counts: Mapping[str, int] | None = None) -> Iterator[str]:
        """What else does not hold, a line each. ``counts`` of records by topic are those that came, unless given."""
        counts = self.counts if counts is None else counts
        for topic in sorted({*counts, *self._found}):
            if self._found[topic] != counts.get(topic, 0):
                yield f"{topic} has {self._found[topic]} of {counts.get(topic, 0)} records"
        if self._misplaced:
            more = f" and {self._misplaced - FEW} more" if self._misplaced > FEW else ""
            yield f"out of order: {', '.join(self._disorder)}{more}"
        yield from (f"two messages have the id {id}" for id in self._ambiguous)
        yield from self._again
        yield from self._process_problems()
        yield from self._message_problems()

    def _lacking(self, port: str) -> Intervals:
        recorded, awaited = self._recorded[port], self._awaited[port]
        if self._shares_numbering(port):
            return awaited
        return awaited | recorded.gaps(0, max(recorded.stop, awaited.stop))

    def _process_problems(self) -> Iterator[str]:
        for (stage, replica), incarnations in sorted(self._processes.items()):
            known = Intervals((number, number + 1) for number in incarnations)
            for start, stop in known.gaps(0, max(1, known.stop)):
                yield f"nothing says how {stage}/{replica}/{_span(start, stop)} ended"
            for number, process in sorted(incarnations.items()):
                yield from process.problems(f"{stage}/{replica}/{number}")

    def _message_problems(self) -> Iterator[str]:
        unexplained = {port: self._recorded[port] - self._emitted[port] for port in sorted(self._recorded)}
        for port, numbers in unexplained.items():
            for start, stop in numbers - self._excused[port]:
                yield f"no step emitted {port}#{_span(start, stop)}"
        for (stage, input), edge in sorted(self._edges.items()):
            expected = self._recorded[edge.source] - unexplained.get(edge.source, Intervals())
            replicas = range(1 if edge.shared else self._stages[stage].replicas)
            for replica in () if edge.shared and self._is_lost(stage) else replicas:
                if edge.shared or not self._is_lost(stage, replica):
                    name = f"{stage}.{input}" if len(replicas) == 1 else f"{stage}[{replica}].{input}"
                    for start, stop in expected - edge.taken[replica]:
                        yield f"{name} neither consumed nor left {edge.source}#{_span(start, stop)}"

    def _is_lost(self, stage: str, replica: int | None = None) -> bool:
        """Whether a replica, or any of them, was lost and had no successor."""
        replicas = range(self._stages[stage].replicas) if replica is None else (replica,)
        each = [self._processes[stage, one] for one in replicas]
        return any(incarnations[max(incarnations)].lost for incarnations in each if incarnations)


def to_enter(record: Envelope | Step | Lost | LogLine) -> tuple[Record, int]:
    """What is recorded, and of a message a checksum of what it says."""
    return (record.id, isal_zlib.crc32(record.body)) if isinstance(record, Envelope) else (record, 0)


def in_short(problems: Iterable[str]) -> str:
    """The first few and how many more there are; empty where there are none."""
    rest = iter(problems)
    first = list(itertools.islice(rest, FEW))
    more = sum(1 for _ in rest)
    return "; ".join([*first, *([f"and {more} more"] if more else [])])


def _edges(stages: Mapping[str, _Stage]) -> Iterator[tuple[tuple[str, str], _Edge]]:
    """Every edge that may not skip messages, by the stage and port that it leads to."""
    for name, stage in stages.items():
        sources = {port: edge.source for port, edge in stage.inputs.items() if edge.policy != "latest"}
        sources |= {port: f"{SUPERVISOR}.{command_port(name, port)}" for port in stage.commands}
        for port, source in sources.items():
            yield (name, port), _Edge(source, port in stage.shares, defaultdict(Intervals), defaultdict(Intervals))


def _stage_of(port: str) -> str:
    return port.partition(".")[0]


def _span(start: int, stop: int) -> str:
    return str(start) if stop == start + 1 else f"{start} to {stop - 1}"


def _name(topic: str, record: Record) -> str:
    match record:
        case str():
            return record
        case Step():
            return f"step {record.number} of {record.process.path}"
        case _:
            return f"a record of {topic}"
