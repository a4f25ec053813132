"""Child processes: how they are started, die with their parent and say what went wrong.

As a program, ``children.py PARENT COMMAND...``, it becomes a command that dies with its parent, a process id.
"""

import contextlib
import ctypes
import faulthandler
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Protocol

TAIL_BYTES = 4096
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
OOM_SCORE = 500
"""The kernel that runs out of memory takes a stage before the recorder and the supervisor, which explain it."""
_PR_SET_PDEATHSIG = 1


def spawn(module: str, *arguments: str, task: bytes, log: Path) -> subprocess.Popen[bytes]:
    """Starts ``python -m module`` in a process group of its own, with its task on stdin and its output in a file."""
    with log.open("ab") as output:
        child = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            env={**os.environ, **ENVIRONMENT, **_origin(), "PYTHONUNBUFFERED": "1"},
            process_group=0,
        )
    assert child.stdin is not None
    with contextlib.suppress(BrokenPipeError), child.stdin as pipe:
        pipe.write(task)
    return child


def _origin() -> dict[str, str]:
    return {PARENT: str(os.getpid()), "PYTHONPATH": os.pathsep.join(sys.path)}


def die_with_parent(signum: signal.Signals = signal.SIGKILL) -> None:
    """Asks the kernel for a signal to this process when its parent dies; it comes at once where that has happened."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signum)
    if is_orphan():
        os.kill(os.getpid(), signum)


def is_orphan() -> bool:
    """Whether the process that started this one with :func:`spawn` has died."""
    return os.getppid() != int(os.environ.get(PARENT, os.getppid()))


def explain_death() -> None:
    """Has a crash in native code, and the supervisor's :data:`DUMP`, print where Python was."""
    faulthandler.enable(all_threads=False)
    faulthandler.register(DUMP, all_threads=False)


def volunteer_for_oom() -> None:
    """Makes this process the kernel's choice when memory runs out."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE))


def bound(command: list[str]) -> list[str]:
    """A command that dies with the process that starts it, also where it is no program of ours."""
    return [sys.executable, __file__, str(os.getpid()), *command]


class Elsewhere(Protocol):
    """A process on another host."""

    def signal_group(self, signum: int) -> None:
        """Has it signalled with everything it started."""
        ...


def signal_group(child: subprocess.Popen[bytes] | Elsewhere, signum: signal.Signals) -> None:
    """Signals a child and everything it started; one that has gone is no error."""
    if not isinstance(child, subprocess.Popen):
        child.signal_group(signum)
        return
    try:
        os.killpg(child.pid, signum)
    except ProcessLookupError:
        return


def last_lines(log: Path, count: int, start: int = 0) -> list[str]:
    """The last non-empty lines of what a child printed; ``start`` is where its part of the file begins."""
    with log.open("rb") as file:
        file.seek(max(start, log.stat().st_size - TAIL_BYTES))
        lines = file.read().decode(errors="replace").splitlines()
    return [line for line in lines if line.strip()][-count:]


def ending(code: int) -> str:
    """An exit status in words."""
    if code >= 0:
        return f"ended with exit code {code}"
    names = {int(one): one.name for one in signal.Signals}
    return f"killed by {names.get(-code, f'signal {-code}')}"


def main() -> None:
    """Becomes the command it is given, which then dies with its parent."""
    _, os.environ[PARENT], *command = sys.argv
    die_with_parent()
    del os.environ[PARENT]
    os.execvp(command[0], command)


if __name__ == "__main__":
    main()
