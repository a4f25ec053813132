"""Writes everything a graph says into one MCAP file, and at its end whether that was everything."""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import msgspec
from mcap.writer import CompressionType, Writer

from runner.bus import RECORDER, Bus, Packet, Process
from runner.children import die_with_parent
from runner.codec import CodecError, Envelope, LogLine, Step, json_schema, pack, unpack
from runner.container import hold
from runner.contract import Message, Refused
from runner.health import Heart
from runner.provenance import file_hashes, fingerprint, machine, package_versions, portable, revision
from runner.recording import JOURNAL, LOG, PROFILE, RUN, VERDICT, Ledger, Verdict, replicated, split_id, topic_of

FLUSH_SECONDS = 0.25
"""A killed recorder loses no more than this."""
CHUNK_BYTES = 4 * 2**20
EXIT_INCOMPLETE = 1
EXIT_REFUSED = 2
BACKLOG_BYTES = 2**30
"""What may wait for the disk; beyond it payloads are dropped, counted, and the recording is INCOMPLETE."""


Kind = type[Envelope] | type[Step] | type[LogLine]


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
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "revision": revision(),
        "packages": json.dumps(packages),
        "machine": json.dumps(here),
        "fingerprint": fingerprint(here, packages),
        "files": json.dumps(file_hashes(graph)),
    }


@dataclass(frozen=True, slots=True)
class _Payload:
    kind: Kind
    data: bytes
    received_ns: int


class RecordingWriter:
    """One recording being written. ``put`` hands over to the writer's thread and never waits for the disk."""

    def __init__(self, manifest: Manifest, refuse: Callable[[str], None]) -> None:
        """Creates the file with its metadata; raises Refused where that fails.

        ``refuse`` is told, on the writer's thread, of each payload that is not recorded.
        """
        self._refuse = refuse
        self._topics = manifest.topics
        self._file = _create(Path(manifest.path))
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(profile=PROFILE)
        self._writer.add_metadata(RUN, run_metadata(manifest))
        self._writer.flush()
        self._ledger = Ledger(replicated(json.loads(manifest.graph)))
        self._channels: dict[str, int] = {}
        self._queue: queue.SimpleQueue[_Payload | None] = queue.SimpleQueue()
        self._counting = threading.Lock()
        self._waiting_bytes = 0
        self._problems: list[str] = []
        self._dropped = 0
        self._recorded = 0
        self._malformed = 0
        self._thread = threading.Thread(target=self._write_all, name="recording", daemon=True)
        self._thread.start()

    def put(self, kind: Kind, data: bytes) -> None:
        """Takes one payload as it came over the bus."""
        with self._counting:
            if self._waiting_bytes > BACKLOG_BYTES:
                self._dropped += 1
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
            self._problems.append(f"writing failed: {error.strerror}")
            self._refuse(f"recording ends here: {error.strerror}")
            self._waiting_bytes = BACKLOG_BYTES + 1
        finally:
            with contextlib.suppress(OSError):
                self._file.close()

    def _write_payloads(self) -> None:
        due = time.monotonic() + FLUSH_SECONDS
        while True:
            with contextlib.suppress(queue.Empty):
                payload = self._queue.get(timeout=max(0.0, due - time.monotonic()))
                if payload is None:
                    return
                with self._counting:
                    self._waiting_bytes -= len(payload.data)
                self._write(payload)
            if time.monotonic() >= due:
                self._writer.flush()
                due = time.monotonic() + FLUSH_SECONDS

    def _write(self, payload: _Payload) -> None:
        try:
            record = unpack(payload.kind, payload.data)
        except CodecError as error:
            self._malformed += 1
            self._refuse(f"a malformed {payload.kind.__name__} was not recorded: {error}")
            return
        match record:
            case Envelope():
                self._ledger.message(record.id)
                self._add(topic_of(record.id), record.type, payload, record.time_ns, split_id(record.id)[1])
            case Step():
                self._ledger.step(record)
                self._add(JOURNAL + record.stage, "Step", payload, record.time_ns, record.number)
            case LogLine():
                self._add(LOG + record.stage, "LogLine", payload, record.time_ns, 0)

    def _add(self, topic: str, kind: str, payload: _Payload, time_ns: int, sequence: int) -> None:
        self._recorded += 1
        channel = self._channels.get(topic) or self._register(topic, kind)
        self._writer.add_message(channel, payload.received_ns, payload.data, time_ns, sequence % 2**32)

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
        missing = json.dumps(verdict.missing)
        self._writer.add_metadata(VERDICT, {"verdict": verdict.word, "missing": missing, "reason": verdict.reason})
        self._writer.finish()

    def _verdict(self) -> Verdict:
        problems = list(self._problems)
        problems += [f"{self._dropped} payloads dropped: the disk was too slow"] if self._dropped else []
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


_SCHEMAS: Mapping[str, dict[str, Any]] = {kind.__name__: msgspec.json.schema(kind) for kind in (Step, LogLine)}


class Recorder:
    """The recorder's process: subscribes to all of a run before any stage may speak."""

    def __init__(self, manifest: Manifest) -> None:
        """Creates the recording; raises Refused where that fails."""
        self._stopping = threading.Event()
        self._bus = Bus(manifest.run, connect=manifest.endpoint)
        self._writer = RecordingWriter(manifest, self._complain)
        self._echoes: queue.SimpleQueue[tuple[str, bytes] | None] = queue.SimpleQueue()
        self._echo = threading.Thread(target=self._echo_all, name="echo", daemon=True)
        self._heart = Heart(Process(RECORDER, 0), self._bus, self._writer.vitals)

    def run(self) -> Verdict:
        """Records until it is stopped."""
        self._echo.start()
        self._bus.subscribe("m/**", lambda packet: self._writer.put(Envelope, packet.payload))
        self._bus.subscribe("s/*", self._on_step)
        self._bus.subscribe("l/*", lambda packet: self._writer.put(LogLine, packet.payload))
        self._bus.watch(self._on_presence)
        self._bus.answer_flush()
        self._bus.announce(Process(RECORDER, 0))
        self._heart.start()
        self._stopping.wait()
        self._heart.stop()
        self._echoes.put(None)
        self._echo.join(FLUSH_SECONDS)
        self._bus.close()
        return self._writer.close()

    def stop(self) -> None:
        """Ends :meth:`run` after what has arrived. May be called from a signal handler."""
        self._stopping.set()

    def _on_step(self, packet: Packet) -> None:
        self._writer.put(Step, packet.payload)
        self._echoes.put((f"j/{packet.key.partition('/')[2]}", packet.payload))

    def _on_presence(self, process: Process, present: bool) -> None:
        if not present:
            self._echoes.put((f"gone/{process.path}", b""))

    def _echo_all(self) -> None:
        """Tells the others what is here, on a thread of its own: a link that blocks must not stop the recording."""
        while (echo := self._echoes.get()) is not None:
            self._bus.publish(*echo)

    def _complain(self, text: str) -> None:
        """Shows a line; it comes back over the bus and is recorded too."""
        self._bus.publish(f"l/{RECORDER}", pack(LogLine(RECORDER, 0, "error", text, time.time_ns())))


def main() -> int:
    """Records the run on stdin until SIGTERM; exits 0 when the recording is complete, its last line on stderr says
    what is missing."""
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    manifest = msgspec.json.decode(sys.stdin.buffer.read(), type=Manifest)
    try:
        recorder = Recorder(manifest)
    except Refused as refusal:
        print(refusal, file=sys.stderr, flush=True)
        return EXIT_REFUSED
    signal.signal(signal.SIGTERM, lambda *_: recorder.stop())
    verdict = recorder.run()
    print(f"{manifest.path}: {verdict}", file=sys.stderr, flush=True)
    return 0 if verdict.complete else EXIT_INCOMPLETE


if __name__ == "__main__":
    sys.exit(main())
