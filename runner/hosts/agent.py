"""One host of a graph that is not its head: starts and ends processes as the head says, and ends with its connection.

Whatever cuts it off from the head, its processes do not outlive that: they have been replaced meanwhile.
"""

from __future__ import annotations

import contextlib
import queue
import re
import secrets
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec

from runner.contract import Refused
from runner.graph.document import Document
from runner.graph.placement import read_layout
from runner.hosts.head import (
    PIECE_BYTES,
    Dismiss,
    Ended,
    Order,
    Report,
    Signal,
    Start,
    Started,
    control,
    introduce,
    network_of,
)
from runner.message.packet import Packet, Process
from runner.process.children import DEVICE_GRACE_SECONDS, Descendants, Handle, behind, end_process, last_lines
from runner.process.fork_server import ForkServer, Interrupted
from runner.process.forks import EXIT_FAILED
from runner.terminal import Terminal
from runner.transport.bus import Bus
from runner.transport.session import private

ASK_SECONDS = 15.0
TICK_SECONDS = 0.05
TAIL_LINES = 40
GONE = 1
"""Exit status where the head has gone or cannot be reached."""


@dataclass(slots=True)
class _Child:
    handle: Handle
    log: Path
    log_from: int
    """Where its own lines begin in the log."""


class Agent:
    """What ``runner up GRAPH --host NAME`` is on every host but the head."""

    def __init__(self, document: Document, host: str, *, recordings: Path, terminal: Terminal, forks: ForkServer):
        """Checks the host's credentials; raises Refused where they do not hold."""
        self._document = document
        self._layout = read_layout(document)
        self._network = network_of(self._layout, host)
        self._host = host
        self._recordings = recordings
        self._terminal = terminal
        self._forks = forks
        self._session = secrets.randbits(24)
        self._events: queue.SimpleQueue[Order] = queue.SimpleQueue()
        self._killed: set[Process] = set()
        self._dismissed = False
        """Both are heard at once, also while a process is being prepared."""
        self._head_is_there = False
        self._children: dict[Process, _Child] = {}

    def run(self) -> Dismiss:
        """Takes part in one run and returns how it ended; leaves no process behind."""
        name = str(self._document.values.get("name"))
        self._say(f"calls the head of {name} at {self._layout.endpoint}")
        # Until the session is there, Python cannot handle signals; they end this process by themselves.
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, signal.SIG_DFL)
        own = Process(self._host, 0, self._session)
        endpoint = private(self._layout.endpoint)
        self._bus = Bus(control(name), endpoint, network=self._network, process=own)
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, lambda number, _: self._hear(Dismiss(128 + number, "interrupted")))
        self._descendants = Descendants()
        try:
            return self._take_part()
        finally:
            self._end_all()
            self._bus.close()

    def _on_order(self, packet: Packet) -> None:
        try:
            self._hear(msgspec.json.decode(packet.payload, type=Order))
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            self._say(f"an order is refused: {error}")

    def _hear(self, order: Order) -> None:
        """Takes an order, from any thread."""
        self._dismissed |= isinstance(order, Dismiss)
        if isinstance(order, Signal) and order.signum == signal.SIGKILL:
            self._killed.add(order.process)
        self._events.put(order)

    def _take_part(self) -> Dismiss:
        """Raises Refused with the head's reason where it does not take this host in."""
        path = f"order/{self._host}/{self._session}"
        self._bus.subscribe(path, self._on_order)
        self._bus.watch(self._on_presence)
        self._bus.announce()
        while not self._head_is_there:
            with contextlib.suppress(queue.Empty):
                event = self._events.get(timeout=TICK_SECONDS)
                if isinstance(event, Dismiss):
                    return event
        hello = introduce(self._document, self._host, self._session)
        run = _plain(self._bus.ask("join", msgspec.json.encode(hello), ASK_SECONDS).decode())
        self._say(f"takes part in run {run}")
        self._folder = (self._recordings / run).absolute()
        try:
            (self._folder / "log").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Refused(f"{self._folder}: {error.strerror}") from None
        return self._serve()

    def _on_presence(self, process: Process, present: bool) -> None:
        if process.stage == self._network.head:
            if self._head_is_there and not present:
                self._hear(Dismiss(GONE, f"the connection to {process.stage} is gone; start this host again"))
            self._head_is_there = present

    # ------------------------------------------------------------------------------------------ processes

    def _serve(self) -> Dismiss:
        """Does what the head says until it says that it is over, or is not heard any more."""
        while True:
            self._reap()
            with contextlib.suppress(queue.Empty):
                match self._events.get(timeout=TICK_SECONDS):
                    case Start(process) as order:
                        try:
                            self._start(order)
                        except Interrupted:
                            self._report(Ended(process, -signal.SIGKILL, ""))
                        except OSError as error:
                            self._report(Ended(process, EXIT_FAILED, f"it cannot be started: {error}\n"))
                    case Signal() as order:
                        self._signal(order)
                    case end:
                        return end

    def _start(self, order: Start) -> None:
        """Raises OSError where it cannot be started and Interrupted where nobody wants it any more."""
        process = order.process
        _plain(process.stage)
        task = msgspec.structs.replace(
            order.task,
            directory=str(self._folder),
            network=self._network,
            gateway="",
            past=self._copy_past(process.stage) if order.task.past else "",
        )
        log = self._folder / "log" / f"{process.stage}-{process.replica}.txt"
        log_from = log.stat().st_size if log.exists() else 0
        name, mark = f"{process.stage}.{process.replica}", self._descendants.mark(process.path)
        module, data = "runner.process.stage_process", msgspec.json.encode(task)

        def stopping() -> bool:
            return self._dismissed or process in self._killed

        handle = self._forks.start(module, name, task=data, log=log, mark=mark, stopping=stopping)
        self._children[process] = _Child(handle, log, log_from)
        self._say(f"starts {name}")
        self._report(Started(process, handle.pid))

    def _copy_past(self, stage: str) -> str:
        """Copies the recording here from which a stage gets its state back."""
        path = self._folder / f"{stage}-past.mcap"
        with path.open("wb") as file:
            while file.write(self._bus.ask("past", str(file.tell()).encode(), ASK_SECONDS)) == PIECE_BYTES:
                pass
        return str(path)

    def _signal(self, order: Signal) -> None:
        if (child := self._children.get(order.process)) is not None:
            signal_it = child.handle.signal_group if order.group else child.handle.send_signal
            signal_it(order.signum)

    def _reap(self) -> None:
        """Reports what has ended, with the last that it printed; nothing is left of what it had started."""
        for process, child in list(self._children.items()):
            if (code := child.handle.poll()) is not None:
                del self._children[process]
                if left := self._descendants.end(process.path):
                    self._say(f"{process.stage}.{process.replica} {behind(left)}")
                lines = last_lines(child.log, TAIL_LINES, child.log_from)
                self._report(Ended(process, code, "".join(f"{line}\n" for line in lines)))

    def _report(self, report: Report) -> None:
        self._bus.publish(f"report/{self._host}/{self._session}", msgspec.json.encode(report))

    def _end_all(self) -> None:
        """Asks what is left to end, then kills it."""
        for child in self._children.values():
            child.handle.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + DEVICE_GRACE_SECONDS
        for child in self._children.values():
            end_process(child.handle, max(0.0, deadline - time.monotonic()))
        self._forks.close()
        if left := self._descendants.close():
            self._say(f"the stages {behind(left)}")

    def _say(self, text: str) -> None:
        self._terminal.show(self._host, text)


def _plain(name: str) -> str:
    """A name that the head has sent and that becomes part of a path here; raises Refused where it leads elsewhere."""
    if not re.fullmatch(r"[\w-]+", name):
        raise Refused(f"the head names {name!r}; valid: letters, digits, _ and -")
    return name
