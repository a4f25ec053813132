"""Fresh processes for the stages of a replay, forked from one that has imported everything and constructed nothing."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TypeVar, cast

from runner.process.children import PARENT, die_with_parent, ending, last_lines
from runner.process.forks import Forked, fork

T = TypeVar("T")
Job = Callable[[], AbstractContextManager[bytes]]
"""Gives the answer, and cleans up after it has been sent."""

STOP_SECONDS = 5.0


class Worker(Forked):
    """One forked process and the connection to it."""

    def __init__(self, work: Callable[[Connection], None], log: Path) -> None:
        """Calls ``work`` in the new process with its end of the connection; what it prints goes to ``log``."""
        self.log = log
        log.touch()
        parent = os.getpid()
        self.connection, theirs = Pipe()

        def begin() -> None:
            self.connection.close()
            os.environ[PARENT] = str(parent)
            for signum in (signal.SIGTERM, signal.SIGHUP):
                signal.signal(signum, signal.SIG_DFL)
            die_with_parent()
            work(theirs)

        super().__init__(fork(begin, log))
        theirs.close()

    def send(self, request: bytes) -> None:
        """To one that has ended nothing is sent: who receives next is told."""
        with suppress(BrokenPipeError):
            self.connection.send_bytes(request)

    def end(self) -> str:
        """Waits for a process that has nothing more to say, and says how it ended."""
        self.connection.close()
        with suppress(subprocess.TimeoutExpired):
            self.wait(STOP_SECONDS)
        self.kill()
        return ": ".join([f"its process {ending(self.wait())}", *last_lines(self.log, 1)])


def run_each(jobs: Iterable[tuple[T, Job]], *, workers: int, folder: Path) -> Iterator[tuple[T, bytes | str]]:
    """Does every job in a process of its own, ``workers`` at a time; yields each answer as it comes, or why there is
    none. Jobs are drawn one ahead, so that what a generator of them imports is imported while others work."""
    running: dict[Connection, tuple[T, Worker]] = {}
    try:
        for number, (item, work) in enumerate(jobs):
            while len(running) >= workers:
                yield _collected(running)
            child = Worker(partial(_answer, work), folder / f"{number}.txt")
            running[child.connection] = (item, child)
        while running:
            yield _collected(running)
    finally:
        for _, child in running.values():
            child.kill()


def _answer(work: Job, connection: Connection) -> None:
    with work() as answer:
        connection.send_bytes(answer)


def _collected(running: dict[Connection, tuple[T, Worker]]) -> tuple[T, bytes | str]:
    ready = cast("Connection", wait(list(running))[0])
    item, child = running.pop(ready)
    try:
        answer = ready.recv_bytes()
    except EOFError:
        return item, child.end()
    child.end()
    return item, answer
