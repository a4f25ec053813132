"""Large messages between processes of one machine lie in shared memory: written once, however many read them."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import zenoh
from zenoh.shm import GarbageCollect, ShmProvider

FROM_BYTES = 32_768
"""Smaller messages travel through the socket as fast."""
MESSAGES = 4
"""Of the largest kind so far that the memory holds; what finds no room travels through the socket."""
FREE_SHARE = 8
"""The memory takes at most one part in so many of what is free."""
YOUNG_SECONDS = 1.0
_FOLDER = Path("/dev/shm")
_SUFFIX = ".zenoh"


class SharedMemory:
    """What one process has published and others have not read yet. The memory is taken when it is first needed."""

    def __init__(self) -> None:
        self._provider: ShmProvider | None = None
        self._size = 0

    def place(self, parts: Sequence[bytes]) -> zenoh.ZBytes | None:
        """The parts one after the other, ready to be sent any number of times; None where there is no room."""
        size = sum(map(len, parts))
        try:
            buffer = self._provider_for(size).alloc(size, GarbageCollect())
        except (zenoh.ZError, MemoryError):
            return None
        start = 0
        for part in parts:
            buffer[start : start + len(part)] = part
            start += len(part)
        return zenoh.ZBytes(buffer)

    def _provider_for(self, size: int) -> ShmProvider:
        if self._provider is None or self._size < MESSAGES * size:
            wanted = MESSAGES * size
            if wanted > shutil.disk_usage(_FOLDER).free // FREE_SHARE:
                raise MemoryError
            self._provider, self._size = ShmProvider.default_backend(wanted), wanted
        return self._provider


def sweep() -> None:
    """Removes what processes of this user that were killed have left in shared memory, unless others still use it."""
    with contextlib.suppress(FileNotFoundError):  # where the system does not say, Zenoh tidies up in its own time
        locks = [_lock(line) for line in Path("/proc/locks").read_text().splitlines()]
        for path in _FOLDER.glob(f"*{_SUFFIX}"):
            status = path.stat()
            # Zenoh holds a lock wherever it has the file open, in this process too if it has ever read from it.
            holders = {holder for inode, holder in locks if inode == status.st_ino}
            old = time.time() - status.st_mtime > YOUNG_SECONDS
            if status.st_uid == os.getuid() and old and holders <= {os.getpid()}:
                path.unlink()


def _lock(line: str) -> tuple[int, int]:
    """Inode and process of a line like ``1: FLOCK ADVISORY READ 25795 00:1b:3506 0 EOF``."""
    *_, holder, place, _, _ = line.split()
    return int(place.rpartition(":")[2]), int(holder)
