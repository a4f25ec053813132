"""The publisher's side of every edge: waits where consumers have enough to do, and deals parts to replicas."""

import math
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator

from runner.graph.graph import Route
from runner.message.codec import Deal, Envelope, pack
from runner.message.packet import Process
from runner.transport.vital import vital_thread

PREFETCH = 2
"""Parts a replica holds at a time: the one it works on and the next, so that it never waits for a delivery."""
POLL_SECONDS = 0.1
PATIENCE_SECONDS = 30.0
"""A publisher that is held back for longer says so."""

Publish = Callable[[str, bytes | bytearray], None]
"""Sends a payload under a key."""
Warn = Callable[[str], object]


class Stopped(Exception):
    """The graph ends while a publisher waits for room."""


class Outgoing:
    """One edge, seen from its publisher: what its consumer has not done with yet."""

    def __init__(self, route: Route):
        self.route = route
        self.unanswered: OrderedDict[str, str] = OrderedDict()
        """Messages that the consumer has not done with: lineage by id."""
        self._lineages = Counter[str]()
        """How many of them there are of each lineage."""
        self._awaited: dict[str, set[int]] = {}
        """Which replicas have not, by id; -1 where one of them is enough."""
        self._holders: dict[str, int] = {}
        """Which replica holds a part, by id."""
        self._live: set[int] = set()

    def has_room(self, lineage: str) -> bool:
        """Whether one more message may be sent: a queue is counted in lineages, so that no join can starve."""
        if self.route.policy == "latest" or len(self.unanswered) < self.route.queue:
            return True
        return lineage in self._lineages or len(self._lineages) < self.route.queue

    def note(self, message_id: str, lineage: str) -> None:
        """Takes note of a message that is about to be sent."""
        if self.route.policy == "block":
            self._uncount(message_id)
            self.unanswered[message_id] = lineage
            self._lineages[lineage] += 1
            # What is kept for parts is put aside late by a replica that gets none of them, and their queue holds back.
            self._awaited[message_id] = {-1} if self.route.kept else set(self.route.takers)

    def answered(self, message_id: str, replica: int) -> None:
        """Lets go of a message once all have done with it that must."""
        awaited = self._awaited.get(message_id, set())
        awaited -= {replica, -1}
        if not awaited:
            self._uncount(message_id)
            self.unanswered.pop(message_id, None)
            self._awaited.pop(message_id, None)
            self._holders.pop(message_id, None)

    def _uncount(self, message_id: str) -> None:
        lineage = self.unanswered.get(message_id)
        if lineage is not None:
            self._lineages[lineage] -= 1
            if not self._lineages[lineage]:
                del self._lineages[lineage]

    def appeared(self, replica: int) -> None:
        """Takes note of a new process of the consumer, which holds nothing yet."""
        self.lost(replica)
        self._live.add(replica)

    def lost(self, replica: int) -> None:
        """Takes back the parts of a dead process."""
        self._live.discard(replica)
        self._holders = {id: holder for id, holder in self._holders.items() if holder != replica}

    def deal(self) -> Iterator[tuple[str, Deal]]:
        """Gives waiting parts, in order, to the replicas that hold fewest: (key, what the replica is told)."""
        if not self.route.shared or not self._live:
            return
        held = dict.fromkeys(sorted(self._live), 0)
        for holder in self._holders.values():
            held[holder] += 1
        for message_id in self.unanswered:
            replica = min(held, key=lambda replica: held[replica])
            if held[replica] >= PREFETCH:
                return
            if message_id not in self._holders:
                self._holders[message_id] = replica
                held[replica] += 1
                yield f"d/{self.route.consumer}/{replica}/{self.route.input}", Deal(message_id)


class Delivery:
    """All edges that leave one process. Its methods may be called from any thread; nothing is locked while it sends.

    Only :meth:`publish` waits. Parts are dealt, in one order for everybody, on a thread of their own: a replica that
    stands still must not hold up whoever hears what the others have done with.
    """

    def __init__(
        self,
        stage: str,
        routes: Iterable[Route],
        publish: Publish,
        warn: Warn,
        *,
        stopping: Callable[[], bool],
    ):
        """``stopping`` is asked again and again while a publisher waits."""
        self._stage = stage
        self._edges = [Outgoing(route) for route in routes]
        self._publish = publish
        self._warn = warn
        self._changed = threading.Condition()
        self._stopping = stopping
        self._newest: dict[tuple[str, int], Process] = {}
        """The newest process seen of each replica."""
        self._to_deal = threading.Event()
        if any(edge.route.shared for edge in self._edges):
            vital_thread("dealer", self._deal_all).start()

    def publish(self, port: str, envelope: Envelope, payload: bytes | bytearray) -> None:
        """Sends a message once every consumer of a port has room, and has it dealt.

        Raises Stopped where the graph ends meanwhile; it is sent then too.
        """
        try:
            for edge in self._edges:
                if edge.route.output == port:
                    self._take_room(edge, envelope)
        finally:
            self._publish(f"m/{self._stage}/{port}", payload)
        self._to_deal.set()

    def take_over(self, undone: Iterable[tuple[str, str, str]]) -> None:
        """Deals the parts, (consumer, port, id), that earlier processes have sent and nobody has done with."""
        with self._changed:
            for consumer, port, message_id in undone:
                for edge in self._edges_to(consumer, port):
                    if message_id not in edge.unanswered:
                        edge.note(message_id, "")  # one lineage all together: they may wait for what is still to come
        self._to_deal.set()

    def answered(self, consumer: str, replica: int, done: Iterable[tuple[str, str]]) -> None:
        """Takes note that a replica of a consumer, -1 for whichever, has done with (port, message id) pairs."""
        with self._changed:
            for port, message_id in done:
                for edge in self._edges_to(consumer, port):
                    edge.answered(message_id, replica)
            self._changed.notify_all()
        self._to_deal.set()

    def appeared(self, process: Process) -> None:
        """Takes note of a consumer's process that is there."""
        with self._changed:
            newest = self._newest.get(process.place)
            if newest is not None and process <= newest:
                return
            self._newest[process.place] = process
            for edge in self._edges_to(process.stage):
                edge.appeared(process.replica)
        self._to_deal.set()

    def lost(self, process: Process) -> None:
        """Takes note of a consumer's process that is dead."""
        with self._changed:
            if self._newest.get(process.place, process) <= process:
                for edge in self._edges_to(process.stage):
                    edge.lost(process.replica)
        self._to_deal.set()

    def _edges_to(self, consumer: str, port: str = "") -> Iterator[Outgoing]:
        for edge in self._edges:
            if edge.route.consumer == consumer and port in ("", edge.route.input):
                yield edge

    def _deal_all(self) -> None:
        while True:
            self._to_deal.wait()
            self._to_deal.clear()
            for edge in self._edges:
                with self._changed:
                    dealt = list(edge.deal())
                for key, deal in dealt:
                    self._publish(key, pack(deal))

    def _take_room(self, edge: Outgoing, envelope: Envelope) -> None:
        """Notes a message as sent, as soon as there is room for its lineage."""
        warn_at = time.monotonic() + PATIENCE_SECONDS
        while True:
            with self._changed:
                if edge.has_room(envelope.lineage):
                    edge.note(envelope.id, envelope.lineage)
                    return
                if self._stopping():
                    raise Stopped
                self._changed.wait(POLL_SECONDS)
                oldest = next(iter(edge.unanswered), "")
            if time.monotonic() > warn_at:
                warn_at = math.inf
                # Without the lock: what is said travels, too.
                self._warn(
                    f"held back: {edge.route.consumer}.{edge.route.input} has {edge.route.queue} lineages to answer, "
                    f"the oldest since {oldest}"
                )
