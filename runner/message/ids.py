"""The id of a message, ``stage.port#sequence``: plain text on the wire and in recordings; and which came lately."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from typing import Annotated, TypeVar

import msgspec

IdText = Annotated[str, msgspec.Meta(pattern=r"^\w+\.\w+#[0-9]{1,15}$(?!\n)")]


K = TypeVar("K")
V = TypeVar("V")
REMEMBERED = 10_000
"""What a process remembers to recognise what comes twice."""


class MessageId(msgspec.Struct, frozen=True, order=True, gc=False):
    """The parts of an id, in the order by which ids are sorted."""

    stage: str
    port: str
    sequence: int

    @staticmethod
    def of(text: str) -> MessageId:
        """Reads an id; a part that is missing or malformed is empty, a sequence 0."""
        source, _, sequence = text.partition("#")
        stage, _, port = source.partition(".")
        return MessageId(stage, port, int(sequence) if sequence.isdecimal() and len(sequence) <= 15 else 0)

    @property
    def topic(self) -> str:
        """What its port is recorded under: ``stage/port``."""
        return f"{self.stage}/{self.port}"

    def __str__(self) -> str:
        return f"{self.stage}.{self.port}#{self.sequence}"


def numbered(id: str) -> tuple[str, int]:
    """Of a recorded id ``stage.port`` and the sequence: no more than the proof needs of every message."""
    source, _, sequence = id.rpartition("#")
    return source, int(sequence)


def number_on(numbers: dict[str, int], ids: Iterable[str]) -> None:
    """Has the next sequence numbers, by port, go on after the ids of one stage."""
    for one in map(MessageId.of, ids):
        numbers[one.port] = max(numbers.get(one.port, 0), one.sequence + 1)


class Recent(OrderedDict[K, V]):
    """The newest that was entered, so many at the most."""

    def __init__(self, most: int = REMEMBERED) -> None:
        super().__init__()
        self._most = most

    def __setitem__(self, key: K, value: V) -> None:
        super().__setitem__(key, value)
        if len(self) > self._most:
            self.popitem(last=False)
