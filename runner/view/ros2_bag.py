"""Writes what the views of a recording's graph say to ROS 2 into a bag that its tools read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import msgspec

from runner.contract import Message, Refused
from runner.graph.graph import Graph
from runner.graph.reading import graph_from_json
from runner.recording.recording import Recording, opened
from runner.view.views import load_views, require

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer

_VERSION = 9
"""Of the bag's format: Kilted's; Jazzy reads it too."""


class BagMessage(msgspec.Struct, frozen=True):
    """A message of a topic, with all that a bag must know of its type."""

    topic: str
    type: str
    """``package/msg/Name``."""
    definition: str
    """Its text and that of all it is made of."""
    hash: str
    """RIHS01."""
    data: bytes
    """XCDR1."""


@runtime_checkable
class Ros2Views(Protocol):
    """Views that also say what a message is in ROS 2."""

    def ros2(self, message: Message, time_ns: int) -> Iterable[BagMessage]:
        """What one message is, in recorded order; ``time_ns`` is when it was recorded. Nothing for most messages."""
        ...


def export_bag(path: Path, target: Path) -> list[str]:
    """Writes a bag, a folder that has its name once all is written; returns lines that say what is in it.

    Raises Refused where rosbags is missing, the file is no recording, its views say nothing or the target exists.
    """
    require("rosbags", "runner export: rosbags", "ros2")
    from rosbags import rosbag2

    recording = Recording(path)
    graph = graph_from_json(recording.run["graph"], str(path))
    views = load_views(graph)
    if not isinstance(views, Ros2Views):
        raise Refused(f"{path}: its views {graph.view} say nothing to ROS 2; they have no method ros2")
    if target.exists():
        raise Refused(f"{target}: cannot be written: File exists")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=target.parent, prefix=f"{target.name}.") as part:
            written_to, plugin = Path(part, target.name), rosbag2.StoragePlugin.MCAP
            with rosbag2.Writer(written_to, version=_VERSION, storage_plugin=plugin) as writer:
                counts = _write(writer, _said(recording, graph, views))
            written_to.rename(target)
    except (rosbag2.WriterError, OSError) as error:
        raise Refused(f"{target}: cannot be written: {error}") from None
    written = [f"{target}: {count} messages of {topic}" for topic, count in sorted(counts.items())]
    return [f"{path}: {recording.verdict}", *(written or [f"{target}: nothing to say"])]


def _write(writer: Writer, messages: Iterable[tuple[int, BagMessage]]) -> Counter[str]:
    """Returns how many there are by topic."""
    counts: Counter[str] = Counter()
    connections: dict[str, Connection] = {}
    for time_ns, one in messages:
        if one.topic not in connections:
            added = writer.add_connection(one.topic, one.type, msgdef=one.definition, rihs01=one.hash)
            connections[one.topic] = added
        writer.write(connections[one.topic], time_ns, one.data)
        counts[one.topic] += 1
    return counts


def _said(recording: Recording, graph: Graph, views: Ros2Views) -> Iterator[tuple[int, BagMessage]]:
    """In the order of recording, with the times of it."""
    for id, message in recording.messages.items():
        if (content := opened(graph, recording.envelope(id))) is not None:
            for one in views.ros2(content, message.log_time_ns):
                yield message.log_time_ns, one
