"""Reaches a graph that runs, and asks its supervisor."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec

from runner.contract import Refused
from runner.graph.document import suggest
from runner.message.packet import Packet
from runner.supervise.calls import CallQuestion, CallRequest, CommandType, Progress
from runner.supervise.registry import Entry, is_alive
from runner.supervise.status import RunStatus
from runner.transport.bus import Bus

T = TypeVar("T")
ANSWER_SECONDS = 10.0
POLL_SECONDS = 0.1
RESTART_SECONDS = 300.0
"""Bringing a stage back takes as long as its models take to load."""
WINDOW_NS = 10_000_000_000
"""Rates are taken over the last ten seconds."""
BACKLOG = 1000
"""Messages that a slow terminal may fall behind; what is older is left out."""


class Header(NamedTuple):
    """What is known of a message without its content."""

    sent_ns: int
    arrived_ns: int
    size: int
    """Bytes of the envelope."""


class Live(contextlib.AbstractContextManager["Live"]):
    """A connection to one run, to be used in a ``with`` statement."""

    def __init__(self, entry: Entry) -> None:
        """Raises Refused where the run does not answer any more."""
        self.entry = entry
        try:
            self.bus = Bus(entry.run, entry.gateway, client=True)
        except Refused as refusal:
            raise Refused(f"{entry.run}: cannot be reached: {refusal}") from None

    def __exit__(self, *_: object) -> None:
        self.bus.close()

    def status(self) -> RunStatus:
        """How the run and each of its processes is."""
        return self._ask("status", b"", RunStatus)

    def wait_until_ready(self, say: Callable[[str], object] = lambda _: None) -> None:
        """Waits for processes that still start; ``say`` is told which."""
        waited_for: list[str] = []
        while not (status := self.status()).ready:
            starting = [process.name for process in status.processes if process.state == "starting"]
            if starting and starting != waited_for:
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

    def messages(self, topic: str) -> Iterator[Packet]:
        """Messages of a topic (``stage/port``) from now on, until the run ends."""
        backlog = deque[Packet](maxlen=BACKLOG)
        self.bus.hand_over(f"m/{self._known(topic)}", backlog.append)
        lives = True
        while lives:
            lives = is_alive(self.entry)
            while backlog:
                yield backlog.popleft()
            time.sleep(POLL_SECONDS)

    def headers(self, topic: str) -> Iterator[list[Header]]:
        """Once a second the headers of the last ten seconds, until the run ends."""
        window = deque[Header]()

        def enter(packet: Packet) -> None:
            window.append(Header(packet.sent_ns, packet.arrived_ns, len(packet.payload)))

        self.bus.hand_over(f"m/{self._known(topic)}", enter)
        while is_alive(self.entry):
            time.sleep(1.0)
            while window and window[0].arrived_ns < time.monotonic_ns() - WINDOW_NS:
                window.popleft()
            yield list(window)

    def _known(self, topic: str) -> str:
        """The topic as its key spells it; raises Refused where the run has none of that name."""
        name = topic.replace(".", "/", 1)
        known = [found.topic for found in self.status().topics]
        if name not in known:
            raise Refused(f"{self.entry.run}: no topic {topic!r}{suggest(name, known)}")
        return name

    def _ask(self, name: str, question: bytes, kind: type[T]) -> T:
        return msgspec.json.decode(self.bus.ask(name, question, ANSWER_SECONDS), type=kind)


def recording_of(entry: Entry) -> Path:
    """The file that a run writes, once something is in it: the run is listed before."""
    path = Path(entry.recording)
    while not (path.exists() and path.stat().st_size) and is_alive(entry):
        time.sleep(POLL_SECONDS)
    return path


def wait_until_gone(entry: Entry) -> None:
    """Returns once a run that ends has left nothing running."""
    while is_alive(entry):
        time.sleep(POLL_SECONDS)
