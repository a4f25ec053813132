"""Reaches a run that lives, and asks its supervisor."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import TypeVar

import msgspec
import zenoh

from runner.bus import Bus
from runner.calls import CallQuestion, CallRequest, CommandType, Progress
from runner.contract import Refused
from runner.registry import Entry
from runner.status import RunStatus

T = TypeVar("T")
ANSWER_SECONDS = 10.0
POLL_SECONDS = 0.1
RESTART_SECONDS = 300.0
"""Bringing a stage back takes as long as its models take to load."""


class Live:
    """A connection to one run, to be used in a ``with`` statement."""

    def __init__(self, entry: Entry) -> None:
        """Raises Refused where the run does not answer any more."""
        self.entry = entry
        try:
            self.bus = Bus(entry.run, connect=entry.endpoint)
        except zenoh.ZError as error:
            raise Refused(f"{entry.run}: cannot be reached at {entry.endpoint}: {error}") from None

    def __enter__(self) -> Live:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.bus.close()

    def status(self) -> RunStatus:
        """How the run and each of its processes is."""
        return self._ask("status", b"", RunStatus)

    def wait_until_ready(self, say: Callable[[str], object] = lambda _: None) -> None:
        """Waits for processes that still start; ``say`` is told which."""
        waited_for: list[str] = []
        while not (status := self.status()).ready:
            starting = [process.name for process in status.processes if process.state == "starting"]
            if starting != waited_for:
                say(f"waiting for {', '.join(starting)}")
            waited_for = starting
            time.sleep(POLL_SECONDS)

    def commands(self) -> list[CommandType]:
        """What its stages can be asked."""
        return self._ask("commands", b"", list[CommandType])

    def call(self, request: CallRequest) -> str:
        """Calls a command and returns its id."""
        return self.bus.ask("call", msgspec.json.encode(request), ANSWER_SECONDS).decode()

    def follow(self, id: str) -> Iterator[Progress]:
        """News of a call, until it is done."""
        seen = 0
        while True:
            progress = self._ask("progress", msgspec.json.encode(CallQuestion(id, seen)), Progress)
            seen += len(progress.lines)
            yield progress
            if progress.done:
                return

    def restart(self, process: str) -> str:
        """Replaces one process in order; returns what became of it."""
        return self.bus.ask("restart", process.encode(), RESTART_SECONDS).decode()

    def down(self) -> None:
        """Asks the run to end."""
        self.bus.ask("down", b"", ANSWER_SECONDS)

    def _ask(self, name: str, question: bytes, kind: type[T]) -> T:
        return msgspec.json.decode(self.bus.ask(name, question, ANSWER_SECONDS), type=kind)
