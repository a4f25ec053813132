"""What a recording holds: messages by id, journalled steps, log lines, its origin, and whether it is complete."""

import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from mcap.records import Metadata

from runner.contract import Message, Refused
from runner.graph.document import suggest
from runner.graph.graph import SUPERVISOR, Graph
from runner.message.codec import CodecError, Envelope, LogLine, Lost, Step, open_envelope, unpack
from runner.message.ids import IdText, MessageId, numbered
from runner.recording.container import Container, Entry, is_being_written, open_file
from runner.recording.migrations import migrated, migrations_of
from runner.recording.proof import Proof, Record, in_short, to_enter
from runner.recording.provenance import fingerprint, numerical
from runner.terminal import listed

T = TypeVar("T")
PROFILE = "scene-programming"
"""Of the MCAP header."""
JOURNAL = "journal/"
LOG = "log/"
LOST = "lost/"
RUN = "run"
"""Name of the metadata that says what ran where."""
FORMAT = "2"
"""Of recordings, under ``format`` in that metadata: the first said neither how processes ended nor what it counted."""
VERDICT = "verdict"
STEPS_ONLY = "steps only"
"""Of a run that was asked to record no messages."""
OPEN_CHUNKS = 8
"""Decompressed chunks kept in memory while messages are looked up by id."""


Kind = type[Envelope] | type[Step] | type[LogLine] | type[Lost]


def payload_kind(topic: str) -> Kind:
    """What is recorded under a topic."""
    kinds: dict[str, Kind] = {JOURNAL: Step, LOG: LogLine, LOST: Lost}
    return kinds.get(topic[: topic.find("/") + 1], Envelope)


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
class Completeness:
    """Whether everything that was sent is in the recording."""

    complete: bool
    missing: tuple[str, ...] = ()
    """Ids of messages that the journal or a gap in a port's sequence names and that are not recorded."""
    reason: str = ""
    """What else does not hold: the first few findings and how many more there are."""
    counts: Mapping[str, int] | None = field(default=None, compare=False)
    """Records that came, by topic; None where nobody counted them."""
    run: str = field(default="", compare=False)
    """:func:`hash_of` the metadata that says what ran where; empty where the recorder wrote none."""

    @property
    def word(self) -> str:
        """COMPLETE or INCOMPLETE."""
        return "COMPLETE" if self.complete else "INCOMPLETE"

    def metadata(self) -> dict[str, str]:
        """As it stands in a file."""
        counts = {} if self.counts is None else {"counts": json.dumps(self.counts)}
        run = {"run": self.run} if self.run else {}
        return {"verdict": self.word, "missing": json.dumps(self.missing), "reason": self.reason, **counts, **run}

    def __str__(self) -> str:
        reasons = [self.reason] if self.reason else []
        reasons += [f"{len(self.missing)} missing: {listed(self.missing)}"] if self.missing else []
        return f"{self.word}: {'; '.join(reasons)}" if reasons else self.word


def hash_of(run: Mapping[str, str]) -> str:
    """SHA-256 of what a recording says of its run, whatever the order."""
    return hashlib.sha256(json.dumps(run, sort_keys=True).encode()).hexdigest()


def replicated(graph: Mapping[str, Any]) -> frozenset[str]:
    """The stages of a graph, as recorded, that run as replicas."""
    return frozenset(name for name, stage in graph["stages"].items() if stage.get("replicas", 1) != 1)


def kind_of(graph: Graph, id: str) -> type[Message] | None:
    """The class of a message; None where the graph has no such output."""
    one = MessageId.of(id)
    return graph.outputs_of(one.stage).get(one.port)


def opened(graph: Graph, sealed: Envelope) -> Message | None:
    """The message inside; None where the graph has no such output. Raises Refused where it cannot be read."""
    kind = kind_of(graph, sealed.id)
    try:
        return open_envelope(kind, sealed) if kind else None
    except CodecError as error:
        raise Refused(f"{sealed.id} cannot be read: {error}") from None


def decoded(text: str, kind: type[T]) -> T:
    """What a JSON text holds; nothing (``kind()``) where it is none or of another type."""
    try:
        return msgspec.convert(json.loads(text), kind)
    except (ValueError, msgspec.ValidationError):
        return kind()


def _readable(entry: Entry) -> bool:
    try:
        unpack(payload_kind(entry.topic), entry.message.data)
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
        """What handlers did; not that a process ended, nor what the supervisor sent."""
        self.ends: list[Step] = []
        """The last record of each process that ended in order."""
        self.log: list[LogLine] = []
        self.lost: list[Lost] = []
        """Processes that died."""
        self.repeated: set[str] = set()
        """Ids recorded more than once: a restarted stage answers again under the same id."""
        self._open = lru_cache(OPEN_CHUNKS)(self._envelopes_at)
        self._order: list[tuple[str, int, Record, int]] = []
        """Topic, log time, record and checksum of all entries in the order of the file."""
        self._misplaced: dict[str, None] = {}
        """Findings: metadata that does not stand where it was written."""
        growing = self._read_file(path)
        self.damage, self.torn = self.container.damage, self.container.torn
        """Places that do not hold what was written there, as ``byte 4711: reason``; whether the end is missing."""
        self._growing = growing and self.torn
        """Whether the end is still to be written."""
        if self._growing:
            self.damage.pop()
        if RUN not in self.metadata:
            damaged = f" ({self.damage[0]})" if self.damage else ""
            raise Refused(f"{path}: not a recording of this runner: no {RUN!r} metadata{damaged}")
        self.run = self.metadata[RUN]
        """What ran where: graph, settings, seed, versions, revision, fingerprint."""
        self.graph = self.aspect("graph", dict[str, Any]())
        """The graph as it ran, with all settings applied."""
        try:
            Proof(self.graph)
        except msgspec.ValidationError as error:
            raise Refused(f"{path}: the {RUN!r} metadata holds no readable graph: {error}") from None

    @property
    def fingerprint(self) -> str:
        """Hash of the processor and the libraries it was computed with, see :mod:`runner.recording.provenance`."""
        packages = self.aspect("packages", dict[str, str]())
        return fingerprint(self.aspect("machine", dict[str, str]()), packages, numerical(self.graph))

    def aspect(self, name: str, default: T) -> T:
        """One JSON text of :attr:`run`, or the default where it is absent, unreadable or of another type."""
        return decoded(self.run.get(name, ""), type(default)) or default

    @property
    def lasted_ns(self) -> int:
        """From the first record to the last, as the recorder received them."""
        times = [time_ns for _, time_ns, *_ in self._order]
        return max(times, default=0) - min(times, default=0)

    @cached_property
    def verdict(self) -> Completeness:
        """What was written, as far as the content proves it: COMPLETE only where both say so."""
        written = self.metadata.get(VERDICT, {"verdict": "INCOMPLETE", "reason": "the recorder wrote no verdict"})
        counts = decoded(written.get("counts", ""), dict[str, int]) if VERDICT in self.metadata else None
        reason, run = self._breakage or written.get("reason", ""), written.get("run", "")
        if self._steps_only or self._growing:
            return Completeness(False, (), reason, counts, run)
        proof, found = self._prove(), ""
        missing = proof.missing()
        if self._says_ends:
            counts = proof.counts if counts is None else counts
            found = in_short(chain(proof.problems(counts), self._misplaced))
        complete = written.get("verdict") == "COMPLETE" and not (self._breakage or found or missing)
        reasons = (reason, "" if found in reason else found)
        known = counts if self._says_ends else None
        return Completeness(complete, missing, "; ".join(filter(None, reasons)), known, run)

    def records(self) -> Iterator[Entry | Metadata]:
        """Everything in the file once more, as it was written; what cannot be read is left out."""
        with open_file(self.path) as file:
            container = Container(file, str(self.path), self.container)
            yield from (record for record in container if isinstance(record, Metadata) or _readable(record))

    def envelope(self, id: str) -> Envelope:
        """One message by id, as its class is today; raises KeyError where it is not recorded and Refused where the
        migrations that the graph names are not there.
        """
        return migrated(self.recorded(id), migrations_of(self.graph))

    def recorded(self, id: str) -> Envelope:
        """One message by id, as it was when it was recorded; raises KeyError where it is not."""
        return self._open(self.messages[id].offset)[id]

    def envelopes(self) -> Iterator[Envelope]:
        """Every message in the order of recording."""
        return (self.envelope(id) for id in self.messages)

    def _read_file(self, path: Path) -> bool:
        """Returns whether somebody was writing it when that began."""
        with open_file(path) as file:
            growing = is_being_written(file)
            self._read(Container(file, str(path)))
            if self.container.unknown:
                file.seek(0)
                self._forget()
                self._read(Container(file, str(path), self.container))
        return growing

    def _forget(self) -> None:
        lists = self.steps, self.ends, self.log, self.lost, self._order
        for entered in (self.metadata, self._misplaced, self.messages, self.repeated, *lists):
            entered.clear()

    def _read(self, container: Container) -> None:
        self.container = container
        for record in container:
            if isinstance(record, Metadata):
                self._enter_metadata(record)
                continue
            try:
                self._enter_entry(record)
            except CodecError as error:
                container.damage.append(f"byte {record.offset}: a record of {record.topic}: {error}")

    def _enter_metadata(self, record: Metadata) -> None:
        if record.name in self.metadata:
            self._misplaced[f"metadata {record.name!r} stands there again"] = None
        if record.name == RUN and self._order:
            self._misplaced[f"metadata {RUN!r} does not stand first"] = None
        self.metadata[record.name] = record.metadata

    def _enter_entry(self, entry: Entry) -> None:
        data, time_ns = entry.message.data, entry.message.log_time
        record = unpack(payload_kind(entry.topic), data)
        match record:
            case Step():
                if record.outcome == "ended":
                    self.ends.append(record)
                elif record.stage != SUPERVISOR:
                    self.steps.append(record)
            case LogLine():
                self.log.append(record)
            case Lost():
                self.lost.append(record)
            case Envelope(id=id):
                if id in self.messages:
                    self.repeated.add(id)
                located = Located(id, record.lineage, entry.topic, record.type, time_ns, len(data), entry.offset)
                self.messages.setdefault(id, located)
        if VERDICT in self.metadata:
            self._misplaced[f"metadata {VERDICT!r} does not stand last"] = None
        self._order.append((entry.topic, time_ns, *to_enter(record)))

    def _envelopes_at(self, offset: int) -> dict[str, Envelope]:
        envelopes: dict[str, Envelope] = {}
        with open_file(self.path) as file:
            for entry in self.container.entries_at(file, offset):
                if payload_kind(entry.topic) is Envelope:
                    with contextlib.suppress(CodecError):  # noted as damage when the file was read
                        sealed = unpack(Envelope, entry.message.data)
                        envelopes.setdefault(sealed.id, sealed)
        return envelopes

    def require(self, id: str) -> None:
        """Raises Refused, naming the nearest, where a message is not recorded."""
        if id in self.messages:
            return
        wanted = MessageId.of(id)
        same_port = sorted(other for other in map(MessageId.of, self.messages) if other.topic == wanted.topic)
        if not same_port:
            ports = {source for source, _ in map(numbered, self.messages)}
            raise Refused(f"{self.path}: no message {id!r}{suggest(f'{wanted.stage}.{wanted.port}', ports)}")
        near = sorted(same_port, key=lambda other: abs(other.sequence - wanted.sequence))[:3]
        raise Refused(
            f"{self.path}: no message {id!r}; the nearest: {', '.join(map(str, sorted(near)))} "
            f"(of {same_port[0]} to #{same_port[-1].sequence})"
        )

    def require_messages(self) -> None:
        """Raises Refused where the run was asked to record none."""
        if self._steps_only:
            raise Refused(f"{self.path}: holds no messages (runner up --steps-only)")

    @property
    def _steps_only(self) -> bool:
        return self.run.get("records") == STEPS_ONLY

    @property
    def _breakage(self) -> str:
        if self._growing:
            return "is still being written"
        if self.torn:
            return f"torn at {self.damage[-1]}"
        if self.metadata.get(VERDICT, {}).get("run", "") not in ("", hash_of(self.run)):
            return f"metadata {RUN!r} is not what was written"
        return f"damaged at {self.damage[0]}" if self.damage else ""

    @property
    def _says_ends(self) -> bool:
        """Whether it says how processes ended, which the first recordings did not."""
        return bool("format" in self.run or "counts" in self.metadata.get(VERDICT, {}) or self.lost or self.ends)

    def _prove(self) -> Proof:
        proof = Proof(self.graph)
        for entry in self._order:
            proof.enter(*entry)
        for id in decoded(self.metadata.get(VERDICT, {}).get("missing", ""), list[IdText]):
            proof.want(id)
        return proof
