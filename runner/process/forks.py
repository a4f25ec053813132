"""Processes that are forked from one which has imported everything and constructed nothing.

A fork costs milliseconds where a new interpreter takes a second to import what a stage needs, and all that is forked
shares the memory of what was imported. Whoever forks must have one thread and, for equal bytes, compute on one: see
:func:`clean_environment`.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from runner.contract import Refused
from runner.process.children import DESCENT, ENVIRONMENT, Handle

EXIT_FAILED = 1
ROOM = 256
"""Characters that a clean environment keeps for the mark of a process that is forked."""


# ------------------------------------------------------------------------------------ whence it is forked


def clean_environment() -> dict[str, str]:
    """Of an interpreter in which libraries compute on one thread: they read that once, when they are imported."""
    paths = os.pathsep.join(path for path in sys.path if path)
    room = os.environ.get(DESCENT, "").ljust(ROOM)
    return {**os.environ, **ENVIRONMENT, DESCENT: room, "PYTHONUNBUFFERED": "1", "PYTHONPATH": paths}


def become_clean(module: str, *arguments: str) -> None:
    """Starts this process again, as ``python -m module``, unless it was started so."""
    clean = all(os.environ.get(name) == value for name, value in ENVIRONMENT.items())
    if not clean or len(os.environ.get(DESCENT, "")) < ROOM:
        os.execve(sys.executable, [sys.executable, "-m", module, *arguments], clean_environment())


# ------------------------------------------------------------------------------------ one process


class Threads(Refused):
    """A process cannot be forked: what its other threads hold would be held for ever."""


class Forked(Handle):
    """A child of this process that was forked, with the interface of :class:`subprocess.Popen`."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._polling = threading.Lock()

    def poll(self) -> int | None:
        """See :class:`Handle`."""
        with self._polling:
            if self.returncode is None:
                pid, status = os.waitpid(self.pid, os.WNOHANG)
                self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def send_signal(self, signum: int) -> None:
        """Signals this process alone; one that has gone is no error."""
        with self._polling:  # so that no other thread sees its end meanwhile: until then the kernel keeps its id
            if self.returncode is None:
                os.kill(self.pid, signum)

    def kill(self) -> None:
        """Leaves nothing of it behind."""
        self.send_signal(signal.SIGKILL)
        self.wait()


def refuse_threads() -> None:
    """Raises Threads where this process has more than one."""
    if len(names := [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]) > 1:
        raise Threads(f"what stages import must start no threads, or no process can be forked: {', '.join(names)}")


def fork(work: Callable[[], int | None], log: Path | None = None) -> int:
    """Calls ``work`` in a new process, which ends with the exit status that it returns; returns the process id.

    The process has a group of its own; what it prints goes to ``log``, if there is one. Raises Threads.
    """
    refuse_threads()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    if (pid := os.fork()) == 0:
        _run(work, log)
    with contextlib.suppress(OSError):  # it has done so itself, and may have gone
        os.setpgid(pid, pid)
    return pid


def _run(work: Callable[[], int | None], log: Path | None) -> NoReturn:
    """Never returns to what this process was forked from, whatever happens."""

    def logged() -> int | None:
        os.setpgid(0, 0)
        if log is not None:
            with log.open("ab") as output:
                os.dup2(output.fileno(), 1)
                os.dup2(output.fileno(), 2)
        return work()

    _end_with(logged)


# ------------------------------------------------------------------------------------ how a process ends


def end_with(main: Callable[[], int | None]) -> NoReturn:
    """Ends this process with the exit status that ``main`` returns, as ``sys.exit(main())`` does.

    But the interpreter is not taken apart: a thread that is in a call of Zenoh meanwhile would abort the process, such
    as the one that says goodbye to a machine which is cut off.
    """
    _end_with(lambda: call_to_the_end(main))


def call_to_the_end(main: Callable[[], int | None]) -> int | None:
    """Calls ``main`` and then what was registered with :mod:`atexit`."""
    try:
        return main()
    finally:
        atexit._run_exitfuncs()  # pyright: ignore - as multiprocessing does


def _end_with(work: Callable[[], int | None]) -> NoReturn:
    code = EXIT_FAILED
    try:
        code = work() or 0
    except SystemExit as end:
        code = _status(end)
    except BaseException:
        traceback.print_exc()
    finally:
        _leave(code)


def _status(end: SystemExit) -> int:
    """The exit status that an interpreter would make of it."""
    if end.code is None or isinstance(end.code, int):
        return end.code or 0
    print(end.code, file=sys.stderr)
    return EXIT_FAILED


def _leave(code: int) -> NoReturn:
    """Ends once all threads have, as an interpreter does, but without taking apart what it shares with others."""
    try:
        threading._shutdown()  # pyright: ignore - as multiprocessing does
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError as error:  # what cannot be written is no success
        code = code or EXIT_FAILED
        print(error, file=sys.stderr)
    finally:
        os._exit(code)
