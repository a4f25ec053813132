"""What people see while a graph runs: one line at a time, with the time since the start and who says it."""

import os
import sys
import threading
import time
from collections.abc import Sequence
from typing import TextIO

from runner.contract import Level

WIDTH = 16
FEW = 5
"""Of many things, those that are named."""
_COLOURS: dict[Level, str] = {"debug": "\033[2m", "info": "", "warning": "\033[33m", "error": "\033[31m"}
_RESET = "\033[0m"


class Terminal:
    """Prints lines; colours only where somebody looks, and not with ``NO_COLOR``."""

    def __init__(self, stream: TextIO = sys.stdout, *, verbose: bool = False):
        """``verbose`` shows lines of level debug, too."""
        self._stream = stream
        self._verbose = verbose
        self._colours = stream.isatty() and not os.environ.get("NO_COLOR")
        self._started = time.monotonic()
        self._lock = threading.Lock()

    def show(self, who: str, text: str, level: Level = "info", *, seconds: float | None = None) -> None:
        """Prints ``12.3 s  who  text``; further lines of the text keep the whole width.

        ``seconds`` since the start of the graph; since that of this terminal by default.
        """
        if level == "debug" and not self._verbose:
            return
        elapsed = time.monotonic() - self._started if seconds is None else seconds
        head = f"{elapsed:7.1f} s  {who:<{WIDTH}} "
        for line in text.splitlines() or [""]:
            self._print(f"{head}{line}".rstrip(), level)
            head = ""

    def plain(self, *lines: str) -> None:
        """Prints lines of the command itself."""
        for line in lines:
            self._print(line, "info")

    def _print(self, line: str, level: Level) -> None:
        colour = _COLOURS[level] if self._colours else ""
        with self._lock:
            try:
                self._stream.write(f"{colour}{self._printable(line)}{_RESET if colour else ''}\n")
                self._stream.flush()
            except OSError:  # the terminal is gone, or the pipe's reader: the recording has it all
                self._discard()

    def _printable(self, line: str) -> str:
        """What a stage says must neither break the encoding of the terminal nor steer it."""
        shown = "".join(one if one.isprintable() else repr(one)[1:-1] for one in line)
        encoding = self._stream.encoding or "utf-8"
        return shown.encode(encoding, "backslashreplace").decode(encoding)

    def _discard(self) -> None:
        """Sends what is still to be printed nowhere."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)


def listed(items: Sequence[str], joint: str = ", ") -> str:
    """The first few, and how many more there are."""
    more = f" and {len(items) - FEW} more" if len(items) > FEW else ""
    return f"{joint.join(items[:FEW])}{more}"


def has_display() -> bool:
    """Whether windows can be opened."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
