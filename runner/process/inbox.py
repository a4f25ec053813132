"""Puts messages together to steps: joins and gathers by lineage, whatever the order of arrival."""

from collections import OrderedDict, deque
from collections.abc import Collection, Iterator
from typing import cast

import msgspec

from runner.contract import Part
from runner.graph.graph import Node
from runner.graph.ports import Handler, InputPort
from runner.process.step import Arrival


class Mismatched(Exception):
    """A message that contradicts what came before it: another count, or the same index twice."""


class Ready(msgspec.Struct, frozen=True):
    """A handler and everything it needs, in the order of its parameters."""

    handler: Handler
    arrivals: tuple[Arrival, ...]


_Lineage = dict[str, deque[Arrival]]
"""What has come of one lineage for one handler: by port, in order of arrival."""


class Inbox:
    """Everything that has arrived at one process and is not consumed yet."""

    def __init__(self, node: Node):
        self._node = node
        self._lineages = {handler.name: OrderedDict[str, _Lineage]() for handler in node.type.handlers}
        self._turns = {handler.name: deque[str]() for handler in node.type.handlers}
        self._ready: deque[Ready] = deque()
        self.waiting = dict.fromkeys(node.inputs, 0)
        """Messages that no step has taken yet, by port; not those that a join keeps for its parts."""
        self._used: set[str] = set()
        """Ids of what is kept and has been part of a step."""
        self._unused: list[tuple[str, str]] = []
        """(port, id) of what was forgotten without having been part of any."""

    def add(self, arrival: Arrival) -> None:
        """Takes a message; raises Mismatched for a part that contradicts its siblings."""
        handler = self._node.type.takers[arrival.port.name]
        if len(handler.inputs) == 1 and arrival.port.kind == "one":
            if self._node.inputs[arrival.port.name].policy == "latest":
                self._ready = deque(ready for ready in self._ready if ready.handler is not handler)
                self.waiting[arrival.port.name] = 0
            self._count(handler, arrival.port, 1)
            self._ready.append(Ready(handler, (arrival,)))
            return
        lineage = self._lineages[handler.name].setdefault(arrival.envelope.lineage, {})
        waiting = lineage.setdefault(arrival.port.name, deque())
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

    def pop(self, busy: Collection[str] = ()) -> Ready | None:
        """The next step in order of completion, not of handlers that are ``busy``, or None."""
        turn = next((k for k, ready in enumerate(self._ready) if ready.handler.name not in busy), None)
        if turn is None:
            return None
        ready = self._ready[turn]
        del self._ready[turn]
        for arrival in ready.arrivals:
            self._count(ready.handler, arrival.port, -1)
        return ready

    def take_unused(self) -> tuple[tuple[str, str], ...]:
        """(port, id) of what has been put aside since the last call and was never part of a step."""
        unused, self._unused = tuple(self._unused), []
        return unused

    def left(self) -> Iterator[tuple[str, str]]:
        """(port, id) of everything that has been part of no step."""
        for ready in self._ready:
            yield from ((arrival.port.name, arrival.envelope.id) for arrival in ready.arrivals)
        for lineages in self._lineages.values():
            for lineage in lineages.values():
                yield from self._unused_of(lineage)

    def _unused_of(self, lineage: _Lineage) -> Iterator[tuple[str, str]]:
        for port, arrivals in lineage.items():
            for arrival in arrivals:
                if arrival.envelope.id in self._used:
                    self._used.discard(arrival.envelope.id)
                else:
                    yield port, arrival.envelope.id

    def incomplete(self) -> Iterator[tuple[Handler, str, list[str]]]:
        """(handler, lineage, ports that lack) for everything that cannot run yet."""
        for handler in self._node.type.handlers:
            for root, lineage in self._lineages[handler.name].items():
                lacking = [port.name for port in handler.inputs if not _satisfied(port, lineage)]
                if not _only_stays(handler, lineage):
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
        lineage = self._lineages[handler.name].get(root, {})
        while all(_satisfied(port, lineage) for port in handler.inputs):
            arrivals = [arrival for port in handler.inputs for arrival in _take(handler, port, lineage)]
            self._used.update(arrival.envelope.id for arrival in arrivals if handler.keeps(arrival.port))
            yield Ready(handler, tuple(arrivals))
        if not any(lineage.values()):
            self._lineages[handler.name].pop(root, None)

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
            self._unused += self._unused_of(lineages.pop(finished))


def _turn_port(handler: Handler) -> InputPort | None:
    """The port beside a gather whose order of arrival its steps keep: replicas finish lineages in any order."""
    if all(port.kind == "one" for port in handler.inputs):
        return None
    return next((port for port in handler.inputs if port.kind == "one"), None)


def _only_stays(handler: Handler, lineage: _Lineage) -> bool:
    return not any(lineage.get(port.name) for port in handler.inputs if not handler.keeps(port))


def _satisfied(port: InputPort, lineage: _Lineage) -> bool:
    waiting = lineage.get(port.name)
    if not waiting:
        return False
    return port.kind == "one" or len(waiting) == cast("Part", waiting[0].message).count


def _take(handler: Handler, port: InputPort, lineage: _Lineage) -> list[Arrival]:
    waiting = lineage[port.name]
    if port.kind == "gather":
        lineage[port.name] = deque()
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
