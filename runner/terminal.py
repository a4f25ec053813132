"""What people see while a graph runs: one line at a time, with the time since the start and who says it."""

import os
import shutil
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
    """Prints lines; colours only where somebody looks, and not with ``NO_COLOR``.

    Where somebody looks, who goes on and on has one line, the newest, below what stays.
    """

    def __init__(self, stream: TextIO = sys.stdout, *, verbose: bool = False, needs_reader: bool = False):
        """``verbose`` shows lines of level debug, too, and every line stays. ``needs_reader`` raises OSError where the
        lines cannot be printed any more.
        """
        self._stream = stream
        self._verbose = verbose
        self._needs_reader = needs_reader
        self._seen = stream.isatty()
        self._colours = self._seen and not os.environ.get("NO_COLOR")
        self._progress: dict[str, str] = {}
        """The newest line of everybody who has one."""
        self._drawn = 0
        """Lines of progress that are on the screen."""
        self._started = time.monotonic()
        self._lock = threading.Lock()

    def show(
        self, who: str, text: str, level: Level = "info", *, seconds: float | None = None, progress: str = ""
    ) -> None:
        """Prints ``12.3 s  who  text``; further lines of the text keep the whole width.

        ``seconds`` since the start of the graph; since that of this terminal by default. ``progress`` names whose
        progress it tells, if it does: it replaces what told that before, but for warnings and longer texts, which stay.
        """
        if level == "debug" and not self._verbose:
            return
        elapsed = time.monotonic() - self._started if seconds is None else seconds
        head = f"{elapsed:7.1f} s  {who:<{WIDTH}} "
        if progress and self._seen and not self._verbose and level == "info" and len(text.splitlines()) == 1:
            with self._lock:
                self._progress[progress] = f"{head}{text}"
                self._write("", self._redrawn())
            return
        for line in text.splitlines() or [""]:
            self._print(f"{head}{line}".rstrip(), level)
            head = ""

    def plain(self, *lines: str) -> None:
        """Prints lines of the command itself, below all that was said."""
        with self._lock:
            self._progress, self._drawn = {}, 0
        for line in lines:
            self._print(line, "info")

    def _print(self, line: str, level: Level) -> None:
        colour = _COLOURS[level] if self._colours else ""
        with self._lock:
            self._write(f"{colour}{self._printable(line)}{_RESET if colour else ''}\n", self._redrawn())

    def _redrawn(self) -> str:
        """The lines of progress, each as long as fits."""
        width = shutil.get_terminal_size().columns - 1
        return "".join(f"{self._printable(line)[:width]}\n" for line in self._progress.values())

    def _write(self, line: str, progress: str) -> None:
        """Puts a line above the progress, and that anew."""
        above = f"\033[{self._drawn}A\033[J" if self._drawn else ""
        self._drawn = len(self._progress)
        try:
            self._stream.write(f"{above}{line}{progress}")
            self._stream.flush()
        except OSError:  # the terminal is gone, or the pipe's reader: the recording has it all
            self._discard()
            if self._needs_reader:
                raise

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
