"""Rerun's web viewer and recordings as it reads them, so that the page can show them from its own address."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncGenerator
from importlib.util import find_spec
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

from runner.contract import Refused
from runner.process.children import bound
from runner.recording.container import is_being_written, open_file

FILES = {
    "index.html": "text/html",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
}
_SERVES = "import rerun, sys; rerun.serve_web_viewer(web_port=int(sys.argv[1]), open_browser=False); sys.stdin.read()"
"""The viewer is inside of Rerun's library, which gives it out over HTTP alone."""
_SCRIPT = re.compile(rb"<script[^>]*>(.*?)</script>", re.DOTALL)
START_SECONDS = 60.0
PIECE_BYTES = 1 << 18


def viewer_files() -> dict[str, bytes]:
    """The files of the viewer by name, from a process that lives for as long as it takes to read them.

    Raises Refused where Rerun, which is an extra, is not installed.
    """
    if find_spec("rerun") is None:
        raise Refused("the viewer is Rerun, which is missing; type: pip install 'scene-programming[view]'")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = bound([sys.executable, "-c", _SERVES, str(port)])
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        try:
            return {name: _fetched(f"http://127.0.0.1:{port}/{name}") for name in FILES}
        finally:
            process.terminate()


def _fetched(url: str) -> bytes:
    """What is there, once somebody listens."""
    patience = time.monotonic() + START_SECONDS
    while True:
        try:
            with urlopen(url) as answer:
                return answer.read()
        except URLError:
            if time.monotonic() > patience:
                raise Refused("Rerun does not give out its web viewer") from None
            time.sleep(0.1)


def policy(html: bytes) -> str:
    """What the viewer may do, which is to run its own scripts and WebAssembly, and to call nobody but this server."""
    hashes = (base64.b64encode(hashlib.sha256(script).digest()).decode() for script in _SCRIPT.findall(html) if script)
    scripts = " ".join(f"'sha256-{one}'" for one in hashes)
    return (
        f"default-src 'self'; script-src 'self' 'wasm-unsafe-eval' {scripts}; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data: blob:; worker-src 'self' blob:; frame-ancestors 'self'; base-uri 'none'; "
        "form-action 'none'"
    )


async def drawn(recording: Path) -> AsyncGenerator[bytes]:
    """A recording as Rerun reads it, by ``runner view``, and what is added to it while its graph runs.

    The first piece comes once there is something to see; raises Refused instead where nothing can be drawn.
    """
    with open_file(recording) as file:
        live = ["--live"] if is_being_written(file) else []
    command = [sys.executable, "-m", "runner.cli", "view", str(recording), *live, "--save", "-"]
    with tempfile.TemporaryFile() as said:
        process = await asyncio.create_subprocess_exec(*bound(command), stdout=asyncio.subprocess.PIPE, stderr=said)
        assert process.stdout is not None
        try:
            piece = await process.stdout.read(PIECE_BYTES)
            if not piece:
                said.seek(0)
                lines = said.read().decode().strip()
                raise Refused(lines.rpartition("\n")[2] or "the viewer has drawn nothing")
            while piece:
                yield piece
                piece = await process.stdout.read(PIECE_BYTES)
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
