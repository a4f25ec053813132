"""Starts processes for one that has gone on to threads, sessions and contexts since it had imported everything."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import os
import sys
import threading
import time
from collections.abc import Callable, Generator
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec

from runner.process.children import DESCENT, PARENT, Handle, die_with_parent, ending, origin, spawn
from runner.process.forks import Forked, Threads, call_to_the_end, fork, refuse_threads

PREPARE_SECONDS = 180.0
"""How long the fork server may prepare a process."""
POLL_SECONDS = 0.05
_PR_SET_CHILD_SUBREAPER = 36


class Interrupted(Exception):
    """The graph ends before a process is started."""


class _Order(msgspec.Struct, frozen=True):
    """A process to start."""

    module: str
    """Its ``main`` takes the task from stdin and returns the exit status; its ``prepare``, if there is one, is called
    with the task before the fork."""
    name: str
    """What tells it from others of its module."""
    task: bytes
    log: str
    environment: dict[str, str]


class ForkServer:
    """Starts processes for one that has gone on to threads, sessions and contexts since it had imported everything.

    They are children of that one, the supervisor, as if it had started them itself: they die with it, it waits for
    them, and they outlive the fork server. To that end each is forked twice, and the supervisor adopts it when the
    process in between ends.
    """

    def __init__(self, warn: Callable[[str], object]) -> None:
        """Forks the server from this process with all that it has imported.

        Where that is not possible, or the server dies, new interpreters are started instead; ``warn`` is told why.
        """
        self._warn = warn
        self._server: Forked | None = None
        self._asking = threading.Lock()
        self._connection, theirs = Pipe()
        gc.freeze()  # a collection would write to every page, and whoever writes to a page has a copy of it
        gc.enable()
        try:
            self._server = Forked(fork(lambda: _serve(theirs, self._connection)))
        except Threads as reason:
            self._give_up(str(reason))
        theirs.close()

    def start(
        self,
        module: str,
        name: str,
        *,
        task: bytes,
        log: Path,
        mark: str = "",
        stopping: Callable[[], bool] = lambda: False,
    ) -> Handle:
        """Starts what :func:`spawn` would; ``name`` is shown with the module in lists of processes.

        ``stopping`` is asked first, and again and again while it is prepared: where that is true Interrupted is raised.
        """
        if stopping():
            raise Interrupted(name)
        if self._server is not None:
            log.touch()
            pid = self._ask(self._server, _Order(module, name, task, str(log), origin(mark)), stopping)
            if pid is not None:
                return Forked(pid)
        return spawn(module, task=task, log=log, mark=mark)

    def close(self) -> None:
        """Ends the server; what it has started lives on."""
        self._connection.close()
        if self._server is not None:
            self._server.wait()

    def _ask(self, server: Forked, order: _Order, stopping: Callable[[], bool]) -> int | None:
        """The id of a process that is there; None where there is no fork server any more."""
        try:
            with self._asking, _adopting():
                self._connection.send_bytes(msgspec.msgpack.encode(order))
                answer = self._answer(order.name, stopping)
        except (EOFError, OSError):
            answer = f"the fork server {ending(server.wait())}"
        except Interrupted:  # what it is at is of no use any more, and may take long
            server.kill()
            self._server = None
            raise
        if isinstance(answer, int):
            return answer
        server.kill()
        self._give_up(answer)
        return None

    def _answer(self, name: str, stopping: Callable[[], bool]) -> int | str:
        deadline = time.monotonic() + PREPARE_SECONDS
        while not self._connection.poll(POLL_SECONDS):
            if stopping():
                raise Interrupted(name)
            if time.monotonic() > deadline:
                return f"the fork server has not started {name} after {PREPARE_SECONDS:g} s"
        return msgspec.msgpack.decode(self._connection.recv_bytes(), type=int | str)

    def _give_up(self, reason: str) -> None:
        self._server = None
        self._warn(f"{reason}; from now on every process imports what it needs by itself")


@contextlib.contextmanager
def _adopting() -> Generator[None]:
    """Meanwhile, descendants of this process whose parent ends become its children."""
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    prctl(_PR_SET_CHILD_SUBREAPER, 1)
    try:
        yield
    finally:
        prctl(_PR_SET_CHILD_SUBREAPER, 0)


def _serve(connection: Connection, other_end: Connection) -> None:
    """Starts what it is told to until nobody is left to tell."""
    other_end.close()
    os.environ[PARENT] = str(os.getppid())
    die_with_parent()
    gc.disable()  # what it imports and computes stays
    _show(__name__, os.environ.get(DESCENT, ""))
    with contextlib.suppress(EOFError):
        while True:
            order = msgspec.msgpack.decode(connection.recv_bytes(), type=_Order)
            try:
                answer = _start(order, connection)
            except (Threads, OSError) as reason:
                answer = str(reason)
            connection.send_bytes(msgspec.msgpack.encode(answer))


def _start(order: _Order, connection: Connection) -> int:
    """Starts a process that the supervisor adopts; returns its id once that has happened and it is what it will be."""
    prepare = getattr(importlib.import_module(order.module), "prepare", None)
    if prepare is not None:
        with contextlib.suppress(Exception):  # the process itself says what is wrong
            prepare(order.task)
    refuse_threads()
    reading, writing = os.pipe()
    between = os.fork()
    if between == 0:
        parent = os.getpid()
        os.close(reading)
        with contextlib.suppress(BaseException):
            fork(lambda: _live(order, parent, connection, writing), Path(order.log))
        os._exit(0)
    os.close(writing)
    os.waitpid(between, 0)
    with open(reading, "rb") as answer:  # noqa: PTH123 - a descriptor
        pid = int.from_bytes(answer.read(), "little")
    if not pid:
        raise OSError(f"{order.module} {order.name} could not be forked")
    return pid


def _live(order: _Order, parent: int, connection: Connection, writing: int) -> int | None:
    """What the new process does, with the fork server's ``connection``, and a pipe to say that it is there."""
    connection.close()
    gc.freeze()
    gc.enable()
    _read_from_stdin(order.task)
    os.environ.update(order.environment)
    _show(f"{order.module} {order.name}", order.environment[DESCENT])
    sys.argv = [order.module]
    while os.getppid() == parent:  # until the supervisor has adopted it
        time.sleep(0.0005)
    os.write(writing, os.getpid().to_bytes(8, "little"))
    os.close(writing)
    return call_to_the_end(importlib.import_module(order.module).main)


def _read_from_stdin(task: bytes) -> None:
    file = os.memfd_create("task")
    os.write(file, task)
    os.lseek(file, 0, os.SEEK_SET)
    os.dup2(file, 0)
    os.close(file)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - a descriptor, and open as long as this process lives


def _show(title: str, descent: str) -> None:
    """Has the kernel show this process's own title and mark: in the memory with which its program was started."""
    addresses = Path("/proc/self/stat").read_text().rpartition(")")[2].split()[45:49]
    arguments, arguments_end, variables, variables_end = map(int, addresses)
    _overwrite(arguments, arguments_end - arguments, title)
    at = variables
    for entry in ctypes.string_at(variables, variables_end - variables).split(b"\0"):
        if entry.startswith(f"{DESCENT}=".encode()):
            _overwrite(at, len(entry) + 1, f"{DESCENT}={descent}")
        at += len(entry) + 1


def _overwrite(address: int, size: int, text: str) -> None:
    ctypes.memmove(address, text.encode()[: size - 1].ljust(size, b"\0"), size)
