"""What a process cannot take from the bus: refused, counted and named, and the process lives on."""

import threading
from collections.abc import Callable
from typing import TypeVar

import msgspec

from runner.message import codec
from runner.message.codec import CodecError
from runner.message.packet import Packet

R = TypeVar("R", bound=msgspec.Struct)
SHOWN = 10
"""Refusals that are shown each; after that only those whose number is a power of ten."""


class Refusals:
    """Counts what one process refuses, from any thread."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self.count = 0
        self._show = show
        self._counting = threading.Lock()

    def read(self, kind: type[R], packet: Packet) -> R | None:
        """The record that a process of this run has sent, or None: then it is refused."""
        try:
            return admit(kind, packet)
        except CodecError as error:
            self.refuse(packet.key, error)
            return None

    def refuse(self, key: str, error: Exception) -> None:
        """Counts a message and shows what is wrong with it; of very many only some."""
        with self._counting:
            self.count += 1
            count = self.count
        if count <= SHOWN or str(count).strip("0") == "1":
            self._show(f"{key[:100]}: message refused ({count} so far): {error}")


def admit(kind: type[R], packet: Packet) -> R:
    """Reads a record; raises CodecError where it is none, or where a stranger has sent it."""
    record = codec.unpack(kind, packet.payload)
    require_genuine(packet)
    return record


def require_genuine(packet: Packet) -> None:
    """Raises CodecError where a stranger has sent it."""
    if not packet.genuine:
        raise CodecError(packet.key.partition("/")[0], "", "not sent by a process of this run")
