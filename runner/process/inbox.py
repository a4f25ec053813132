"""Puts messages together to steps: joins and gathers by lineage, whatever the order of arrival."""

import threading
from collections import OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import cast

import msgspec

from runner.contract import Part
from runner.graph.graph import Node
from runner.graph.ports import Handler, InputPort
from runner.message.packet import Packet
from runner.process.step import Arrival


class Mailbox:
    """What has arrived and is not decoded, in order of arrival; of a port of policy ``latest`` only the newest."""

    def __init__(self, node: Node):
        self._latest = {port for port, edge in node.inputs.items() if edge.policy == "latest"}
        self._queue: deque[Packet | str] = deque()
        self._newest: dict[str, Packet] = {}
        self._exchanging = threading.Lock()
        self._come = dict.fromkeys(node.inputs, 0)
        """By port."""
        self._fetched = dict.fromkeys(node.inputs, 0)
        self.replaced = dict.fromkeys(node.inputs, 0)
        """Messages that a newer one replaced before they were decoded."""

    def put(self, packet: Packet) -> None:
        """Takes a packet, from any thread."""
        port = packet.end
        with self._exchanging:
            if port not in self._latest or not packet.genuine:
                if port in self._come:
                    self._come[port] += 1
                self._queue.append(packet)
                return
            self.replaced[port] += port in self._newest
            if port not in self._newest:
                self._queue.append(port)
            self._newest[port] = packet

    @property
    def empty(self) -> bool:
        """Whether there is nothing to take."""
        return not self._queue

    def take(self) -> Iterator[Packet]:
        """Every packet that is there."""
        while self._queue:
            yield self._fetch(self._queue.popleft())

    def _fetch(self, item: Packet | str) -> Packet:
        if isinstance(item, str):
            with self._exchanging:
                return self._newest.pop(item)
        if (port := item.end) in self._fetched:
            self._fetched[port] += 1
        return item

    def waiting(self, port: str) -> int:
        """How many packets of a port wait. May be called from any thread."""
        return self._come[port] - self._fetched[port] + (port in self._newest)


class Mismatched(Exception):
    """A message that contradicts what came before it: another count, or the same index twice."""


class Ready(msgspec.Struct, frozen=True):
    """A handler and everything it needs, in the order of its parameters."""

    handler: Handler
    arrivals: tuple[Arrival, ...]


@dataclass(slots=True)
class _Lineage:
    """What has come of one lineage for one handler."""

    waiting: dict[str, deque[Arrival]] = field(default_factory=dict[str, deque[Arrival]])
    """By port, in order of arrival."""


class Inbox:
    """Everything that has arrived at one process and is not consumed yet."""

    def __init__(self, node: Node):
        self._node = node
        self._lineages = {handler.name: OrderedDict[str, _Lineage]() for handler in node.type.handlers}
        self._turns = {handler.name: deque[str]() for handler in node.type.handlers}
        self._ready: deque[Ready] = deque()
        self.waiting = dict.fromkeys(node.inputs, 0)
        """Messages that no step has taken yet, by port; not those that a join keeps for its parts."""
        self.skipped = dict.fromkeys(node.inputs, 0)
        """Messages that a newer one replaced, by port, on edges of policy ``latest``."""

    def add(self, arrival: Arrival) -> None:
        """Takes a message; raises Mismatched for a part that contradicts its siblings."""
        handler = self._node.type.handler_of(arrival.port.name)
        if self._node.inputs[arrival.port.name].policy == "latest":
            self._discard_older(handler, arrival.port)
        if len(handler.inputs) == 1 and arrival.port.kind == "one":
            self._count(handler, arrival.port, 1)
            self._ready.append(Ready(handler, (arrival,)))
            return
        lineage = self._lineages[handler.name].setdefault(arrival.envelope.lineage, _Lineage())
        waiting = lineage.waiting.setdefault(arrival.port.name, deque())
        if arrival.port.kind == "gather":
            _check_siblings(arrival, waiting)
        waiting.append(arrival)
        self._count(handler, arrival.port, 1)
        if arrival.port == _turn_port(handler):
            self._turns[handler.name].append(arrival.envelope.lineage)
        self._ready.extend(self._complete(handler, arrival.envelope.lineage))
        self._forget_oldest(handler)

    @property
    def has_ready(self) -> bool:
        """Whether a step could run now."""
        return bool(self._ready)

    def pop(self) -> Ready | None:
        """The next step in order of completion, or None."""
        if not self._ready:
            return None
        ready = self._ready.popleft()
        for arrival in ready.arrivals:
            self._count(ready.handler, arrival.port, -1)
        return ready

    def incomplete(self) -> Iterator[tuple[Handler, str, list[str]]]:
        """(handler, lineage, ports that lack) for everything that cannot run yet."""
        for handler in self._node.type.handlers:
            for root, lineage in self._lineages[handler.name].items():
                lacking = [port.name for port in handler.inputs if not _satisfied(port, lineage)]
                if any(lineage.waiting.get(port.name) for port in handler.inputs if not handler.keeps(port)):
                    yield handler, root, lacking

    def _complete(self, handler: Handler, newest: str) -> Iterator[Ready]:
        """Steps that can run now: those of the newest lineage, or where gathers take turns, of all whose turn it is."""
        if _turn_port(handler) is None:
            yield from self._steps(handler, newest)
        turns = self._turns[handler.name]
        while turns and (steps := list(self._steps(handler, turns[0]))):
            yield from steps
            turns.popleft()

    def _steps(self, handler: Handler, root: str) -> Iterator[Ready]:
        lineage = self._lineages[handler.name].get(root, _Lineage())
        while all(_satisfied(port, lineage) for port in handler.inputs):
            arrivals = [arrival for port in handler.inputs for arrival in _take(handler, port, lineage)]
            yield Ready(handler, tuple(arrivals))
        if not any(lineage.waiting.values()):
            self._lineages[handler.name].pop(root, None)

    def _discard_older(self, handler: Handler, port: InputPort) -> None:
        for lineage in self._lineages[handler.name].values():
            self._skip(handler, port, len(lineage.waiting.pop(port.name, ())))
        if port == _turn_port(handler):
            self._turns[handler.name].clear()
        if len(handler.inputs) == 1:
            kept = [ready for ready in self._ready if ready.handler is not handler]
            self._skip(handler, port, len(self._ready) - len(kept))
            self._ready = deque(kept)

    def _skip(self, handler: Handler, port: InputPort, number: int) -> None:
        self.skipped[port.name] += number
        self._count(handler, port, -number)

    def _count(self, handler: Handler, port: InputPort, number: int) -> None:
        if not handler.keeps(port):
            self.waiting[port.name] += number

    def _forget_oldest(self, handler: Handler) -> None:
        """Drops the oldest lineages of which only what stays is left: their parts have been worked on."""
        limit = 2 * max((self._node.inputs[port.name].queue for port in handler.inputs), default=0)
        lineages = self._lineages[handler.name]
        while len(lineages) > limit:
            finished = next((root for root, lineage in lineages.items() if _only_stays(handler, lineage)), None)
            if finished is None:
                return
            del lineages[finished]


def _turn_port(handler: Handler) -> InputPort | None:
    """The port beside a gather whose order of arrival its steps keep: replicas finish lineages in any order."""
    if all(port.kind == "one" for port in handler.inputs):
        return None
    return next((port for port in handler.inputs if port.kind == "one"), None)


def _only_stays(handler: Handler, lineage: _Lineage) -> bool:
    return not any(lineage.waiting.get(port.name) for port in handler.inputs if not handler.keeps(port))


def _satisfied(port: InputPort, lineage: _Lineage) -> bool:
    waiting = lineage.waiting.get(port.name)
    if not waiting:
        return False
    return port.kind == "one" or len(waiting) == cast("Part", waiting[0].message).count


def _take(handler: Handler, port: InputPort, lineage: _Lineage) -> list[Arrival]:
    waiting = lineage.waiting[port.name]
    if port.kind == "gather":
        lineage.waiting[port.name] = deque()
        return sorted(waiting, key=lambda arrival: cast("Part", arrival.message).index)
    return [waiting[-1]] if handler.keeps(port) else [waiting.popleft()]


def _check_siblings(arrival: Arrival, siblings: deque[Arrival]) -> None:
    part = cast("Part", arrival.message)
    if not 0 <= part.index < part.count:
        raise Mismatched(f"index {part.index} of {part.count}")
    for sibling in siblings:
        other = cast("Part", sibling.message)
        if other.count != part.count:
            raise Mismatched(f"one of {part.count}, but {sibling.envelope.id} is one of {other.count}")
        if other.index == part.index:
            raise Mismatched(f"index {part.index} again, after {sibling.envelope.id}")
