"""Fresh processes for the stages of a replay, forked from one that has imported everything and constructed nothing.

A fork costs milliseconds where a new interpreter takes a second to import what a stage needs, and it shares the
recording's index. Whoever forks must have one thread and, for equal bytes, compute on one: see :func:`clean_command`.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Generic, TypeVar, cast

from runner.process.children import ENVIRONMENT, PARENT, die_with_parent, ending, last_lines

T = TypeVar("T")

_FORK = multiprocessing.get_context("fork")
STOP_SECONDS = 5.0


def clean_command(module: str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """Command and environment of an interpreter in which libraries compute on one thread."""
    paths = os.pathsep.join(path for path in sys.path if path)
    own = {PARENT: str(os.getpid()), "PYTHONUNBUFFERED": "1", "PYTHONPATH": paths}
    return [sys.executable, "-m", module, *arguments], {**os.environ, **ENVIRONMENT, **own}


def is_clean() -> bool:
    """True in an interpreter that was started as :func:`clean_command` says."""
    return all(os.environ.get(name) == value for name, value in ENVIRONMENT.items())


class Forked:
    """One forked process and the connection to it."""

    def __init__(self, work: Callable[[Connection], None], log: Path) -> None:
        """Calls ``work`` in the new process with its end of the connection; what it prints goes to ``log``."""
        self.log = log
        log.touch()
        ours, theirs = _FORK.Pipe()
        self.connection = ours
        self._process = _FORK.Process(target=_run, args=(work, theirs, log, os.getpid()), daemon=True)
        sys.stdout.flush()
        self._process.start()
        theirs.close()

    def receive(self) -> bytes:
        """What the process sends next; raises EOFError where it has ended instead."""
        return self.connection.recv_bytes()

    def end(self) -> str:
        """Waits for a process that has nothing more to say, and says how it ended."""
        self.connection.close()
        self._process.join(STOP_SECONDS)
        self.kill()
        return ": ".join([f"its process {ending(self._process.exitcode or 0)}", *last_lines(self.log, 1)])

    def kill(self) -> None:
        """Leaves nothing behind."""
        self._process.kill()
        self._process.join()


def _run(work: Callable[[Connection], None], connection: Connection, log: Path, parent: int) -> None:
    os.environ[PARENT] = str(parent)
    die_with_parent()
    with log.open("ab") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    work(connection)


@dataclass(frozen=True, slots=True)
class Job(Generic[T]):
    """Something to do in a process of its own."""

    item: T
    work: Callable[[], bytes]


def run_each(jobs: Iterable[Job[T]], *, workers: int, folder: Path) -> Iterator[tuple[T, bytes | str]]:
    """Does every job in a process of its own, ``workers`` at a time; yields each answer as it comes, or why there is
    none. Jobs are drawn one ahead, so that what a generator of them imports is imported while others work."""
    running: dict[Connection, tuple[T, Forked]] = {}
    try:
        for number, job in enumerate(jobs):
            while len(running) >= workers:
                yield _collected(running)
            child = Forked(_answering(job.work), folder / f"{number}.txt")
            running[child.connection] = (job.item, child)
        while running:
            yield _collected(running)
    finally:
        for _, child in running.values():
            child.kill()


def _answering(work: Callable[[], bytes]) -> Callable[[Connection], None]:
    return lambda connection: connection.send_bytes(work())


def _collected(running: dict[Connection, tuple[T, Forked]]) -> tuple[T, bytes | str]:
    ready = cast("Connection", wait(list(running))[0])
    item, child = running.pop(ready)
    try:
        answer: bytes | str = child.receive()
    except EOFError:
        return item, child.end()
    child.end()
    return item, answer
