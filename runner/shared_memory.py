"""Large messages between processes of one machine lie in shared memory: written once, however many read them."""

from __future__ import annotations

import contextlib
import fcntl
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
    """Removes what processes of this user that were killed have left in shared memory."""
    for path in _FOLDER.glob(f"*{_SUFFIX}"):
        with contextlib.suppress(OSError), path.open("rb") as file:
            status = os.fstat(file.fileno())
            if status.st_uid == os.getuid() and time.time() - status.st_mtime > YOUNG_SECONDS:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails while anybody has it open
                path.unlink()
