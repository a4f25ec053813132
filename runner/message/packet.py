"""What travels between processes, and who they are."""

from __future__ import annotations

import re
from typing import NamedTuple

import msgspec

from runner.contract import Refused

RECORDER = "recorder"
GATEWAY = "gateway"
"""Where tools and strangers listen."""


class Process(NamedTuple):
    """One process of the graph; each restart is another incarnation."""

    stage: str
    replica: int
    incarnation: int = 0

    @staticmethod
    def of(key: str) -> Process:
        """The process that a key ends with; raises Refused where it names none."""
        match = re.search(r"(?:^|/)([^/]+)/([0-9]{1,9})/([0-9]{1,9})\Z", key)
        if match is None:
            raise Refused(f"names no process: {key[-60:]}; valid: STAGE/REPLICA/INCARNATION")
        return Process(match[1], int(match[2]), int(match[3]))

    @property
    def place(self) -> tuple[str, int]:
        """(stage, replica): what its successors are too."""
        return self[:2]

    @property
    def path(self) -> str:
        """The end of its keys."""
        return f"{self.stage}/{self.replica}/{self.incarnation}"


class Packet(msgspec.Struct, frozen=True, gc=False):
    """What arrived on a key."""

    key: str
    payload: bytes
    sent_ns: int
    """Monotonic clock of this machine when it was sent; 0 where the sender did not say or has another clock."""
    arrived_ns: int

    @property
    def end(self) -> str:
        """The last part of its key: the port that it is delivered to, or the stage that it comes from."""
        return self.key.rpartition("/")[2]
