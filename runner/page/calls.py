"""Commands that are called from a page: each is followed on a thread of its own until the stage has done it."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable

import msgspec

from runner.contract import Level, Refused
from runner.inspect.echo import lines_of
from runner.live.live import Live
from runner.supervise.calls import CallRequest

KEPT = 12
SHOWN_LINES = 40
"""Of an answer."""


class Call(msgspec.Struct):
    """A command that was called, and how it goes."""

    id: str
    stage: str
    command: str
    lines: list[tuple[Level, str]] = []
    done: bool = False
    refused: str = ""
    answer: list[str] = []


class PageCalls:
    """The newest calls of all pages."""

    def __init__(self, live: Live, changed: Callable[[], object]) -> None:
        """``changed`` is called, on another thread, when there is news of one."""
        self._live = live
        self._changed = changed
        self._calls: list[Call] = []
        self._lock = threading.Lock()

    def call(self, request: CallRequest) -> str:
        """Calls a command and returns its id; raises Refused where that is not possible."""
        call = Call(self._live.call(request), request.stage, request.command)
        self._calls = [*self._calls[1 - KEPT :], call]
        threading.Thread(target=self._follow, args=(call,), name=call.id, daemon=True).start()
        return call.id

    def told(self, say: Callable[[str], str]) -> list[Call]:
        """All that are remembered, as they are now; ``say`` puts into words why one was refused."""
        with self._lock:
            return [msgspec.structs.replace(call, refused=say(call.refused)) for call in self._calls]

    def _follow(self, call: Call) -> None:
        try:
            for progress in self._live.follow(call.id):
                with self._lock:
                    call.lines = [*call.lines, *progress.lines]
                    call.done, call.refused = progress.done, progress.refused
                    call.answer = (
                        list(itertools.islice(lines_of(progress.answer), SHOWN_LINES)) if progress.answer else []
                    )
                self._changed()
        except Refused as refusal:
            with self._lock:
                call.done, call.refused = True, str(refusal)
            self._changed()
