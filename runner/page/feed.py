"""What pages are shown, by name: each is sent to whoever shows it, and again once it has changed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Collection
from typing import Any

import msgspec

PAUSE_SECONDS = 0.05
"""Between two things that one page is sent: what comes together is sent together."""


class Feed:
    """The newest of everything, as JSON. Pages that stand still miss what was replaced meanwhile, and nobody waits."""

    def __init__(self) -> None:
        self._values: dict[str, bytes] = {}
        self._changed = asyncio.Event()

    def put(self, name: str, value: Any) -> None:
        """Replaces what has that name."""
        encoded = msgspec.json.encode({"name": name, "value": value}, enc_hook=shape)
        if self._values.get(name) != encoded:
            self._values[name] = encoded
            self.wake()

    def wake(self) -> None:
        """Has everybody who follows look again, also at what they want."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def follow(self, wanted: Callable[[], Collection[str]]) -> AsyncIterator[bytes]:
        """What has the wanted names, as it is and as it changes."""
        sent: dict[str, bytes] = {}
        while True:
            changed = self._changed
            for name in wanted():
                value = self._values.get(name)
                if value is not None and sent.get(name) is not value:
                    sent[name] = value
                    yield value
            await asyncio.sleep(PAUSE_SECONDS)
            await changed.wait()


def shape(array: Any) -> list[int]:
    """Of pictures and files only their size is sent: H, W, 3, or the number of bytes."""
    return list(array.shape)
