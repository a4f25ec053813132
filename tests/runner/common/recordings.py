"""Makes recordings of the toy graph without processes: the same steps, journal and writer as in a run."""

import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import MAGIC_SIZE
from mcap.writer import CompressionType, Writer

from runner.graph.graph import SUPERVISOR, Graph, graph_to_json
from runner.graph.reading import load_graph
from runner.message.codec import Envelope, LogLine, Lost, Step, pack
from runner.message.ids import MessageId
from runner.process.inbox import Inbox, Ready
from runner.process.step import Executor, receive, step_time
from runner.recording.recording import RUN, VERDICT, Completeness, hash_of
from runner.recording.writer import Manifest, RecordingWriter, topic
from tests.runner.common.runs import TOYS

Keep = Callable[[Envelope | Step], Envelope | Step | None]
Recorded = Envelope | Step | LogLine | Lost


def manifest(graph: Graph, path: Path, settings: tuple[str, ...] = ()) -> Manifest:
    topics = {
        f"{node.name}/{port}": topic(kind) for node in graph.nodes.values() for port, kind in node.type.outputs.items()
    }
    return Manifest("test", "", str(path), graph_to_json(graph), settings, topics)


def record_toys(
    folder: Path, *settings: str, keep: Keep = lambda record: record, more: Iterable[Recorded] = ()
) -> tuple[Path, Completeness]:
    """Runs the toy graph in this process and records what ``keep`` lets through, and ``more``."""
    settings = (f"sink.path={folder / 'out.txt'}", *settings)
    graph = load_graph(TOYS, settings)
    kept = filter(None, map(keep, ToyRun(graph, folder).records()))
    return record(graph, folder / "toys.mcap", [*kept, *more], settings)


def put(writer: RecordingWriter, record: Recorded) -> None:
    """Hands a record to its writer with its bytes, as the recorder does."""
    writer.put(record, pack(record))


def record(
    graph: Graph, path: Path, records: Iterable[Recorded], settings: tuple[str, ...] = ()
) -> tuple[Path, Completeness]:
    """A recording of these records."""
    writer = RecordingWriter(manifest(graph, path, settings), print)
    for one in records:
        put(writer, one)
    return path, writer.close()


class ToyRun:
    """Runs a graph in this process: the records of its processes, in an order in which they may come."""

    def __init__(self, graph: Graph, folder: Path) -> None:
        self._graph = graph
        self._executors = {
            node.name: Executor(node, node.construct(), seed=graph.seed, directory=folder, log=lambda *_: None)
            for node in graph.nodes.values()
        }
        self._inboxes = {process: Inbox(graph.nodes[process[0]]) for process in graph.processes()}
        self._numbers = dict.fromkeys([*graph.processes(), (SUPERVISOR, 0)], 0)
        self._left = {process: dict[tuple[str, str], None]() for process in graph.processes()}
        """What has arrived and was not consumed."""
        self._sent: deque[Envelope] = deque()

    def records(self) -> Iterator[Envelope | Step]:
        """Steps every process until nothing is left to do, and ends it."""
        for node in self._graph.nodes.values():
            if node.type.source is not None:
                for draft in self._executors[node.name].advance(node.type.source, time.time_ns):
                    yield from self._emitted((node.name, 0), "source", (), [draft.envelope])
        while self._sent:
            yield from self._delivered(self._sent.popleft())
        for process in self._numbers:
            yield self._step(process, "", outcome="ended", left=tuple(self._left.get(process, ())))

    def _delivered(self, sealed: Envelope) -> Iterator[Envelope | Step]:
        """To one replica in turn where they share it, else to each."""
        id = MessageId.of(sealed.id)
        for route in self._graph.routes(id.stage):
            node = self._graph.nodes[route.consumer]
            if route.output == id.port:
                for replica in (id.sequence % node.replicas,) if route.shared else range(node.replicas):
                    process = node.name, replica
                    self._left[process][route.input, sealed.id] = None
                    self._inboxes[process].add(receive(node.type.inputs[route.input], sealed))
                    while ready := self._inboxes[process].pop():
                        yield from self._worked_on(process, ready)

    def _worked_on(self, process: tuple[str, int], ready: Ready) -> Iterator[Envelope | Step]:
        node = self._graph.nodes[process[0]]
        time_ns = step_time(node, ready.arrivals, time.time_ns())
        out = list(self._executors[node.name].run(ready.handler, ready.arrivals, time_ns))
        consumed = tuple((arrival.port.name, arrival.envelope.id) for arrival in ready.arrivals)
        for one in consumed:
            self._left[process].pop(one, None)
        yield from self._emitted(process, ready.handler.name, consumed, out)

    def _emitted(
        self, process: tuple[str, int], handler: str, consumed: tuple[tuple[str, str], ...], out: list[Envelope]
    ) -> Iterator[Envelope | Step]:
        self._sent.extend(out)
        ids = tuple(sealed.id for sealed in out)
        time_ns = out[0].time_ns if out else 0
        yield from [*out, self._step(process, handler, consumed=consumed, emitted=ids, time_ns=time_ns)]

    def _step(self, process: tuple[str, int], handler: str, **fields: Any) -> Step:
        number, self._numbers[process] = self._numbers[process], self._numbers[process] + 1
        step = Step(*process, 0, number, handler, (), (), 0, 0, 0, 1000)
        return msgspec.structs.replace(step, **fields)


def offsets(content: bytes | bytearray, opcode: Opcode) -> list[int]:
    """Where the records of a kind begin in an MCAP file."""
    at, found = MAGIC_SIZE, list[int]()
    while at < len(content) - MAGIC_SIZE:
        kind, length = struct.unpack_from("<BQ", content, at)
        found += [at] if kind == opcode else []
        at += 9 + length
    return found


def rewrite(
    source: Path,
    target: Path,
    change: Callable[[str, bytes], bytes],
    aspects: Mapping[str, str] | None = None,
    compression: CompressionType = CompressionType.ZSTD,
) -> Path:
    """Copies a recording; ``change`` gets each topic and payload and returns what is kept in its place, ``aspects``
    replace what its metadata says of the run."""
    with source.open("rb") as file, target.open("wb") as output:
        reader, writer = make_reader(file), Writer(output, compression=compression)
        writer.start()
        metadata = {found.name: found.metadata for found in reader.iter_metadata()}
        run = {**metadata.pop(RUN), **(aspects or {})}
        writer.add_metadata(RUN, run)
        if "run" in metadata.get(VERDICT, {}):
            metadata[VERDICT]["run"] = hash_of(run)
        channels: dict[str, int] = {}
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(channel.topic, "msgpack", 0)
            data = change(channel.topic, message.data)
            times = (message.log_time, data, message.publish_time, message.sequence)
            writer.add_message(channels[channel.topic], *times)
        writer.flush()
        for name, values in metadata.items():
            writer.add_metadata(name, values)
        writer.finish()
    return target
