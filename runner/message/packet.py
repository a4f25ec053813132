"""What travels between processes, and who they are."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from functools import lru_cache

import msgspec

from runner.contract import Refused

RECORDER = "recorder"


@dataclass(frozen=True, slots=True, order=True)
class Process:
    """One process of the graph; each restart is another incarnation."""

    stage: str
    replica: int
    incarnation: int = 0

    @staticmethod
    def of(key: str) -> Process:
        """The process that a key ends with; raises Refused where it names none."""
        match = re.search(r"(?:^|/)([^/]+)/([0-9]{1,9})/([0-9]{1,9})$", key)
        if match is None:
            raise Refused(f"names no process: {key[-60:]}; valid: STAGE/REPLICA/INCARNATION")
        return Process(match[1], int(match[2]), int(match[3]))

    @property
    def path(self) -> str:
        """The end of its keys."""
        return f"{self.stage}/{self.replica}/{self.incarnation}"


class Packet(msgspec.Struct, frozen=True, gc=False):
    """What arrived on a key."""

    key: str
    payload: bytes | memoryview
    sent_ns: int
    """Monotonic clock of this machine when it was sent; 0 where the sender did not say or has another clock."""
    arrived_ns: int
    genuine: bool = True
    """Whether it comes from a process of this run, see :func:`badge`."""
    near: bool = False
    """Whether it came straight from a process of this machine."""

    @property
    def end(self) -> str:
        """The last part of its key: the port that it is delivered to, or the stage that it comes from."""
        return self.key.rpartition("/")[2]


@lru_cache(4096)
def badge(secret: str, path: str) -> bytes:
    """What the processes of one run, who share its secret, show with everything they publish on a key.

    It keeps out what strays in, from another program or another run; who may come in at all is for TLS to say.
    """
    return hashlib.blake2b(path.encode(), key=secret.encode(), digest_size=8).digest()
