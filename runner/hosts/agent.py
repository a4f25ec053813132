"""One host of a graph that is not its head: starts and ends processes as the head says, and ends with its connection.

Whatever cuts it off from the head, its processes do not outlive that: they have been replaced meanwhile.
"""

from __future__ import annotations

import contextlib
import queue
import secrets
import signal
import subprocess
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
    Hello,
    Order,
    Report,
    Signal,
    Start,
    Started,
    Welcome,
    as_written,
    control,
    network_of,
    source_of,
    this_machine,
)
from runner.message.packet import Packet, Process
from runner.process.children import Family, Handle, behind, last_lines
from runner.process.fork_server import ForkServer
from runner.terminal import Terminal
from runner.transport.bus import Bus
from runner.transport.session import private

ASK_SECONDS = 15.0
GRACE_SECONDS = 2.0
TICK_SECONDS = 0.05
TAIL_LINES = 40
GONE = 1
"""Exit status where the head has gone or cannot be reached."""


@dataclass(slots=True)
class _Child:
    handle: Handle
    log: Path


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
        bus = Bus(control(name), private(self._layout.endpoint), network=self._network, process=own)
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, lambda number, _: self._events.put(Dismiss(128 + number, "interrupted")))
        self._family = Family()
        try:
            return self._take_part(bus)
        finally:
            self._end_all()
            bus.close()

    def _take_part(self, bus: Bus) -> Dismiss:
        bus.subscribe(f"order/{self._host}/{self._session}", self._on_order)
        bus.watch(self._on_presence)
        bus.announce()
        while not self._head_is_there:
            with contextlib.suppress(queue.Empty):
                event = self._events.get(timeout=TICK_SECONDS)
                if isinstance(event, Dismiss):
                    return event
        folder = self._recordings / self._join(bus).run
        (folder / "log").mkdir(parents=True, exist_ok=True)
        return self._serve(bus, folder)

    def _join(self, bus: Bus) -> Welcome:
        """Raises Refused with the head's reason where it does not take this host in."""
        hello = Hello(
            host=self._host,
            session=self._session,
            graph=as_written(self._document),
            folder=str(self._document.folder),
            cwd=str(Path.cwd()),
            fingerprint=this_machine(self._document),
            source=source_of(self._document),
        )
        answer = bus.ask("join", msgspec.json.encode(hello), ASK_SECONDS)
        welcome = msgspec.json.decode(answer, type=Welcome)
        self._say(f"takes part in run {welcome.run}")
        return welcome

    def _on_order(self, packet: Packet) -> None:
        self._events.put(msgspec.json.decode(packet.payload, type=Order))

    def _on_presence(self, process: Process, present: bool) -> None:
        if process.stage == self._network.head:
            if self._head_is_there and not present:
                self._events.put(Dismiss(GONE, f"the connection to {process.stage} is gone; start this host again"))
            self._head_is_there = present

    # ------------------------------------------------------------------------------------------ processes

    def _serve(self, bus: Bus, folder: Path) -> Dismiss:
        """Does what the head says until it says that it is over, or is not heard any more."""
        while True:
            for report in self._reap():
                bus.publish(f"report/{self._host}/{self._session}", msgspec.json.encode(report))
            with contextlib.suppress(queue.Empty):
                match self._events.get(timeout=TICK_SECONDS):
                    case Start() as order:
                        report = self._start(self._with_past(bus, order, folder), folder)
                        bus.publish(f"report/{self._host}/{self._session}", msgspec.json.encode(report))
                    case Signal() as order:
                        self._signal(order)
                    case end:
                        return end

    def _with_past(self, bus: Bus, order: Start, folder: Path) -> Start:
        """Copies the recording here from which a stage gets its state back."""
        if not order.task.past:
            return order
        path = (folder / f"{order.process.stage}-past.mcap").absolute()
        with path.open("wb") as file:
            while file.write(bus.ask("past", str(file.tell()).encode(), ASK_SECONDS)) == PIECE_BYTES:
                pass
        return msgspec.structs.replace(order, task=msgspec.structs.replace(order.task, past=str(path)))

    def _start(self, order: Start, folder: Path) -> Report:
        process = order.process
        own = {"directory": str(folder.absolute()), "network": self._network, "gateway": ""}
        task = msgspec.structs.replace(order.task, **own)
        log = folder / "log" / f"{process.stage}-{process.replica}.txt"
        name, mark = f"{process.stage}.{process.replica}", self._family.mark(process.path)
        module, data = "runner.process.stage_process", msgspec.json.encode(task)
        handle = self._forks.start(module, name, task=data, log=log, mark=mark)
        self._children[process] = _Child(handle, log)
        self._say(f"starts {name}")
        return Started(process, handle.pid)

    def _signal(self, order: Signal) -> None:
        child = self._children.get(order.process)
        if child is None:
            return
        if order.group:
            child.handle.signal_group(order.signum)
        else:
            child.handle.send_signal(order.signum)

    def _reap(self) -> list[Report]:
        """What has ended since, each with the last that it printed, and nothing left of what it had started."""
        ended = [(process, child) for process, child in self._children.items() if child.handle.poll() is not None]
        for process, _ in ended:
            del self._children[process]
            if left := self._family.end(process.path):
                self._say(f"{process.stage}.{process.replica} {behind(left)}")
        return [
            Ended(process, child.handle.wait(), "".join(f"{line}\n" for line in last_lines(child.log, TAIL_LINES)))
            for process, child in ended
        ]

    def _end_all(self) -> None:
        """Asks what is left to end, then kills it."""
        for child in self._children.values():
            child.handle.signal_group(signal.SIGTERM)
        for child in self._children.values():
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.handle.wait(GRACE_SECONDS)
            child.handle.signal_group(signal.SIGKILL)
            child.handle.wait()
        self._forks.close()
        if left := self._family.close():
            self._say(f"the stages {behind(left)}")

    def _say(self, text: str) -> None:
        self._terminal.show(self._host, text)


def refuse_settings(settings: tuple[str, ...], host: str) -> None:
    """Settings come from the head with each task; only how to reach it is a host's own. Raises Refused for others."""
    for setting in settings:
        key = setting.partition("=")[0]
        if not (key.startswith("hosts.") or key in ("keys", "router")):
            raise Refused(
                f"--set {setting}: settings are the head's, which gives them to {host} with its tasks; type it there"
            )
