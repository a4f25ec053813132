"""Fresh processes for the stages of a replay, forked from one that has imported everything and constructed nothing."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Generic, TypeVar, cast

from runner.process.children import PARENT, die_with_parent, ending, last_lines
from runner.process.forks import Forked, fork

T = TypeVar("T")

STOP_SECONDS = 5.0


class Worker:
    """One forked process and the connection to it."""

    def __init__(self, work: Callable[[Connection], None], log: Path) -> None:
        """Calls ``work`` in the new process with its end of the connection; what it prints goes to ``log``."""
        self.log = log
        log.touch()
        parent = os.getpid()
        self.connection, theirs = Pipe()
        self._process = Forked(fork(lambda: _work(work, theirs, self.connection, parent), log))
        theirs.close()

    def receive(self) -> bytes:
        """What the process sends next; raises EOFError where it has ended instead."""
        return self.connection.recv_bytes()

    def end(self) -> str:
        """Waits for a process that has nothing more to say, and says how it ended."""
        self.connection.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(STOP_SECONDS)
        self.kill()
        return ": ".join([f"its process {ending(self._process.wait())}", *last_lines(self.log, 1)])

    def kill(self) -> None:
        """Leaves nothing behind."""
        self._process.kill()


def _work(work: Callable[[Connection], None], own: Connection, foreign: Connection, parent: int) -> None:
    foreign.close()
    os.environ[PARENT] = str(parent)
    die_with_parent()
    work(own)


@dataclass(frozen=True, slots=True)
class Job(Generic[T]):
    """Something to do in a process of its own."""

    item: T
    work: Callable[[], bytes]


def run_each(jobs: Iterable[Job[T]], *, workers: int, folder: Path) -> Iterator[tuple[T, bytes | str]]:
    """Does every job in a process of its own, ``workers`` at a time; yields each answer as it comes, or why there is
    none. Jobs are drawn one ahead, so that what a generator of them imports is imported while others work."""
    running: dict[Connection, tuple[T, Worker]] = {}
    try:
        for number, job in enumerate(jobs):
            while len(running) >= workers:
                yield _collected(running)
            child = Worker(_answering(job.work), folder / f"{number}.txt")
            running[child.connection] = (job.item, child)
        while running:
            yield _collected(running)
    finally:
        for _, child in running.values():
            child.kill()


def _answering(work: Callable[[], bytes]) -> Callable[[Connection], None]:
    return lambda connection: connection.send_bytes(work())


def _collected(running: dict[Connection, tuple[T, Worker]]) -> tuple[T, bytes | str]:
    ready = cast("Connection", wait(list(running))[0])
    item, child = running.pop(ready)
    try:
        answer: bytes | str = child.receive()
    except EOFError:
        return item, child.end()
    child.end()
    return item, answer
