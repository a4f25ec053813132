"""What a recording holds: messages by id, journalled steps, log lines, its origin, and whether it is complete."""

from __future__ import annotations

import contextlib
import itertools
import json
from collections import Counter, OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from mcap.records import Channel, Metadata, Schema

from runner.contract import Refused
from runner.message.codec import CodecError, Envelope, LogLine, Lost, Step, unpack
from runner.message.ids import split_id
from runner.message.ids import topic_of as topic_of  # noqa: PLC0414 - for its importers
from runner.recording.container import Container, Damage, Entry, open_file
from runner.recording.migrations import migrated, migrations_of
from runner.recording.provenance import fingerprint, numerical

T = TypeVar("T")
PROFILE = "scene-programming"
"""Of the MCAP header."""
JOURNAL = "journal/"
LOG = "log/"
RUN = "run"
"""Name of the metadata that says what ran where."""
VERDICT = "verdict"
STEPS_ONLY = "steps only"
"""Of a run that was asked to record no messages."""
MOST_GAPS = 100_000
"""Ids named where sequences have gaps: one that claims an absurd number must not take all memory."""
OPEN_CHUNKS = 8
"""Decompressed chunks kept in memory while messages are looked up by id."""


def payload_kind(topic: str) -> type[Envelope] | type[Step] | type[LogLine] | type[Lost]:
    """What is recorded under a topic."""
    if topic.startswith("lost/"):
        return Lost
    if topic.startswith(JOURNAL):
        return Step
    return LogLine if topic.startswith(LOG) else Envelope


@dataclass(frozen=True, slots=True)
class Located:
    """A recorded message without its body, and where that body is."""

    id: str
    lineage: str
    topic: str
    type: str
    log_time_ns: int
    size: int
    """Bytes of the whole envelope."""
    offset: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether everything that was sent is in the recording."""

    complete: bool
    missing: tuple[str, ...] = ()
    """Ids of messages that the journal or a gap in a port's sequence names and that are not recorded."""
    reason: str = ""

    @property
    def word(self) -> str:
        """COMPLETE or INCOMPLETE."""
        return "COMPLETE" if self.complete else "INCOMPLETE"

    def metadata(self) -> dict[str, str]:
        """As it stands in a file."""
        return {"verdict": self.word, "missing": json.dumps(self.missing), "reason": self.reason}

    def __str__(self) -> str:
        more = f" and {len(self.missing) - 5} more" if len(self.missing) > 5 else ""
        reasons = [self.reason] if self.reason else []
        reasons += [f"{len(self.missing)} missing: {', '.join(self.missing[:5])}{more}"] if self.missing else []
        return f"{self.word}: {'; '.join(reasons)}" if reasons else self.word


class Ledger:
    """Keeps the accounts of a recording: which ids it holds and which it should hold.

    The sequence of every port starts at 0 and has no gaps, except where replicas share the numbering:
    a replica that was stopped leaves its number unused. Whatever a step consumed or emitted is recorded.
    """

    def __init__(self, shared_numbering: frozenset[str] = frozenset()) -> None:
        """``shared_numbering`` names the stages that run as replicas."""
        self._shared = shared_numbering
        self._recorded: set[str] = set()
        self._named: set[str] = set()
        self._last: dict[str, int] = {}

    def message(self, id: str) -> None:
        """Enters a recorded message."""
        self._recorded.add(id)
        port, sequence = split_id(id)
        self._last[port] = max(self._last.get(port, 0), sequence)

    def step(self, step: Step) -> None:
        """Enters a journalled step."""
        self._named.update(id for _, id in step.consumed)
        self._named.update(step.emitted)

    def lost(self, id: str) -> None:
        """Enters a message that came and could not be kept."""
        self._recorded.discard(id)
        self._named.add(id)

    def missing(self) -> tuple[str, ...]:
        """Ids that should be there and are not, by port and sequence."""
        gaps = set(itertools.islice(self._gaps(), MOST_GAPS))
        return tuple(sorted((self._named - self._recorded) | gaps, key=split_id))

    def _gaps(self) -> Iterator[str]:
        ports = (port for port in self._last if port.partition(".")[0] not in self._shared)
        numbered = (f"{port}#{sequence}" for port in ports for sequence in range(self._last[port]))
        return (id for id in numbered if id not in self._recorded)


def replicated(graph: Mapping[str, Any]) -> frozenset[str]:
    """The stages of a graph, as recorded, that run as replicas."""
    return frozenset(name for name, stage in graph["stages"].items() if stage.get("replicas", 1) != 1)


def _ids(text: str) -> list[str]:
    """A JSON list of ids; nothing where the text is none."""
    try:
        return msgspec.json.decode(text, type=list[str])
    except msgspec.MsgspecError:
        return []


def _readable(entry: Entry) -> bool:
    try:
        unpack(payload_kind(entry.topic), entry.data)
    except CodecError:
        return False
    return True


class Recording:
    """A recording in a file: headers, steps and log lines in memory, bodies read when they are asked for."""

    def __init__(self, path: Path) -> None:
        """Reads the file once; raises Refused with one line where it is no recording."""
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.messages: dict[str, Located] = {}
        self.steps: list[Step] = []
        self.log: list[LogLine] = []
        self.repeated: Counter[str] = Counter()
        """Ids recorded more than once: a restarted stage answers again under the same id."""
        self._open: OrderedDict[int, dict[str, Envelope]] = OrderedDict()
        with open_file(path) as file:
            self._container = Container(file, str(path))
            for record in self._container:
                self._enter(record)
            if self._container.unknown:
                self._forget()
                for record in self._container.read_again(file):
                    self._enter(record)
        self._graph = self._read_graph()

    @property
    def run(self) -> dict[str, str]:
        """What ran where: graph, settings, seed, versions, revision, fingerprint."""
        return self.metadata[RUN]

    @property
    def fingerprint(self) -> str:
        """Hash of the processor and the libraries it was computed with, see :mod:`runner.recording.provenance`."""
        packages = self.aspect("packages", dict[str, str]())
        return fingerprint(self.aspect("machine", dict[str, str]()), packages, numerical(self.graph))

    @property
    def graph(self) -> dict[str, Any]:
        """The graph as it ran, with all settings applied."""
        return self._graph

    def aspect(self, name: str, default: T) -> T:
        """One JSON text of :attr:`run`, or the default where it is absent, unreadable or of another type."""
        try:
            value = json.loads(self.run[name])
        except (KeyError, ValueError):
            return default
        return value if isinstance(value, type(default)) else default

    @property
    def damage(self) -> list[Damage]:
        """Where the file does not hold what was written."""
        return self._container.damage

    @property
    def torn(self) -> bool:
        """True where the end of the file is missing."""
        return self._container.torn

    @property
    def verdict(self) -> Verdict:
        """What the recorder concluded; where the file is torn or damaged since, what its content says."""
        missing = self._missing()
        written = self.metadata.get(VERDICT, {"verdict": "INCOMPLETE", "reason": "the recorder wrote no verdict"})
        if self.torn:
            return Verdict(False, missing, f"torn at {self.damage[-1]}")
        if self.damage:
            return Verdict(False, missing, f"damaged at {self.damage[0]}")
        return Verdict(written.get("verdict") == "COMPLETE" and not missing, missing, written.get("reason", ""))

    @property
    def channels(self) -> Mapping[int, Channel]:
        """MCAP's channels, by the number that entries give."""
        return self._container.channels

    @property
    def schemas(self) -> Mapping[int, Schema]:
        """MCAP's schemas, by the number that channels give."""
        return self._container.schemas

    def records(self) -> Iterator[Entry | Metadata]:
        """Everything in the file once more, as it was written; what cannot be read is left out."""
        with open_file(self.path) as file:
            container = Container(file, str(self.path))
            container.channels.update(self.channels)
            yield from (record for record in container if isinstance(record, Metadata) or _readable(record))

    def envelope(self, id: str) -> Envelope:
        """One message by id, as its class is today; raises KeyError where it is not recorded and Refused where the
        migrations that the graph names are not there.
        """
        return migrated(self.recorded(id), migrations_of(self.graph))

    def recorded(self, id: str) -> Envelope:
        """One message by id, as it was when it was recorded; raises KeyError where it is not."""
        offset = self.messages[id].offset
        if offset not in self._open:
            self._open[offset] = self._envelopes_at(offset)
        self._open.move_to_end(offset)
        if len(self._open) > OPEN_CHUNKS:
            self._open.popitem(last=False)
        return self._open[offset][id]

    def envelopes(self) -> Iterator[Envelope]:
        """Every message in the order of recording."""
        return (self.envelope(id) for id in self.messages)

    def _forget(self) -> None:
        for entered in (self.messages, self.steps, self.log, self.repeated):
            entered.clear()

    def _enter(self, record: Metadata | Entry) -> None:
        if isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
            return
        try:
            self._enter_entry(record)
        except CodecError as error:
            self.damage.append(Damage(record.offset, f"a record of {record.topic}: {error}"))

    def _enter_entry(self, entry: Entry) -> None:
        match unpack(payload_kind(entry.topic), entry.data):
            case Step() as step:
                if step.handler:
                    self.steps.append(step)
            case LogLine() as line:
                self.log.append(line)
            case Lost():
                pass
            case Envelope(id=id) as sealed:
                self.repeated[id] += id in self.messages
                where = entry.log_time_ns, len(entry.data), entry.offset
                self.messages.setdefault(id, Located(id, sealed.lineage, entry.topic, sealed.type, *where))

    def _envelopes_at(self, offset: int) -> dict[str, Envelope]:
        envelopes: dict[str, Envelope] = {}
        with open_file(self.path) as file:
            entries = self._container.entries_at(file, offset)
        for entry in entries:
            if not entry.topic.startswith((JOURNAL, LOG, "lost/")):
                with contextlib.suppress(CodecError):  # noted as damage when the file was read
                    sealed = unpack(Envelope, entry.data)
                    envelopes.setdefault(sealed.id, sealed)
        return envelopes

    def require_messages(self) -> None:
        """Raises Refused where the run was asked to record none."""
        if self._steps_only:
            raise Refused(f"{self.path}: holds no messages (runner up --steps-only): no stage can be executed again")

    @property
    def _steps_only(self) -> bool:
        return self.run.get("records") == STEPS_ONLY

    def _missing(self) -> tuple[str, ...]:
        """What the journal and the sequences name, and what the recorder could not keep."""
        if self._steps_only:
            return ()
        ledger = Ledger(replicated(self.graph))
        for id in _ids(self.metadata.get(VERDICT, {}).get("missing", "")):
            ledger.lost(id)
        for id in self.messages:
            ledger.message(id)
        for step in self.steps:
            ledger.step(step)
        return ledger.missing()

    def _read_graph(self) -> dict[str, Any]:
        if RUN not in self.metadata:
            damaged = f" ({self.damage[0]})" if self.damage else ""
            raise Refused(f"{self.path}: not a recording of this runner: no {RUN!r} metadata{damaged}")
        graph = self.aspect("graph", dict[str, Any]())
        stages = graph.get("stages")
        if not isinstance(stages, dict) or not all(isinstance(stage, dict) for stage in stages.values()):
            raise Refused(f"{self.path}: the {RUN!r} metadata holds no readable graph")
        return graph
