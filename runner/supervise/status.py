"""What a supervisor answers when it is asked how its run goes."""

from __future__ import annotations

from collections import defaultdict, deque
from typing import Any

import msgspec

from runner.contract import name_of
from runner.graph.graph import Graph
from runner.message.codec import Pulse
from runner.message.packet import Process

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
    name: str
    """As log lines call it: with the replica's number where there are several."""
    state: str
    """``starting``, what its newest pulse says, ``silent`` while none comes, or ``ended``."""
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
    """A whole run, beyond its :class:`runner.supervise.registry.Entry`."""

    endpoint: str
    """Where others may listen to it."""
    ready: bool
    """Whether every process has been ready at least once, and the recorder is."""
    processes: tuple[ProcessStatus, ...]
    topics: tuple[TopicStatus, ...]
    published: dict[str, int] = {}
    """Messages of the supervisor's own, by topic."""


class Pulses:
    """The newest pulses of every process, from which its rates are taken."""

    def __init__(self) -> None:
        self._pulses = defaultdict[Process, deque[tuple[int, Pulse]]](lambda: deque(maxlen=WINDOW))

    def note(self, pulse: Pulse, arrived_ns: int) -> None:
        """Takes a pulse as it comes."""
        self._pulses[pulse.process].append((arrived_ns, pulse))

    def newest(self, process: Process) -> Pulse | None:
        """The newest of a process, if any has come."""
        window = self._pulses.get(process)
        return window[-1][1] if window else None

    def rates(self, process: Process) -> dict[str, Any]:
        """What of a :class:`ProcessStatus` is a rate."""
        window = list(self._pulses.get(process, ()))
        if not window:
            return {}
        (began, first), (ended, last) = window[0], window[-1]
        seconds = max(ended - began, 1) * 1e-9
        return {
            "cpu": (last.cpu_ns - first.cpu_ns) * 1e-9 / seconds,
            "steps_per_second": (last.steps - first.steps) / seconds,
            "sent": {port: _flow(first.sent.get(port, (0, 0)), sent, seconds) for port, sent in last.sent.items()},
        }


def _flow(before: tuple[int, int], now: tuple[int, int], seconds: float) -> Flow:
    return Flow(now[0], (now[0] - before[0]) / seconds, (now[1] - before[1]) / seconds)


def topics_of(graph: Graph) -> tuple[TopicStatus, ...]:
    """Every output port of a graph, the supervisor's last."""
    goes_to = graph.destinations()
    return tuple(
        TopicStatus(topic, name_of(kind), tuple(f"{route.consumer}.{route.input}" for route in goes_to.get(topic, ())))
        for topic, kind in graph.topics().items()
    )
