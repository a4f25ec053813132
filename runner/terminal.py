"""What people see while a graph runs: one line at a time, with the time since the start and who says it."""

import os
import queue
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
MOST_WAITING = 1000
"""What may wait for a reader that stands still; what is said beyond that is left out."""
LAST_SECONDS = 2.0
"""Who takes nothing for so long at the end gets no more."""
_COLOURS: dict[Level, str] = {"debug": "\033[2m", "info": "", "warning": "\033[33m", "error": "\033[31m"}
_RESET = "\033[0m"


class Terminal:
    """Prints lines; colours only where somebody looks, and not with ``NO_COLOR``.

    Where somebody looks, who goes on and on has one line, the newest, below what stays.
    """

    def __init__(
        self, stream: TextIO | None = None, *, verbose: bool = False, needs_reader: bool = False, waits: bool = True
    ):
        """Prints to ``stream``, the standard output by default. ``verbose`` shows lines of level debug, too, and every
        line stays. ``needs_reader`` raises OSError where the lines cannot be printed any more.

        Unless it ``waits`` for its reader a thread prints, until it is closed: where the reader stands still, only who
        prints does.
        """
        self._stream = stream or sys.stdout
        self._verbose = verbose
        self._needs_reader = needs_reader
        self._seen = self._stream.isatty()
        self._colours = self._seen and not os.environ.get("NO_COLOR")
        self._progress: dict[str, str] = {}
        """The newest line of everybody who has one."""
        self._drawn = 0
        """Lines of progress that are on the screen."""
        self._started = time.monotonic()
        self._lock = threading.Lock()
        self._printer = None if waits else threading.Thread(target=self._print_waiting, name="printer", daemon=True)
        self._waiting: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        """What the printer is still to print."""
        self._left_out = 0
        """Lines since the last that was not."""

    def show(
        self, who: str, text: str, level: Level = "info", *, seconds: float | None = None, progress: str = ""
    ) -> None:
        """Prints ``12.3 s  who  text``; further lines of the text keep the whole width.

        ``seconds`` since the start of the graph; since that of this terminal by default. ``progress`` names whose
        progress it tells, if it does: it replaces what told that before, but for warnings and longer texts, which stay.
        """
        if level == "debug" and not self._verbose:
            return
        if self._waiting.qsize() >= MOST_WAITING:
            with self._lock:
                self._left_out += 1
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
        left_out = f"{self._left_out} lines left out, nobody read: the recording has them\n" if self._left_out else ""
        self._left_out = 0
        text = f"{above}{left_out}{line}{progress}"
        if self._printer is not None:
            self._waiting.put(text)
            if self._printer.ident is None:  # not before there is something to print: who forks must have one thread
                self._printer.start()
            return
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:  # the terminal is gone, or the pipe's reader: the recording has it all
            self._discard()
            if self._needs_reader:
                raise

    def _print_waiting(self) -> None:
        """Past Python's buffers, which the end of the process would wait for."""
        while (text := self._waiting.get()) is not None:
            data = text.encode(self._stream.encoding or "utf-8")
            try:
                while data:
                    data = data[os.write(self._stream.fileno(), data) :]
            except OSError:
                self._discard()

    def close(self) -> None:
        """Returns once all is printed, or nobody takes it."""
        self._waiting.put(None)
        left = self._waiting.qsize() + 1
        while self._printer is not None and self._printer.is_alive() and self._waiting.qsize() < left:
            left = self._waiting.qsize()
            self._printer.join(LAST_SECONDS)

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
