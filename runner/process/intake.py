"""What comes to a process, on its way from the bus to the inbox: each message once, and of parts only its own."""

import contextlib
import queue
import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator

from runner.graph.graph import Node
from runner.message import codec
from runner.message.codec import CodecError, Deal, Envelope
from runner.message.ids import REMEMBERED, numbered
from runner.message.packet import Packet
from runner.message.refusals import Refusals
from runner.process.inbox import Inbox, Mismatched
from runner.process.step import receive
from runner.recording.intervals import Intervals

Consumed = tuple[str, str, tuple[tuple[int, int], ...]]
"""A port, what its messages come from, and ranges of their numbers: the first, and one after the last."""


class Intake:
    """Takes packets from the threads of the bus and, on the thread that runs steps, decodes them into the inbox."""

    def __init__(self, node: Node, refusals: Refusals, *, consumed: Iterable[Consumed], is_new: bool):
        """``consumed`` is what earlier processes have done with. Unless the process ``is_new``, what comes waits until
        the recorder has sent again what is older.
        """
        self.inbox = Inbox(node)
        self._node = node
        self._refusals = refusals
        self._mailbox = _Mailbox(node)
        self._parts = _Parts()
        self._shared = {port for port in node.inputs if node.shares(port)}
        self._arrived = defaultdict[tuple[str, str], Intervals](Intervals)
        """Numbers of what has arrived, by port and what it comes from, so that it is worked on once."""
        for port, source, ranges in consumed:
            if not node.keeps(port):
                self._arrived[port, source] |= ranges
        self._left: list[tuple[str, str]] = []
        """(port, id) of what was refused since that was last taken."""
        self._catching_up = threading.Lock()
        self._early: list[tuple[str, Packet]] | None = None if is_new else []
        """What has come before the recorder has sent again what is older; None once it has."""

    @property
    def is_behind(self) -> bool:
        """Whether the recorder still sends again what is older."""
        return self._early is not None

    @property
    def waiting(self) -> dict[str, int]:
        """Messages that no step has taken yet, by port, and packets that are not decoded."""
        return {**self.inbox.waiting, "mailbox": len(self._mailbox)}

    def came(self, port: str, packet: Packet) -> None:
        """Takes what a publisher sends."""
        with self._catching_up:
            if self._early is not None:
                self._early.append((port, packet))
                return
        self.came_again(port, packet)

    def came_again(self, port: str, packet: Packet) -> None:
        """Takes what the recorder sends again."""
        if port in self._shared:
            try:
                found = self._parts.came(port, codec.unpack(Envelope, packet.payload).id, packet)
            except CodecError:
                found = packet  # and who takes it says what is wrong with it
            if found is None:
                return
        self._mailbox.put(port, packet)

    def caught_up(self) -> None:
        """What is older than all that came directly has been sent again by now."""
        with self._catching_up:
            for port, packet in self._early or ():
                self.came_again(port, packet)
            self._early = None

    def deal(self, deal: Deal, packet: Packet) -> None:
        """Takes note that a part is this replica's."""
        if (part := self._parts.deal(packet.end, deal.id)) is not None:
            self._mailbox.put(packet.end, part)

    def forget(self, done: Iterable[tuple[str, str]]) -> None:
        """Lets go of parts, (port, id), that a replica has done with."""
        self._parts.forget(done)

    def wake(self) -> None:
        """Ends a wait for packets. May be called from any thread and from a signal handler."""
        self._mailbox.wake()

    def take(self, *, wait: bool) -> None:
        """Puts everything that is there into the inbox; waits for something where there is nothing to do."""
        for port, packet in self._mailbox.take(wait=wait and not self.inbox.has_ready):
            self._take(port, packet)

    def _take(self, name: str, packet: Packet) -> None:
        """Decodes one message into the inbox, unless it has been here before."""
        id = ""
        try:
            envelope = codec.unpack(Envelope, packet.payload)
            id = envelope.id
            source, number = numbered(id)
            arrived = self._arrived[name, source]
            if number in arrived:
                return
            arrived.add(number)
            arrived.keep(REMEMBERED)
            port = self._node.type.inputs.get(name)
            if port is None:
                raise CodecError("key", "", f"no such input; valid: {', '.join(self._node.type.inputs)}")
            travelled = packet.arrived_ns - packet.sent_ns if packet.sent_ns else 0
            self.inbox.add(receive(port, envelope, arrived_ns=packet.arrived_ns, travelled_ns=travelled))
        except (CodecError, Mismatched) as error:
            self._refusals.refuse(packet.key, error)
            if id:
                self._left.append((name, id))

    def take_left(self) -> tuple[tuple[str, str], ...]:
        """(port, id) of what was refused, or put aside without having been part of a step, since the last call."""
        left, self._left = (*self._left, *self.inbox.take_unused()), []
        return left

    def left(self) -> Iterator[tuple[str, str]]:
        """(port, id) of everything that has been part of no step, at the end."""
        yield from self.inbox.left()
        yield from self._parts.left()


class _Mailbox:
    """What has arrived and is not decoded, in order of arrival; of a port of policy ``latest`` only the newest."""

    def __init__(self, node: Node):
        self._latest = {port for port, edge in node.inputs.items() if edge.policy == "latest"}
        self._queue: queue.SimpleQueue[tuple[str, Packet | None]] = queue.SimpleQueue()
        self._newest: dict[str, Packet] = {}
        self._exchanging = threading.Lock()

    def put(self, port: str, packet: Packet) -> None:
        """Takes a packet, from any thread."""
        if port not in self._latest:
            self._queue.put((port, packet))
            return
        with self._exchanging:
            if port not in self._newest:
                self._queue.put((port, None))
            self._newest[port] = packet

    def wake(self) -> None:
        """Ends a wait. May be called from any thread and from a signal handler."""
        self._queue.put(("", None))

    def take(self, *, wait: bool) -> Iterator[tuple[str, Packet]]:
        """Every (port, packet) that is there; waits for one where there is none, or until it is woken."""
        with contextlib.suppress(queue.Empty):
            port, packet = self._queue.get(block=wait)
            while True:
                if port:
                    with self._exchanging:
                        fetched = packet or self._newest.pop(port)
                    yield port, fetched
                port, packet = self._queue.get_nowait()

    def __len__(self) -> int:
        """How many packets wait. May be asked from any thread."""
        return self._queue.qsize()


class _Parts:
    """Parts that are there for all replicas of a stage, each of which works on those that it is dealt."""

    def __init__(self) -> None:
        self._there: dict[tuple[str, str], Packet] = {}
        """By (port, id); whose they are is not known yet."""
        self._dealt: set[tuple[str, str]] = set()
        """Those of this replica that are still to come."""
        self._changing = threading.Lock()

    def came(self, port: str, id: str, packet: Packet) -> Packet | None:
        """Takes a part; returns it where it is this replica's."""
        with self._changing:
            if (port, id) in self._dealt:
                self._dealt.discard((port, id))
                return packet
            self._there[port, id] = packet
            return None

    def deal(self, port: str, id: str) -> Packet | None:
        """Takes note that a part is this replica's; returns it where it is there."""
        with self._changing:
            packet = self._there.pop((port, id), None)
            if packet is None:
                self._dealt.add((port, id))
            return packet

    def forget(self, done: Iterable[tuple[str, str]]) -> None:
        """Lets go of (port, id) that a replica has done with."""
        with self._changing:
            for key in done:
                self._there.pop(key, None)
                self._dealt.discard(key)

    def left(self) -> list[tuple[str, str]]:
        """(port, id) of what nobody has been heard to work on."""
        return list(self._there)
