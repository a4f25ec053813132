"""A process that does what its task says, in Python."""

import os
import sys

PREPARED: list[int] = []
"""Processes that have prepared a task that says so, whatever comes of it."""


def prepare(task: bytes) -> None:
    """Takes note of the process, and fails."""
    if b"PREPARED" in task:
        PREPARED.append(os.getpid())
        raise ValueError("nobody hears of it")


def main() -> int:
    """Executes stdin; the exit status is what that leaves in ``code``."""
    names = {"code": 0, "PREPARED": PREPARED}
    exec(sys.stdin.read(), names)
    return names["code"]


if __name__ == "__main__":
    sys.exit(main())
