"""Makes recordings of the toy graph without processes: the same steps, journal and writer as in a run."""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from runner.graph.graph import Graph, graph_to_json, load_graph
from runner.message.codec import Envelope, LogLine, Step, pack
from runner.message.ids import MessageId
from runner.recording.recording import RUN, Verdict
from runner.recording.writer import Manifest, RecordingWriter, topic
from runner.testing import Bench, Done

TOYS = Path(__file__).with_name("toys.yaml")
Keep = Callable[[Envelope | Step], Envelope | Step | None]


def manifest(graph: Graph, path: Path, settings: tuple[str, ...] = ()) -> Manifest:
    topics = {
        f"{node.name}/{port}": topic(kind) for node in graph.nodes.values() for port, kind in node.type.outputs.items()
    }
    return Manifest("test", "", str(path), graph_to_json(graph), settings, topics)


def record_toys(
    folder: Path, *settings: str, keep: Keep = lambda record: record, log: Iterable[LogLine] = ()
) -> tuple[Path, Verdict]:
    """Runs the toy graph in this process and records what ``keep`` lets through."""
    path = folder / "toys.mcap"
    settings = (f"sink.path={folder / 'out.txt'}", *settings)
    graph = load_graph(TOYS, settings)
    writer = RecordingWriter(manifest(graph, path, settings), print)
    for record in _run(graph, folder):
        kept = keep(record)
        if kept is not None:
            writer.put(type(kept), pack(kept))
    for line in log:
        writer.put(LogLine, pack(line))
    return path, writer.close()


def _run(graph: Graph, folder: Path) -> Iterator[Envelope | Step]:
    """Steps every stage until nothing is left to do."""
    benches = {
        node.name: Bench(node, node.construct(), seed=graph.seed, directory=folder, log=lambda *_: None)
        for node in graph.nodes.values()
    }
    numbers = Counter[str]()
    sent: deque[Envelope] = deque()

    def records(stage: str, steps: Iterable[Done]) -> Iterator[Envelope | Step]:
        for done in steps:
            sent.extend(done.emitted)
            yield from done.emitted
            consumed = tuple((arrival.port.name, arrival.envelope.id) for arrival in done.ready.arrivals)
            emitted = tuple(sealed.id for sealed in done.emitted)
            time_ns = done.emitted[0].time_ns if done.emitted else 0
            yield Step(stage, 0, 0, numbers[stage], done.ready.handler.name, consumed, emitted, time_ns, 0, 0, 1000)
            numbers[stage] += 1

    for stage, bench in benches.items():
        yield from records(stage, bench.advance())
    while sent:
        sealed = sent.popleft()
        id = MessageId.of(sealed.id)
        for route in (route for route in graph.routes(id.stage) if route.output == id.port):
            yield from records(route.consumer, benches[route.consumer].take(route.input, sealed))


def rewrite(
    source: Path, target: Path, change: Callable[[str, bytes], bytes], aspects: Mapping[str, str] | None = None
) -> Path:
    """Copies a recording; ``change`` gets each topic and payload and returns what is kept in its place, ``aspects``
    replace what its metadata says of the run."""
    with source.open("rb") as file, target.open("wb") as output:
        reader, writer = make_reader(file), Writer(output)
        writer.start()
        for metadata in reader.iter_metadata():
            changed = aspects or {} if metadata.name == RUN else {}
            writer.add_metadata(metadata.name, {**metadata.metadata, **changed})
        channels: dict[str, int] = {}
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(channel.topic, "msgpack", 0)
            data = change(channel.topic, message.data)
            times = (message.log_time, data, message.publish_time, message.sequence)
            writer.add_message(channels[channel.topic], *times)
        writer.finish()
    return target
