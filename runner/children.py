"""Child processes: how they are started, die with their parent and say what went wrong."""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path

TAIL_BYTES = 4096
SINGLE_THREADED = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""Results must not depend on a thread count, and processes share the cores already."""
_PR_SET_PDEATHSIG = 1


def spawn(module: str, *arguments: str, task: bytes, log: Path) -> subprocess.Popen[bytes]:
    """Starts ``python -m module`` in a process group of its own, with its task on stdin and its output in a file."""
    with log.open("ab") as output:
        child = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            env={**os.environ, **SINGLE_THREADED, "PYTHONUNBUFFERED": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
            process_group=0,
        )
    assert child.stdin is not None
    with contextlib.suppress(BrokenPipeError), child.stdin as pipe:
        pipe.write(task)
    return child


def die_with_parent(signum: signal.Signals = signal.SIGKILL) -> None:
    """Asks the kernel for a signal to this process when its parent dies."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signum)


def signal_group(child: subprocess.Popen[bytes], signum: signal.Signals) -> None:
    """Signals a child and everything it started; one that has gone is no error."""
    try:
        os.killpg(child.pid, signum)
    except ProcessLookupError:
        return


def last_lines(log: Path, count: int) -> list[str]:
    """The last non-empty lines of what a child printed."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - TAIL_BYTES))
        lines = file.read().decode(errors="replace").splitlines()
    return [line for line in lines if line.strip()][-count:]


def ending(code: int) -> str:
    """An exit status in words."""
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
