"""Where the live tools listen: what the recorder receives, passed on to whoever asks and never waited for."""

from __future__ import annotations

import queue
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from runner.message.packet import Packet
from runner.transport.bus import Bus

BACKLOG = 1000
"""Messages that a slow terminal may fall behind; the rest is left out, and counted."""
_HEADER = struct.Struct("<qqQ")


@dataclass(frozen=True, slots=True)
class Header:
    """What is known of a message without its content."""

    sent_ns: int
    arrived_ns: int
    """At the recorder, by its monotonic clock."""
    size: int
    """Bytes of the envelope."""

    def pack(self) -> bytes:
        """As it travels."""
        return _HEADER.pack(self.sent_ns, self.arrived_ns, self.size)

    @staticmethod
    def unpack(payload: bytes | memoryview) -> Header:
        """Reads what :meth:`pack` wrote."""
        return Header(*_HEADER.unpack(payload))


class Tap:
    """The recorder's side. A tool that stands still costs the graph nothing: what it does not take is dropped."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def pass_on(self, packet: Packet) -> None:
        """Offers a message (on ``t/``) and its header (on ``n/``)."""
        topic = packet.key.partition("/")[2]
        header = Header(packet.sent_ns, packet.arrived_ns, len(packet.payload))
        self._bus.offer(f"t/{topic}", packet.payload)
        self._bus.offer(f"n/{topic}", header.pack())


class Listener:
    """A tool's side."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._packets: queue.Queue[Packet] = queue.Queue(BACKLOG)
        self.left_out = 0

    def messages(self, topic: str) -> None:
        """Takes whole messages of a topic from now on."""
        self._bus.subscribe(f"t/{topic}", self._receive)

    def headers(self, topic: str) -> None:
        """Takes only headers of a topic from now on."""
        self._bus.subscribe(f"n/{topic}", self._receive)

    def take(self, timeout_s: float) -> Iterator[Packet]:
        """What has arrived; waits for the first, but not for longer than ``timeout_s``."""
        try:
            yield self._packets.get(timeout=timeout_s)
            while True:
                yield self._packets.get_nowait()
        except queue.Empty:
            return

    def _receive(self, packet: Packet) -> None:
        try:
            self._packets.put_nowait(packet)
        except queue.Full:
            self.left_out += 1
