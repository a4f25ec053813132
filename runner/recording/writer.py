"""One recording being written: an MCAP file that ends with a verdict on whether everything is there."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, cast

import msgspec
from mcap._chunk_builder import ChunkBuilder
from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex, MessageIndex
from mcap.records import Message as McapMessage
from mcap.stream_reader import MAGIC_SIZE
from mcap.writer import CompressionType, Writer

from runner.contract import Message, Refused
from runner.graph.graph import Route
from runner.graph.placement import Network
from runner.message.codec import CodecError, Envelope, LogLine, Lost, Step, json_schema, unpack
from runner.message.ids import MessageId
from runner.recording import provenance
from runner.recording.container import Container, hold, message_head
from runner.recording.proof import Proof, Record, in_short, to_enter
from runner.recording.recording import (
    FORMAT,
    JOURNAL,
    LOG,
    LOST,
    PROFILE,
    RUN,
    STEPS_ONLY,
    VERDICT,
    Completeness,
    hash_of,
    payload_kind,
)

FLUSH_SECONDS = 0.25
"""A killed recorder loses no more than this."""
CHUNK_BYTES = 2**19
"""A chunk that holds more is closed at once: a picture can be read as soon as it is written."""
REST_SECONDS = 0.02
"""What may come together before it is written."""
BACKLOG_BYTES = 2**30
"""What may wait for the disk; beyond it payloads are dropped, counted, and the recording is INCOMPLETE."""
CACHED_BYTES = 2**25
"""Newest part of a recording that the system keeps in memory, for those who read it as it grows."""

Recorded = Envelope | Step | LogLine | Lost


class Topic(msgspec.Struct, frozen=True):
    """What is recorded under one topic."""

    version: int
    schema: dict[str, Any]


class Manifest(msgspec.Struct, frozen=True):
    """What the recorder is told by the supervisor: JSON on its stdin."""

    run: str
    endpoint: str
    path: str
    """Of the file to write; it must not exist."""
    graph: str
    """JSON of the graph as it runs."""
    settings: tuple[str, ...]
    """``--set`` assignments, as typed."""
    topics: dict[str, Topic]
    """By topic, ``stage/port``."""
    gateway: str = ""
    """Where listeners meet the run."""
    network: Network | None = None
    """None on one machine."""
    steps_only: bool = False
    """Record no messages."""
    destinations: dict[str, tuple[Route, ...]] = {}
    """Where messages go, by topic."""
    processes: tuple[tuple[str, int], ...] = ()
    """(stage, replica) of every process of the graph."""


def topic(kind: type[Message]) -> Topic:
    """Describes the topic of a message type."""
    return Topic(kind.version, json_schema(kind))


def run_metadata(manifest: Manifest) -> dict[str, str]:
    """What ran where, as the recording keeps it: one JSON text per aspect."""
    graph = provenance.portable(json.loads(manifest.graph), {str(Path.cwd()): ""})
    here, packages = provenance.machine(), provenance.package_versions()
    return {
        "format": FORMAT,
        "graph": json.dumps(graph),
        "name": graph["name"],
        "seed": str(graph["seed"]),
        "settings": json.dumps(manifest.settings),
        "records": STEPS_ONLY if manifest.steps_only else "messages and steps",
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "revision": provenance.revision(graph),
        "runner": provenance.runner_version(),
        "packages": json.dumps(packages),
        "machine": json.dumps(here),
        "fingerprint": provenance.fingerprint(here, packages, provenance.numerical(graph)),
        "files": json.dumps(provenance.file_hashes(graph)),
    }


@dataclass(frozen=True, slots=True)
class _Payload:
    record: Recorded
    data: bytes | memoryview
    received_ns: int


class RecordingWriter:
    """One recording being written. ``put`` hands over to the writer's thread and never waits for the disk.

    What the system has been handed is read back and proved from the file, see :mod:`runner.recording.proof`.
    """

    def __init__(self, manifest: Manifest, complain: Callable[[str], None]) -> None:
        """Creates the file with its metadata; raises Refused where that fails.

        ``complain`` is told, on the writer's thread, where the recording ends before its time.
        """
        self._complain = complain
        self._steps_only = manifest.steps_only
        self._topics = manifest.topics
        path = Path(manifest.path)
        self._proof = Proof(json.loads(manifest.graph))
        self._proving = threading.Lock()
        self._file = _create(path)
        run = run_metadata(manifest)
        self._run_hash = hash_of(run)
        try:
            self._begin(path.parent, run)
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.close()
            raise Refused(f"recording {path}: cannot be written: {error.strerror}") from None
        self._container = Container(self._file, str(path))
        """Knows the channels that have been read back."""
        self._proved = MAGIC_SIZE
        """How much of the file has been."""
        self._channels: dict[str, int] = {}
        self._waiting: deque[_Payload | Callable[[], None]] = deque()
        self._counting = threading.Lock()
        self._waiting_bytes = 0
        self._unproved: dict[int, tuple[str, Record]] = {}
        """Topic and record, by log time, of what has not been read back yet."""
        self._chunk_bytes = 0
        self._log_time_ns = 0
        self._problems: list[str] = []
        self._overflowed = 0
        """Payloads for which there was no room."""
        self._recorded = 0
        self._closing = threading.Event()
        self._closed = False
        """Whether the file takes no more."""
        self._whole = False
        """Whether the file has been written to its end."""
        self._thread = threading.Thread(target=self._write_all, name="recording", daemon=True)
        self._thread.start()

    def _begin(self, folder: Path, run: dict[str, str]) -> None:
        """Writes the head of the file."""
        self._index_file = tempfile.TemporaryFile(buffering=0, dir=folder)  # noqa: SIM115 - see _write_all
        # A chunk ends in _flush.
        self._writer = Writer(
            self._file, chunk_size=sys.maxsize, compression=CompressionType.LZ4, enable_data_crcs=True
        )
        own = {"chunk_indices": _ChunkIndex(self._index_file), "chunk_builder": _ChunkBuilder()}
        vars(self._writer).update({f"_Writer__{name}": part for name, part in own.items()})
        self._writer.start(profile=PROFILE)
        self._writer.add_metadata(RUN, run)
        self._writer.flush()

    def put(self, record: Recorded, data: bytes | memoryview) -> None:
        """Takes one record and its bytes as they came over the bus."""
        payload = _Payload(record, data, time.time_ns())
        with self._counting:
            if self._closed or self._waiting_bytes > BACKLOG_BYTES:
                self._overflowed += not self._closed
                self._drop(payload)
                return
            self._waiting_bytes += len(data)
            self._waiting.append(payload)

    def vitals(self) -> dict[str, Any]:
        """What the recorder's pulse says: records that are written and wait for the disk."""
        return {
            "state": "working" if self._waiting else "waiting",
            "steps": self._recorded,
            "queued": {"disk": len(self._waiting)},
        }

    def after_flush(self, action: Callable[[], None]) -> None:
        """Acts, on the writer's thread, once everything that was put before can be read in the file."""
        with self._counting:
            if not self._closed:
                self._waiting.append(action)
                return
        action()  # nothing more will be written

    def note_problem(self, problem: str) -> None:
        """Has the verdict name a reason why not everything may be there."""
        self._problems.append(problem)

    def close(self) -> Completeness:
        """Writes what is waiting, the verdict and the end of the file."""
        self._closing.set()
        self._thread.join()
        verdict = self._verdict()
        return verdict if self._whole else replace(verdict, complete=False)

    # ------------------------------------------------------------------------------------ the writer's thread

    def _write_all(self) -> None:
        try:
            due = time.monotonic() + FLUSH_SECONDS
            while not self._closing.wait(REST_SECONDS):
                due = self._write_waiting(due)
            self._write_waiting(due)
            self._write_verdict()
        except BaseException as error:
            self._give_up(error)
        finally:
            self._index_file.close()
            with contextlib.suppress(OSError):
                self._file.close()
            self._drop_waiting()

    def _write_waiting(self, due: float) -> float:
        """Writes what waits, and closes a chunk when it is ``due``; returns when the next is."""
        while True:
            if time.monotonic() >= due or self._chunk_bytes > CHUNK_BYTES:
                self._flush()
                due = time.monotonic() + FLUSH_SECONDS
            if not self._waiting:
                return due
            payload = self._waiting[0]
            if isinstance(payload, _Payload):
                self._write(payload)
            else:
                self._flush()
                self._waiting.popleft()
                payload()

    def _write(self, payload: _Payload) -> None:
        """Writes the first that waits. What fails on the way is among what waits or what is not proved yet."""
        topic, named = _named(payload.record)
        self._log_time_ns = max(payload.received_ns, self._log_time_ns + 1)
        self._unproved[self._log_time_ns] = topic, named
        self._waiting.popleft()
        with self._counting:
            self._waiting_bytes -= len(payload.data)
        self._add(topic, payload.record, cast("bytes", payload.data))  # which need not be in one

    def _add(self, topic: str, record: Recorded, data: bytes) -> None:
        kind = record.type if isinstance(record, Envelope) else type(record).__name__
        channel = self._channels.get(topic) or self._register(topic, kind)
        sequence = MessageId.of(record.id).sequence if isinstance(record, Envelope) else getattr(record, "number", 0)
        self._writer.add_message(channel, self._log_time_ns, data, record.time_ns, sequence % 2**32)
        self._chunk_bytes += len(data)
        self._recorded += 1

    def _register(self, topic: str, kind: str) -> int:
        known = self._topics.get(topic)
        schema = known.schema if known else _SCHEMAS.get(kind, {})
        version = {"version": str(known.version)} if known else {}
        schema_id = self._writer.register_schema(kind, "jsonschema", json.dumps(schema).encode())
        self._channels[topic] = self._writer.register_channel(topic, "msgpack", schema_id, version)
        return self._channels[topic]

    def _flush(self) -> None:
        """Closes the chunk and gives it to the system: a kill cannot take it back. Then proves what is there."""
        self._writer.flush()
        self._chunk_bytes = 0
        self._prove(self._file.tell())
        # The system takes the memory of what is on the disk for what comes next; fresh memory costs thrice as much.
        os.posix_fadvise(self._file.fileno(), 0, max(1, self._proved - CACHED_BYTES), os.POSIX_FADV_DONTNEED)

    def _prove(self, end: int) -> None:
        """Reads back what was written since the last time; what is not there has been dropped."""
        found = list(self._read_back(end))
        with self._proving:
            for topic, log_time_ns, record, content in found:
                self._proof.enter(topic, log_time_ns, record, content)
                self._unproved.pop(log_time_ns, None)
        self._drop_unproved()
        self._proved = end

    def _read_back(self, end: int) -> Iterator[tuple[str, int, Record, int]]:
        written = Path(f"/proc/self/fd/{self._file.fileno()}")  # wherever it has been moved to
        if not written.stat().st_nlink:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        with written.open("rb") as file:
            for entry in self._container.entries_at(file, self._proved, end):
                with contextlib.suppress(CodecError):  # of a chunk that is damaged, which the container notes
                    record = unpack(payload_kind(entry.topic), entry.message.data)
                    yield entry.topic, entry.message.log_time, *to_enter(record)

    def _write_verdict(self) -> None:
        self._flush()
        self._writer.add_metadata(VERDICT, replace(self._verdict(), run=self._run_hash).metadata())
        self._writer.finish()
        self._file.flush()
        self._prove(self._file.tell())
        self._whole = True

    def _verdict(self) -> Completeness:
        if self._steps_only:
            return Completeness(False, (), "; ".join([STEPS_ONLY, *self._problems]))
        overflow = f"{self._overflowed} payloads dropped: the disk was too slow" if self._overflowed else ""
        unread = in_short(f"read back: {damage}" for damage in self._container.damage)
        with self._proving:
            missing, counts, found = self._proof.missing(), self._proof.counts, in_short(self._proof.problems())
        reason = "; ".join(filter(None, (*self._problems, overflow, unread, found)))
        return Completeness(not missing and not reason, missing, reason, counts)

    # ------------------------------------------------------------------------------------ what is not recorded

    def _give_up(self, error: BaseException) -> None:
        """Nothing can be written any more: what is waiting, and all that will still come, is named as missing."""
        strerror = error.strerror if isinstance(error, OSError) else None
        reason = strerror or f"{type(error).__name__}: {error}".removesuffix(": ")
        self._problems.append(f"writing failed: {reason}")
        self._drop_unproved()
        self._complain(f"recording ends here: {reason}")

    def _drop_unproved(self) -> None:
        with self._proving:
            for topic, record in self._unproved.values():
                self._proof.drop(topic, record)
        self._unproved.clear()

    def _drop_waiting(self) -> None:
        with self._counting:
            self._closed = True
        for payload in self._waiting:
            if isinstance(payload, _Payload):
                self._drop(payload)
            else:
                payload()
        self._waiting.clear()

    def _drop(self, payload: _Payload) -> None:
        """Counts a payload that is not recorded, and names what it is or speaks of."""
        topic, record = _named(payload.record)
        with self._proving:
            self._proof.drop(topic, record)


class _ChunkBuilder(ChunkBuilder):
    """What is in a chunk; the times of its messages increase."""

    def add_message(self, message: McapMessage) -> None:
        if not self.num_messages:
            self.message_start_time = message.log_time
        self.message_end_time = message.log_time
        self.num_messages += 1
        index = self.message_indices.get(message.channel_id)
        if index is None:
            index = self.message_indices[message.channel_id] = MessageIndex(message.channel_id, [])
        index.records.append((message.log_time, self.record_writer.count))
        self.record_writer.write(message_head(message))
        self.record_writer.write(message.data)


class _ChunkIndex:
    """Where the chunks of the file are, in a file without a name until they stand at its end: the library's list would
    grow with the run, by half a gigabyte a day."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def append(self, index: ChunkIndex) -> None:
        record = RecordBuilder()
        index.write(record)
        self._file.write(record.end())

    def __iter__(self) -> Iterator[_ChunkIndex]:
        yield self

    def write(self, stream: RecordBuilder) -> None:
        self._file.seek(0)
        shutil.copyfileobj(self._file, stream)


def _named(record: Recorded) -> tuple[str, Record]:
    """The topic of a record and what the proof knows it by."""
    match record:
        case Envelope(id=id):
            return MessageId.of(id).topic, id
        case Step():
            return JOURNAL + record.stage, record
        case Lost():
            return LOST + record.stage, record
        case LogLine():
            return LOG + record.stage, record


def _create(path: Path) -> IO[bytes]:
    """A new file, marked as being written; raises Refused where that is not possible."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("xb")
    except OSError as error:
        raise Refused(f"recording {path}: cannot be created: {error.strerror}") from None
    hold(file)
    return file


_SCHEMAS: Mapping[str, dict[str, Any]] = {kind.__name__: msgspec.json.schema(kind) for kind in (Step, LogLine, Lost)}
