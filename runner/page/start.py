"""Starts the page of a run in a process of its own."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Generator
from importlib.util import find_spec

from runner.contract import Refused
from runner.process.children import bound

NEEDED = ("PIL", "starlette", "uvicorn", "websockets")


def require_page() -> None:
    """Raises Refused where what serves the page, which is an extra, is not installed."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise Refused(f"the page needs {', '.join(missing)}; type: pip install 'scene-programming[page]'")


@contextlib.contextmanager
def page_beside(run: str) -> Generator[None]:
    """Serves the page of a run meanwhile. It prints its address on this terminal: a file could be read by others."""
    command = bound([sys.executable, "-m", "runner.cli", "page", "--run", run])
    page = subprocess.Popen(command, stdin=subprocess.DEVNULL, process_group=0)
    try:
        yield
    finally:
        page.terminate()
        page.wait()
