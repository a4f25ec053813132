"""Starts the page of a run in a process of its own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator
from importlib.util import find_spec

from runner.contract import Refused
from runner.process.children import ENVIRONMENT, bound

END_SECONDS = 5.0
"""What the page may take to end in order."""
NEEDED = ("PIL", "starlette", "uvicorn", "websockets")


def require_page() -> None:
    """Raises Refused where what serves the page, which is an extra, is not installed."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise Refused(f"the page needs {', '.join(missing)}; type: pip install 'scene-programming[page]'")


@contextlib.contextmanager
def page_beside(run: str, say: Callable[[str], object]) -> Generator[subprocess.Popen[str]]:
    """Serves the page of a run meanwhile; ``say`` gets what it prints, its address above all."""
    command = bound([sys.executable, "-m", "runner.cli", "page", "--run", run])
    page = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        process_group=0,
        env={**os.environ, **ENVIRONMENT},
    )
    assert page.stdout is not None
    lines = map(str.rstrip, page.stdout)
    threading.Thread(target=lambda: deque(map(say, lines), maxlen=0), name="page", daemon=True).start()
    try:
        yield page
    finally:
        page.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            page.wait(END_SECONDS)
        page.kill()
        page.wait()
