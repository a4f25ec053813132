"""Memory that the processes of one machine share: one writes what the others read, and nobody copies."""

from __future__ import annotations

import mmap
import os
import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence

import msgspec
import numpy as np

ARENA_BYTES = 2**28
"""Address space of an arena; memory is taken up as it is written to, the lowest free place first."""
ALIGNMENT = 64


class Place(msgspec.Struct, frozen=True, gc=False):
    """Where a block lies."""

    arena: int
    offset: int
    size: int


class Block:
    """A message in memory that others can read. Its place is free once nobody refers to it, here or there."""

    __slots__ = ("_drop", "place", "view")

    def __init__(self, place: Place, view: memoryview, drop: Callable[[Place], None]):
        self.place = place
        self.view = view
        self._drop = drop

    def __len__(self) -> int:
        return self.place.size

    def __del__(self) -> None:
        self._drop(self.place)


class Store:
    """The arenas of one process, in which it writes. May be used from any thread."""

    def __init__(self) -> None:
        self._arenas: list[_Arena] = []
        self._held: dict[tuple[int, int], int] = {}
        """By (arena, offset): how many readers have not given it back, and the block itself."""
        self._given_back: deque[tuple[int, int]] = deque()
        self._changing = threading.Lock()

    def write(self, parts: Sequence[bytes | memoryview]) -> Block:
        """Puts parts one after the other."""
        size = sum(len(part) for part in parts)
        with self._changing:
            self._settle()
            place = self._find(size)
            self._held[place.arena, place.offset] = 1
        view = self._arenas[place.arena].view[place.offset : place.offset + size]
        filled = 0
        for part in parts:
            view[filled : filled + len(part)] = part
            filled += len(part)
        return Block(place, view, self._drop)

    def lend(self, block: Block) -> None:
        """Keeps a block's place until one more reader has given it back."""
        with self._changing:
            self._held[block.place.arena, block.place.offset] += 1

    def give_back(self, arena: int, offset: int) -> None:
        """One reader does not need a place any more. Never waits: garbage collection may call it at any moment."""
        self._given_back.append((arena, offset))

    def descriptor(self, arena: int) -> int:
        """The file that a reader maps."""
        return self._arenas[arena].descriptor

    def close(self) -> None:
        """Gives the memory up as far as nobody reads it."""
        for arena in self._arenas:
            os.close(arena.descriptor)

    def _drop(self, place: Place) -> None:
        self.give_back(place.arena, place.offset)

    def _settle(self) -> None:
        """Frees what has been given back."""
        while self._given_back:
            key = self._given_back.popleft()
            self._held[key] -= 1
            if not self._held[key]:
                del self._held[key]
                self._arenas[key[0]].release(key[1])

    def _find(self, size: int) -> Place:
        for arena in self._arenas:
            if (offset := arena.take(size)) is not None:
                return Place(arena.number, offset, size)
        self._arenas.append(_Arena(len(self._arenas), max(ARENA_BYTES, _aligned(size))))
        return self._find(size)


class _Arena:
    """One stretch of memory; the lowest place that is large enough is taken first, for it has been used before."""

    def __init__(self, number: int, size: int):
        self.number = number
        self.descriptor = os.memfd_create("runner", os.MFD_CLOEXEC)
        os.truncate(self.descriptor, size)
        self.view = memoryview(mmap.mmap(self.descriptor, size))
        self._free = [(0, size)]
        """(offset, size) of what is free, in order."""
        self._taken: dict[int, int] = {}

    def take(self, size: int) -> int | None:
        wanted = _aligned(size)
        for index, (offset, length) in enumerate(self._free):
            if length >= wanted:
                self._free[index : index + 1] = [(offset + wanted, length - wanted)] if length > wanted else []
                self._taken[offset] = wanted
                return offset
        return None

    def release(self, offset: int) -> None:
        start, size = offset, self._taken.pop(offset)
        index = bisect_left(self._free, (offset, 0))
        first, last = index, index
        if index < len(self._free) and self._free[index][0] == offset + size:
            size, last = size + self._free[index][1], index + 1
        if index > 0 and sum(self._free[index - 1]) == offset:
            start, first = self._free[index - 1][0], index - 1
            size += self._free[first][1]
        self._free[first:last] = [(start, size)]


class Window:
    """An arena of another process, to read."""

    def __init__(self, descriptor: int):
        """Maps it; raises OSError or ValueError where that is not possible."""
        self._memory = mmap.mmap(descriptor, 0, prot=mmap.PROT_READ)

    def read(self, offset: int, size: int, give_back: Callable[[], None]) -> memoryview:
        """A block, without a copy; ``give_back`` is called once nothing refers to it any more.

        Raises ValueError where there is none.
        """
        if offset < 0 or size < 0 or offset + size > len(self._memory):
            raise ValueError(f"{size} bytes at {offset} are not within {len(self._memory)} bytes of shared memory")
        lease = _Lease((size,), np.uint8, self._memory, offset)
        lease.give_back = give_back
        return lease.data


class _Lease(np.ndarray):
    """What everything that refers to a block keeps alive."""

    give_back: Callable[[], None]

    def __del__(self) -> None:
        self.give_back()


def _aligned(size: int) -> int:
    return -(-max(size, 1) // ALIGNMENT) * ALIGNMENT
