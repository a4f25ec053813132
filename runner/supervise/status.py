"""What a supervisor answers when it is asked how its run goes."""

from __future__ import annotations

import time
from collections import defaultdict, deque

import msgspec

from runner.graph.graph import SUPERVISOR, Graph
from runner.message.codec import Pulse

SILENT_NS = 3_000_000_000
WINDOW = 7
"""Pulses over which rates are taken: three seconds."""


class Flow(msgspec.Struct, frozen=True):
    """What one process sends on one output port."""

    messages: int
    per_second: float
    bytes_per_second: float


class ProcessStatus(msgspec.Struct, frozen=True):
    """One process of the graph, or the recorder."""

    stage: str
    replica: int
    name: str
    """As log lines call it: with the replica's number where there are several."""
    state: str
    """``starting``, what its newest pulse says, ``silent`` where that is old, or ``ended``."""
    pid: int
    restarts: int
    reason: str = ""
    """Why it was restarted the last time."""
    pulse: Pulse | None = None
    cpu: float = 0.0
    """Cores in use."""
    steps_per_second: float = 0.0
    sent: dict[str, Flow] = {}
    """By output port."""


class TopicStatus(msgspec.Struct, frozen=True):
    """One output port of the graph."""

    topic: str
    """``stage/port``."""
    type: str
    consumers: tuple[str, ...]
    """As ``stage.port``."""


class RunStatus(msgspec.Struct, frozen=True):
    """A whole run."""

    run: str
    graph: str
    """Path of the graph file."""
    recording: str
    endpoint: str
    started: float
    """Seconds since the epoch."""
    ready: bool
    """Whether every process has been ready at least once, and the recorder is."""
    processes: tuple[ProcessStatus, ...]
    topics: tuple[TopicStatus, ...]
    published: dict[str, int] = {}
    """Messages of the supervisor's own, by topic."""


class Rates:
    """The pulses of the last seconds, from which rates are taken."""

    def __init__(self) -> None:
        self._pulses: dict[tuple[str, int], deque[tuple[int, Pulse]]] = defaultdict(lambda: deque(maxlen=WINDOW))

    def note(self, pulse: Pulse, arrived_ns: int) -> None:
        """Takes a pulse; those of an earlier incarnation count no more."""
        window = self._pulses[pulse.stage, pulse.replica]
        if window and window[-1][1].pid != pulse.pid:
            window.clear()
        window.append((arrived_ns, pulse))

    def state(self, stage: str, replica: int) -> str:
        """What the newest pulse says, or ``silent`` where none has come for a while."""
        arrived_ns, newest = self._ends(stage, replica)[1]
        return newest.state if time.monotonic_ns() - arrived_ns < SILENT_NS else "silent"

    def cpu(self, stage: str, replica: int) -> float:
        """Processor time per time of one process."""
        (began, first), (ended, last) = self._ends(stage, replica)
        return (last.cpu_ns - first.cpu_ns) / (ended - began)

    def steps(self, stage: str, replica: int) -> float:
        """Steps per second of one process."""
        (began, first), (ended, last) = self._ends(stage, replica)
        return (last.steps - first.steps) / (ended - began) * 1e9

    def sent(self, stage: str, replica: int) -> dict[str, Flow]:
        """What one process sends, by output port."""
        (began, first), (ended, last) = self._ends(stage, replica)
        seconds = (ended - began) * 1e-9
        flows: dict[str, Flow] = {}
        for port, (messages, size) in last.sent.items():
            before, size_before = first.sent.get(port, (0, 0))
            flows[port] = Flow(messages, (messages - before) / seconds, (size - size_before) / seconds)
        return flows

    def _ends(self, stage: str, replica: int) -> tuple[tuple[int, Pulse], tuple[int, Pulse]]:
        window = list(self._pulses[stage, replica])
        nothing = Pulse(stage, replica, 0, 0, "")
        (began, first), (ended, last) = (window[0], window[-1]) if window else ((0, nothing), (0, nothing))
        return (began, first), (max(ended, began + 1), last)


def topics_of(graph: Graph) -> tuple[TopicStatus, ...]:
    """Every output port of a graph, the supervisor's last."""
    return tuple(
        TopicStatus(f"{stage}/{port}", kind.__name__, _consumers(graph, stage, port))
        for stage in (*graph.nodes, SUPERVISOR)
        for port, kind in graph.outputs_of(stage).items()
    )


def _consumers(graph: Graph, stage: str, port: str) -> tuple[str, ...]:
    return tuple(f"{route.consumer}.{route.input}" for route in graph.routes(stage) if route.output == port)
