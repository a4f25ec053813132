"""What a process cannot take from the bus: refused, counted and named, and the process lives on."""

import threading
from collections.abc import Callable
from typing import TypeVar

import msgspec

from runner.contract import Refused
from runner.message import codec
from runner.message.codec import CodecError
from runner.message.packet import Packet, Process

R = TypeVar("R", bound=msgspec.Struct)
SHOWN = 10
"""Refusals that are shown each; after that only those whose number is a power of ten."""


class Refusals:
    """Counts what one process refuses, from any thread."""

    def __init__(self, show: Callable[[str], object]) -> None:
        self.count = 0
        self._show = show
        self._counting = threading.Lock()

    def reading(self, kind: type[R], note: Callable[[R, Packet], None]) -> Callable[[Packet], None]:
        """Takes packets and has every record noted; what is not of its kind is refused."""

        def take(packet: Packet) -> None:
            try:
                record = codec.unpack(kind, packet.payload)
            except CodecError as error:
                self.refuse(packet.key, error)
            else:
                note(record, packet)

        return take

    def naming(self, note: Callable[[Process], None]) -> Callable[[Packet], None]:
        """Takes packets and has every process noted that a key names; a key that names none is refused."""

        def take(packet: Packet) -> None:
            try:
                note(Process.of(packet.key))
            except Refused as refusal:
                self.refuse(packet.key, refusal)

        return take

    def refuse(self, key: str, error: Exception) -> None:
        """Counts a message and shows what is wrong with it; of very many only some."""
        with self._counting:
            self.count += 1
            count = self.count
        if count <= SHOWN or str(count).strip("0") == "1":
            self._show(f"{key[:100]}: message refused ({count} so far): {error}")
