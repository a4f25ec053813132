"""Child processes: how they are started, die with their parent, leave nothing behind and say what went wrong.

As a program, ``children.py PARENT COMMAND...``, it becomes a command that dies with its parent, a process id;
``children.py after NAME`` waits until stdin is closed and ends all processes of the :class:`Descendants` of that name.
"""

import contextlib
import ctypes
import faulthandler
import os
import re
import secrets
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

TAIL_BYTES = 2**15
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    "MALLOC_MMAP_THRESHOLD_": str(32 * 2**20),
    "MALLOC_TRIM_THRESHOLD_": str(256 * 2**20),
    "MALLOC_TOP_PAD_": str(16 * 2**20),
}
"""Of every child. Results must not depend on a thread count, and processes share the cores already. Memory is kept
for the next message: pages fresh from the kernel cost thrice what writing an image to a recording does without them."""
DUMP = signal.SIGUSR2
"""Makes a child print where it is."""
PARENT = "RUNNER_PARENT"
"""Names the variable that tells a child who started it."""
DESCENT = "RUNNER_DESCENT"
"""Names the variable that tells of which processes of runs a process descends, in whatever session or group it is."""
DEVICE_GRACE_SECONDS = 10.0
"""What a device may take to come to rest before it is killed."""
DESCENDANT_GRACE_SECONDS = 0.5
"""What a descendant that is asked to end gets to clean up before it is killed."""
DEATH_SECONDS = 3.0
"""After that what was killed is given up: the kernel holds it."""
LOOK_SECONDS = 0.01
"""Between two looks for descendants. Two must find none: one that is just replaced by another program shows nothing."""
LONGEST_PAUSE_SECONDS = 0.02
"""Between two looks whether a process has ended."""
SHOWN_CHARACTERS = 100
_AFTER = "after"
_ENDS = "ends: "
"""Marks last words among all that a process prints."""
OOM_SCORE = 500
"""The kernel that runs out of memory takes a stage before the recorder and the supervisor, which explain it."""
_PR_SET_PDEATHSIG = 1


class Handle(Protocol):
    """A process that was started, here or on another host."""

    pid: int
    returncode: int | None
    """Once :meth:`poll` or :meth:`wait` has seen its end; negative where a signal killed it."""

    def poll(self) -> int | None:
        """Its exit code, None while it lives."""
        ...

    def wait(self, timeout: float | None = None) -> int:
        """Waits for its end; raises subprocess.TimeoutExpired."""
        began, pause = time.monotonic(), 0.0005
        while (code := self.poll()) is None:
            if timeout is not None and time.monotonic() - began >= timeout:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout)
            time.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE_SECONDS)
        return code

    def send_signal(self, signum: int, /) -> None:
        """Signals this process alone; one that has gone is no error."""
        ...

    def signal_group(self, signum: int) -> None:
        """Signals it and everything it has started, also once it has gone."""
        signal_group(self.pid, signum)


def end_process(handle: Handle, seconds: float) -> None:
    """Waits for the end of a process, and kills it where that does not come, and whatever it has left behind.

    One that waits for a device or a disk which does not answer cannot be killed, and is left.
    """
    for patience in (seconds, DEATH_SECONDS):
        with contextlib.suppress(subprocess.TimeoutExpired):
            handle.wait(patience)
        handle.signal_group(signal.SIGKILL)


class Spawned(subprocess.Popen[bytes]):
    """A process in a group of its own."""

    signal_group = Handle.signal_group


def spawn(module: str, *arguments: str, task: bytes, log: Path, mark: str = "") -> Spawned:
    """Starts ``python -m module`` in a process group of its own, with its task on stdin and its output in a file.

    What it starts in turn carries its ``mark``, see :class:`Descendants`.
    """
    with log.open("ab") as output:
        child = Spawned(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            env={**os.environ, **ENVIRONMENT, **origin(mark), "PYTHONUNBUFFERED": "1"},
            process_group=0,
        )
    assert child.stdin is not None
    with contextlib.suppress(BrokenPipeError), child.stdin as pipe:
        pipe.write(task)
    return child


def origin(mark: str) -> dict[str, str]:
    """Variables that tell a child of this process whence it comes."""
    descent = " ".join([*os.environ.get(DESCENT, "").split(), mark])
    return {PARENT: str(os.getpid()), DESCENT: descent, "PYTHONPATH": os.pathsep.join(sys.path)}


class Descendants:
    """The children of this process with all that descends from them; none of it outlives this process, even killed.

    Children die by a signal from the kernel, which what they have started does not get: one more process, the last,
    ends that. It waits on a pipe that closes when this process ends, in whatever way.
    """

    def __init__(self) -> None:
        self._name = secrets.token_hex(8)
        self._last = subprocess.Popen(
            [sys.executable, "-I", "-S", __file__, _AFTER, self._name],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            process_group=0,
        )

    def mark(self, path: str) -> str:
        """What a child is to carry; ``path`` tells it from the others."""
        return f"{self._name}/{path}"

    def end(self, path: str) -> list[str]:
        """Ends what a child that has gone has left behind; returns the command lines."""
        return end_descendants(self.mark(path))

    def close(self) -> list[str]:
        """Ends what all of them have left behind; returns the command lines."""
        left = end_descendants(self._name)
        with self._last:
            self._last.kill()
        return left


def end_descendants(mark: str) -> list[str]:
    """Asks all that carry a mark, or one below it, to end, then kills them until none is left; returns their command
    lines. What has cleared its environment is not found."""
    ended: dict[int, str] = {}
    start, clear = time.monotonic(), 0
    while clear < 2 and (passed := time.monotonic() - start) < DEATH_SECONDS:
        found = _descendants(mark)
        for pid in found:
            if passed > DESCENDANT_GRACE_SECONDS:
                _signal(pid, signal.SIGKILL)
            elif pid not in ended:
                _signal(pid, signal.SIGTERM)
        # Of one that is about to go the command line cannot be read any more.
        ended = found | ended
        clear = 0 if found else clear + 1
        time.sleep(LOOK_SECONDS)
    return list(ended.values())


def _descendants(mark: str) -> dict[int, str]:
    """Command lines of the others that carry a mark, by process id; none where there is no ``/proc``."""
    pattern = re.compile(rf"(?:^|\0){DESCENT}=(?:[^\0]* )?{re.escape(mark)}(?:[/ \0]|$)".encode())
    found: dict[int, str] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has gone, or is another user's
            if pattern.search((entry / "environ").read_bytes()) and int(entry.name) != os.getpid():
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
                found[int(entry.name)] = line[:SHOWN_CHARACTERS] or f"process {entry.name}"
    return found


def _signal(pid: int, signum: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.kill(pid, signum)


def behind(lines: list[str]) -> str:
    """Says what was left behind, after the name of who left it."""
    counts = Counter(lines)
    return f"left behind, ended now: {', '.join(f'{count} x {line}' for line, count in counts.items())}"


def die_with_parent(signum: signal.Signals = signal.SIGKILL) -> None:
    """Asks the kernel for a signal to this process when its parent dies; it comes at once where that has happened."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signum)
    if is_orphan():
        os.kill(os.getpid(), signum)


def is_orphan() -> bool:
    """Whether the process that started this one with :func:`spawn` has died."""
    return os.getppid() != int(os.environ.get(PARENT, os.getppid()))


def print_where_it_crashes() -> None:
    """Has a crash in native code, and the supervisor's :data:`DUMP`, print where Python was."""
    faulthandler.enable(all_threads=False)
    faulthandler.register(DUMP, all_threads=False)


def last_words(reason: str, details: str = "") -> None:
    """Prints why this process ends, which it does in the same way where its log is on a full disk."""
    with contextlib.suppress(OSError):
        print(f"{details}{_ENDS}{' '.join(filter(None, reason.splitlines()))}", file=sys.stderr, flush=True)


def reason_in(log: Path, start: int = 0) -> str:
    """Why a child ended: its last words, whatever it printed after them, or without them the last that it printed."""
    lines = last_lines(log, TAIL_BYTES, start)
    words = [line.removeprefix(_ENDS) for line in lines if line.startswith(_ENDS)]
    return next(reversed(words or lines), "")


def prefer_for_oom_kill() -> None:
    """Makes this process the kernel's choice when memory runs out."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE))


def bound(command: list[str]) -> list[str]:
    """A command that dies with the process that starts it, also where it is no program of ours."""
    return [sys.executable, __file__, str(os.getpid()), *command]


def signal_group(group: int, signum: int) -> None:
    """Signals all processes of a group; one that has gone is no error."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signum)


def last_lines(log: Path, count: int, start: int = 0) -> list[str]:
    """The last lines of what a child printed that say something; ``start`` is where its part of the file begins.

    None where the file cannot be read: somebody may have moved or deleted it.
    """
    try:
        with log.open("rb") as file:
            file.seek(max(start, log.stat().st_size - TAIL_BYTES))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        return []
    return list(_telling(lines))[-count:]


def _telling(lines: list[str]) -> Iterator[str]:
    """Leaves out of a crash's dump what a forked process has from those that it was forked from."""
    inherited = False
    for line in lines:
        inherited = line.startswith('  File "') and (inherited or "runner/process/fork" in line)
        if line.strip() and not inherited and not line.startswith("Extension modules:"):
            yield line


def ending(code: int) -> str:
    """An exit status in words."""
    if code >= 0:
        return f"ended with exit code {code}"
    names = {int(one): one.name for one in signal.Signals}
    return f"killed by {names.get(-code, f'signal {-code}')}"


def main() -> None:
    """Becomes the command it is given, which then dies with its parent, or the last of a :class:`Descendants`."""
    if sys.argv[1] == _AFTER:
        sys.stdin.read()
        end_descendants(sys.argv[2])
        return
    _, os.environ[PARENT], *command = sys.argv
    die_with_parent()
    del os.environ[PARENT]
    os.execvp(command[0], command)


if __name__ == "__main__":
    main()
