"""One recording being written: an MCAP file that ends with a verdict on whether everything is there."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import msgspec
from mcap.writer import CompressionType, Writer

from runner.contract import Message, Refused
from runner.graph.graph import Destination
from runner.graph.placement import Network
from runner.message.codec import CodecError, Envelope, LogLine, Lost, Step, json_schema, unpack
from runner.recording.container import hold
from runner.recording.provenance import (
    file_hashes,
    fingerprint,
    machine,
    numerical,
    package_versions,
    portable,
    revision,
    runner_version,
)
from runner.recording.recording import (
    JOURNAL,
    LOG,
    PROFILE,
    RUN,
    STEPS_ONLY,
    VERDICT,
    Ledger,
    Verdict,
    replicated,
    split_id,
    topic_of,
)

FLUSH_SECONDS = 0.25
"""A killed recorder loses no more than this."""
CHUNK_BYTES = 4 * 2**20
REST_SECONDS = 0.02
"""What may come together before it is written."""
BACKLOG_BYTES = 2**30
"""What may wait for the disk; beyond it payloads are dropped, counted, and the recording is INCOMPLETE."""
CACHED_BYTES = 2**25
"""Newest part of a recording that the system keeps in memory, for those who read it as it grows."""

Kind = type[Envelope] | type[Step] | type[LogLine] | type[Lost]


class Topic(msgspec.Struct, frozen=True):
    """What is recorded under one topic."""

    type: str
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
    destinations: dict[str, tuple[Destination, ...]] = {}
    """Where messages go, by topic."""


def topic(kind: type[Message]) -> Topic:
    """Describes the topic of a message type."""
    return Topic(kind.__name__, kind.version, json_schema(kind))


def run_metadata(manifest: Manifest) -> dict[str, str]:
    """What ran where, as the recording keeps it: one JSON text per aspect."""
    graph = portable(json.loads(manifest.graph), Path.cwd())
    here, packages = machine(), package_versions()
    return {
        "graph": json.dumps(graph),
        "name": graph["name"],
        "seed": str(graph["seed"]),
        "settings": json.dumps(manifest.settings),
        "records": STEPS_ONLY if manifest.steps_only else "messages and steps",
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "revision": revision(graph),
        "runner": runner_version(),
        "packages": json.dumps(packages),
        "machine": json.dumps(here),
        "fingerprint": fingerprint(here, packages, numerical(graph)),
        "files": json.dumps(file_hashes(graph)),
    }


@dataclass(frozen=True, slots=True)
class _Payload:
    kind: Kind
    data: bytes | memoryview
    received_ns: int


class RecordingWriter:
    """One recording being written. ``put`` hands over to the writer's thread and never waits for the disk."""

    def __init__(self, manifest: Manifest, refuse: Callable[[str], None]) -> None:
        """Creates the file with its metadata; raises Refused where that fails.

        ``refuse`` is told, on the writer's thread, of each payload that is not recorded.
        """
        self._refuse = refuse
        self._steps_only = manifest.steps_only
        self._topics = manifest.topics
        self._file = _create(Path(manifest.path))
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(profile=PROFILE)
        self._writer.add_metadata(RUN, run_metadata(manifest))
        self._writer.flush()
        self._file.flush()
        self._ledger = Ledger(replicated(json.loads(manifest.graph)))
        self._channels: dict[str, int] = {}
        self._queue: queue.SimpleQueue[_Payload | Callable[[], None] | None] = queue.SimpleQueue()
        self._counting = threading.Lock()
        self._waiting_bytes = 0
        self._end = self._file.tell()
        self._unlooked = 0
        """Bytes since it was last asked whether a chunk has closed."""
        self._unflushed: list[str] = []
        """Ids that the system does not have yet."""
        self._problems: list[str] = []
        self._dropped = 0
        self._recorded = 0
        self._malformed = 0
        self._thread = threading.Thread(target=self._write_all, name="recording", daemon=True)
        self._thread.start()

    def put(self, kind: Kind, data: bytes | memoryview) -> None:
        """Takes one payload as it came over the bus."""
        with self._counting:
            if self._waiting_bytes > BACKLOG_BYTES:
                self._lose(kind, data)
                return
            self._waiting_bytes += len(data)
            self._queue.put(_Payload(kind, data, time.time_ns()))

    def vitals(self) -> dict[str, Any]:
        """What the recorder's pulse says: records that are written, were refused and wait for the disk."""
        return {
            "state": "working" if self._queue.qsize() else "waiting",
            "steps": self._recorded,
            "refused": self._malformed,
            "queued": {"disk": self._queue.qsize()},
        }

    def after_flush(self, action: Callable[[], None]) -> None:
        """Acts, on the writer's thread, once everything that was put before can be read in the file."""
        self._queue.put(action)
        if not self._thread.is_alive():  # nothing more will be
            action()

    def lament(self, problem: str) -> None:
        """Has the verdict name a reason why not everything may be there."""
        self._problems.append(problem)

    def close(self) -> Verdict:
        """Writes what is waiting, the verdict and the end of the file."""
        self._queue.put(None)
        self._thread.join()
        return self._verdict()

    def _write_all(self) -> None:
        try:
            self._write_payloads()
            self._write_verdict()
        except OSError as error:
            self._give_up(error)
        finally:
            with contextlib.suppress(OSError):
                self._file.close()

    def _give_up(self, error: OSError) -> None:
        """Nothing can be written any more: what is waiting, and all that will still come, is named as missing."""
        with self._counting:
            self._waiting_bytes = BACKLOG_BYTES + 1
            self._problems.append(f"writing failed: {error.strerror}")
            for id in self._unflushed:
                self._ledger.lost(id)
            while not self._queue.empty():
                payload = self._queue.get()
                if isinstance(payload, _Payload):
                    self._lose(payload.kind, payload.data)
                elif payload is not None:
                    payload()
        self._refuse(f"recording ends here: {error.strerror}")

    def _lose(self, kind: Kind, data: bytes | memoryview) -> None:
        """Counts a payload that is not recorded, and names what it is or speaks of."""
        self._dropped += 1
        with contextlib.suppress(CodecError):
            match unpack(kind, data):
                case Envelope(id=id):
                    self._ledger.lost(id)
                case Step() as step:
                    self._ledger.step(step)
                case _:
                    pass

    def _write_payloads(self) -> None:
        due = time.monotonic() + FLUSH_SECONDS
        while self._write_waiting(due):
            if time.monotonic() >= due:
                self._flush()
                due = time.monotonic() + FLUSH_SECONDS
            time.sleep(REST_SECONDS)

    def _write_waiting(self, due: float) -> bool:
        """Writes what waits until ``due``, when a chunk closes; waits for something. False at the end."""
        with contextlib.suppress(queue.Empty):
            payload = self._queue.get(timeout=max(0.0, due - time.monotonic()))
            while payload is not None:
                if isinstance(payload, _Payload):
                    self._write(payload)
                    self._hand_over_closed_chunk(len(payload.data))
                else:
                    self._flush()
                    payload()
                if time.monotonic() >= due:
                    return True
                payload = self._queue.get_nowait()
            return False
        return True

    def _hand_over_closed_chunk(self, size: int) -> None:
        """After some bytes more: a chunk closes by size too. Not after each few, for the system is asked."""
        self._unlooked += size
        if self._unlooked > CHUNK_BYTES // 8:
            self._unlooked = 0
            if self._file.tell() > self._end:
                self._handed_over()

    def _flush(self) -> None:
        """Closes the chunk by time."""
        self._writer.flush()
        self._handed_over()

    def _handed_over(self) -> None:
        """Gives the system what closed chunks hold: a kill cannot take it back, also where a chunk closed by size."""
        self._file.flush()
        self._unflushed.clear()
        self._end = self._file.tell()
        # The system takes the memory of what is on the disk for what comes next; fresh memory costs thrice as much.
        os.posix_fadvise(self._file.fileno(), 0, max(1, self._end - CACHED_BYTES), os.POSIX_FADV_DONTNEED)

    def _write(self, payload: _Payload) -> None:
        with self._counting:
            self._waiting_bytes -= len(payload.data)
        try:
            record = unpack(payload.kind, payload.data)
        except CodecError as error:
            self._malformed += 1
            self._refuse(f"a malformed {payload.kind.__name__} was not recorded: {error}")
            return
        match record:
            case Envelope():
                self._ledger.message(record.id)
                self._unflushed.append(record.id)
                self._add(topic_of(record.id), record.type, payload, record.time_ns, split_id(record.id)[1])
            case Step():
                self._ledger.step(record)
                self._add(JOURNAL + record.stage, "Step", payload, record.time_ns, record.number)
            case Lost():
                self._add("lost/" + record.stage, "Lost", payload, record.time_ns, 0)
            case LogLine():
                self._add(LOG + record.stage, "LogLine", payload, record.time_ns, 0)

    def _add(self, topic: str, kind: str, payload: _Payload, time_ns: int, sequence: int) -> None:
        self._recorded += 1
        channel = self._channels.get(topic) or self._register(topic, kind)
        data = cast("bytes", payload.data)  # which need not be in one
        self._writer.add_message(channel, payload.received_ns, data, time_ns, sequence % 2**32)

    def _register(self, topic: str, kind: str) -> int:
        known = self._topics.get(topic)
        schema = known.schema if known else _SCHEMAS.get(kind, {})
        version = {"version": str(known.version)} if known else {}
        schema_id = self._writer.register_schema(kind, "jsonschema", json.dumps(schema).encode())
        self._channels[topic] = self._writer.register_channel(topic, "msgpack", schema_id, version)
        return self._channels[topic]

    def _write_verdict(self) -> None:
        verdict = self._verdict()
        self._writer.flush()
        self._writer.add_metadata(VERDICT, verdict.metadata())
        self._writer.finish()

    def _verdict(self) -> Verdict:
        if self._steps_only:
            return Verdict(False, (), "; ".join([STEPS_ONLY, *self._problems]))
        problems = list(self._problems)
        reason = "" if self._problems else ": the disk was too slow"
        problems += [f"{self._dropped} payloads dropped{reason}"] if self._dropped else []
        missing = self._ledger.missing()
        return Verdict(not missing and not problems, missing, "; ".join(problems))


def _create(path: Path) -> IO[bytes]:
    """A new file, marked as being written; raises Refused where that is not possible."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("xb")
    except OSError as error:
        raise Refused(f"recording {path}: cannot be created: {error.strerror}") from None
    hold(file)
    return file


_SCHEMAS: Mapping[str, dict[str, Any]] = {kind.__name__: msgspec.json.schema(kind) for kind in (Step, Lost, LogLine)}
