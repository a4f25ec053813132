"""The publisher's side of every edge: keeps what is not acknowledged, sends it again, shares parts, holds back."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from runner.graph.graph import Route
from runner.message.codec import Envelope
from runner.message.packet import Process
from runner.transport.arena import Block

PREFETCH = 2
"""Parts a replica holds at a time: the one it works on and the next, so that it never waits for a delivery."""
POLL_SECONDS = 0.1
PATIENCE_SECONDS = 30.0
"""A publisher that is held back for longer says so."""

Payload = bytes | Block
Send = Callable[[tuple[str, int], str, Payload], bool]
"""Delivers to a process, (stage, replica), under a key; returns whether it arrives whatever happens to this process."""
Warn = Callable[[str], None]


class Stopped(Exception):
    """The graph ends while a publisher waits for room."""


@dataclass(slots=True)
class _Entry:
    """A message on its way to one consumer."""

    id: str
    lineage: str
    payload: Payload
    replica: int | None = None
    """Who has been given this part."""
    received: bool = False
    """Whether it is in the consumer's memory, and survives this process."""


class Courier:
    """Sends the newest of a key from a thread of its own: a consumer that stands still holds nobody up."""

    def __init__(self, send: Send):
        self._send = send
        self._waiting: dict[str, tuple[tuple[str, int], Payload]] = {}
        self._changed = threading.Condition()
        threading.Thread(target=self._send_all, name="courier", daemon=True).start()

    def take(self, to: tuple[str, int], key: str, payload: Payload) -> bool:
        """Sends soon; what waits under the same key is left out."""
        with self._changed:
            self._waiting[key] = to, payload
            self._changed.notify()
        return False

    def _send_all(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                key = next(iter(self._waiting))
                to, payload = self._waiting.pop(key)
            self._send(to, key, payload)


class Outgoing:
    """One edge, seen from its publisher."""

    def __init__(self, route: Route, send: Send):
        self.route = route
        self._send = send
        self._live: set[int] = set()
        self._pending: dict[str, _Entry] = {}
        self._acknowledged: deque[_Entry] = deque(maxlen=route.kept)
        """The newest of what a restarted process may need again."""

    def has_room(self, lineage: str) -> bool:
        """Whether one more message may be accepted: a queue is counted in lineages, so that no join can starve."""
        if self.route.policy == "latest" or len(self._pending) < self.route.queue:
            return True
        lineages = {entry.lineage for entry in self._pending.values()}
        return lineage in lineages or len(lineages) < self.route.queue

    def holds_alone(self, message_id: str) -> bool:
        """Whether a message would be lost with this process."""
        entry = self._pending.get(message_id)
        return entry is not None and not entry.received and self.route.policy == "block"

    def received(self, message_id: str) -> None:
        """Takes note that a message has arrived."""
        if message_id in self._pending:
            self._pending[message_id].received = True

    @property
    def unanswered(self) -> int:
        """Messages that the consumer has not done with."""
        return len(self._pending)

    def oldest(self) -> str:
        """Id of the message that has waited longest."""
        return next(iter(self._pending), "")

    def accept(self, entry: _Entry) -> None:
        """Takes a message over and sends it as far as there is somebody to send it to."""
        if self.route.policy == "latest":
            self._pending.clear()
        self._pending[entry.id] = entry
        if self.route.shared:
            self._deal()
        else:
            for replica in sorted(self._live):
                self._deliver(entry, replica)

    def acknowledge(self, message_id: str) -> None:
        """Lets go of a message that has been consumed."""
        entry = self._pending.pop(message_id, None)
        if entry is not None and self.route.kept:
            self._acknowledged.append(entry)
        if self.route.shared:
            self._deal()

    def appeared(self, replica: int) -> None:
        """Sends a new process what it has missed, oldest first."""
        self._live.add(replica)
        if self.route.shared:
            self._take_back(replica)
            self._deal()
        else:
            for entry in (*self._acknowledged, *self._pending.values()):
                self._deliver(entry, replica)

    def vanished(self, replica: int) -> None:
        """Hands the parts of a dead replica to the others."""
        self._live.discard(replica)
        if self.route.shared:
            self._take_back(replica)
            self._deal()
        elif not self._live:
            for entry in self._pending.values():
                entry.received = False

    def _take_back(self, replica: int) -> None:
        for entry in self._pending.values():
            if entry.replica == replica:
                entry.replica, entry.received = None, False

    def _deal(self) -> None:
        """Gives waiting parts, in order, to the replicas that hold fewest."""
        held = dict.fromkeys(sorted(self._live), 0)
        for entry in self._pending.values():
            if entry.replica in held:
                held[entry.replica] += 1
        for entry in self._pending.values():
            if entry.replica is None and held and min(held.values()) < PREFETCH:
                entry.replica = min(held, key=lambda replica: held[replica])
                held[entry.replica] += 1
                self._deliver(entry, entry.replica)

    def _deliver(self, entry: _Entry, replica: int) -> None:
        consumer = self.route.consumer
        if self._send((consumer, replica), f"d/{consumer}/{replica}/{self.route.input}", entry.payload):
            entry.received = True


class Delivery:
    """All edges that leave one process. Its methods may be called from any thread."""

    def __init__(self, routes: Iterable[Route], send: Send, warn: Warn, stopping: Callable[[], bool]):
        """``stopping`` is asked again and again while a publisher waits."""
        self._edges = [Outgoing(route, send if route.policy == "block" else Courier(send).take) for route in routes]
        self._warn = warn
        self._held_back: deque[tuple[tuple[str, ...], Callable[[], None]]] = deque()
        self._changed = threading.Condition()
        self._stopping = stopping
        self._closed = False
        self._newest: dict[tuple[str, int], Process] = {}
        """The newest process seen of each replica."""

    def publish(self, port: str, envelope: Envelope, payload: Payload) -> None:
        """Hands a message to every consumer of a port; blocks while one's queue is full. Raises Stopped."""
        for edge in self._edges:
            if edge.route.output == port:
                with self._changed:
                    self._wait_for_room(edge, envelope.lineage)
                    edge.accept(_Entry(envelope.id, envelope.lineage, payload))

    def unanswered(self) -> dict[str, int]:
        """Messages that consumers have not done with, by ``stage.port``; waits for nobody, not even a full link."""
        return {f"{edge.route.consumer}.{edge.route.input}": edge.unanswered for edge in self._edges}

    def after_arrival(self, message_ids: tuple[str, ...], action: Callable[[], None]) -> None:
        """Acts, in the order of these calls, once messages have arrived wherever they go.

        A step is journalled only then: were this process killed earlier, the step would be run again.
        """
        with self._changed:
            self._held_back.append((message_ids, action))
            self._act()

    def receive(self, consumer: str, port: str, message_id: str) -> None:
        """Takes note that a message has arrived at a consumer."""
        with self._changed:
            for edge in self._edges:
                if (edge.route.consumer, edge.route.input) == (consumer, port):
                    edge.received(message_id)
            self._act()

    def acknowledge(self, consumer: str, consumed: Iterable[tuple[str, str]]) -> None:
        """Takes note that a consumer has done with (port, message id) pairs."""
        by_port = {edge.route.input: edge for edge in self._edges if edge.route.consumer == consumer}
        with self._changed:
            for port, message_id in consumed:
                if port in by_port:
                    by_port[port].acknowledge(message_id)
            self._act()
            self._changed.notify_all()

    def update(self, process: Process, present: bool) -> None:
        """Takes note of a consumer's process that came or went."""
        with self._changed:
            edges = [edge for edge in self._edges if edge.route.consumer == process.stage]
            newest = self._newest.setdefault((process.stage, process.replica), process)
            if process < newest:
                return  # cut off and replaced, it is seen again, or only now seen to go
            self._newest[process.stage, process.replica] = process
            for edge in edges:
                if process != newest:
                    edge.vanished(process.replica)
                (edge.appeared if present else edge.vanished)(process.replica)

    def drain(self, stopping: Callable[[], bool]) -> None:
        """Waits until all that was published has arrived wherever it goes: nothing hangs on this process any more."""
        with self._changed:
            while self._held_back and not stopping():
                self._changed.wait(POLL_SECONDS)

    def close(self) -> None:
        """Acts on what has not arrived, too: the graph ends and no step will be run again."""
        with self._changed:
            self._closed = True
            self._act()

    def _act(self) -> None:
        while self._held_back:
            message_ids, action = self._held_back[0]
            if not self._closed and any(edge.holds_alone(one) for edge in self._edges for one in message_ids):
                return
            self._held_back.popleft()
            action()

    def _wait_for_room(self, edge: Outgoing, lineage: str) -> None:
        impatient = time.monotonic() + PATIENCE_SECONDS
        while not edge.has_room(lineage):
            if self._stopping():
                raise Stopped
            self._changed.wait(POLL_SECONDS)
            if time.monotonic() > impatient:
                impatient = float("inf")
                self._warn(
                    f"held back: {edge.route.consumer}.{edge.route.input} has {edge.route.queue} lineages to answer, "
                    f"the oldest since {edge.oldest()}"
                )
