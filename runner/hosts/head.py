"""The head's side of a graph on several machines: who has joined, what they run, and who is cut off.

Head and hosts talk below ``hosts/GRAPH/`` beside the run, whose id a host learns when it joins:

==========================  ======================================================================================
``q/join``                  a host's question (:class:`Hello`), answered with the run's id or the reason why not
``q/past``                  the recording so far, from an offset on: what a stateful stage lived before a restart
``order/HOST/SESSION``      what the host is to do (:data:`Order`); only the head may publish here
``report/HOST/SESSION``     what has come of it (:data:`Report`)
``present/HOST/0/SESSION``  liveliness of the host, of the head too; a host without it is cut off
==========================  ======================================================================================
"""

from __future__ import annotations

import contextlib
import math
import secrets
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import msgspec

from runner.contract import Level, Refused
from runner.graph.document import Document, read_document, suggest
from runner.graph.graph import NUMERICAL
from runner.graph.placement import Layout, Network
from runner.inspect.compare import SHOWN, clipped
from runner.message.packet import Packet, Process
from runner.process.children import Handle
from runner.process.stage_process import Assignment
from runner.recording import provenance
from runner.terminal import listed
from runner.transport.bus import Bus
from runner.transport.session import open_session, private

ABSENT_SECONDS = 60.0
"""How long a host that is cut off may stay away while a stage has no other process."""
REMIND_SECONDS = 30.0
JOIN_SECONDS = 5.0
LEAVE_SECONDS = 3.0
ANSWER_SECONDS = 10.0
"""What a host may take to say that a process has gone that it was told to kill."""
CUT_OFF = 1
"""Stands for the exit code of a process that nobody hears of any more."""
PIECE_BYTES = 4 * 2**20
"""Of a recording that a host reads, at a time."""
_MISSING = "nothing"


class Hello(msgspec.Struct, frozen=True):
    """What a host says of itself to take part."""

    host: str
    session: int
    """Another one each time it is started."""
    graph: str
    """JSON of its graph file, as it is written."""
    folder: str
    """Where that file lies."""
    cwd: str
    fingerprint: str
    source: str
    """Of the runner and of the stages."""


class Start(msgspec.Struct, frozen=True, tag=True):
    """A process to start."""

    process: Process
    task: Assignment


class Signal(msgspec.Struct, frozen=True, tag=True):
    """A signal to a process, or to it and all that it has started."""

    process: Process
    signum: int
    group: bool


class Dismiss(msgspec.Struct, frozen=True, tag=True):
    """The end: all processes are ended, and the host with them."""

    code: int
    reason: str


class Started(msgspec.Struct, frozen=True, tag=True):
    """A process is there."""

    process: Process
    pid: int


class Ended(msgspec.Struct, frozen=True, tag=True):
    """A process has gone."""

    process: Process
    code: int
    output: str
    """The last that it printed."""


Order = Start | Signal | Dismiss
Report = Started | Ended


def control(graph: str) -> str:
    """Below which head and hosts of a graph talk."""
    return f"hosts/{graph}"


class RemoteChild(Handle):
    """A process on another host, as the supervisor sees it: like the :class:`subprocess.Popen` of one that is here."""

    def __init__(self, process: Process, log: Path, send: Callable[[Order], None], give_up: Callable[[], None]):
        """``give_up`` is called where its host does not say that it has gone after it was killed; it ends it."""
        self.process = process
        self.pid = 0
        """On its own host; 0 until it is there."""
        self.returncode: int | None = None
        self._log = log
        self._send = send
        self._give_up = give_up
        self._gone_by = math.inf
        """When its host must have said that it has gone, monotonic seconds."""
        log.touch()

    def poll(self) -> int | None:
        """See :class:`Handle`."""
        if self.returncode is None and time.monotonic() > self._gone_by:
            self._give_up()
        return self.returncode

    def send_signal(self, signum: int, *, group: bool = False) -> None:
        """Signals this process alone, or with ``group`` everything it has started too."""
        if signum == signal.SIGKILL:
            self._gone_by = min(self._gone_by, time.monotonic() + ANSWER_SECONDS)
        self._send(Signal(self.process, signum, group))

    def signal_group(self, signum: int) -> None:
        """Signals it and everything it has started."""
        self.send_signal(signum, group=True)

    def end(self, code: int, output: str) -> None:
        """Takes note that it has gone; its last words are kept where those of other processes are, if there is room."""
        self.returncode = code
        with contextlib.suppress(OSError), self._log.open("a") as log:
            log.write(output)


@dataclass(slots=True)
class _Place:
    """One host as the head sees it."""

    name: str
    hello: Hello | None = None
    """Of the session that takes part now."""
    lost_at: float | None = None
    children: dict[Process, RemoteChild] = field(default_factory=dict[Process, RemoteChild])
    waiting: dict[Process, Start] = field(default_factory=dict[Process, Start])
    """What it is to start once it is there."""


class Hosts:
    """The other machines of a run. Its methods may be called from any thread."""

    def __init__(self, name: str, file: Path, layout: Layout, say: Callable[[str, Level], None]):
        """Opens the place where all meet; ``name`` and ``file`` are the graph's. Raises Refused where it is taken."""
        self.network = network = network_of(layout, layout.head.name)
        self.endpoint = private(layout.endpoint)
        self._document = read_document(file)
        self._say = say
        self._run = ""
        self._places = {host: _Place(host) for host in layout.names[1:]}
        self._present: set[Process] = set()
        self._changed = threading.Condition(threading.RLock())
        self._remind_at = time.monotonic()
        self._router = open_session([self.endpoint], [], network, mode="router") if layout.router_is_head else None
        """Forwards between the sessions of a routed network, which do not link to each other."""
        own = Process(network.head, 0, secrets.randbits(24))
        self._bus = Bus(control(name), self.endpoint, network=network, process=own, listen=not network.routed)

    def open(self, run: str, recording: Path) -> None:
        """Lets hosts join a run, and read what has been recorded of it."""
        self._run = run
        self._bus.serve("past", lambda offset: _read(recording, int(offset)))
        self._bus.subscribe("report/*/*", self._on_report)
        self._bus.watch(self._on_presence)
        self._bus.serve("join", lambda text: self._join(msgspec.json.decode(text, type=Hello)).encode())
        self._bus.announce()

    def start(self, host: str, process: Process, task: Assignment, log: Path) -> RemoteChild:
        """Has a process started, as soon as its host is there."""
        place = self._places[host]
        child = RemoteChild(process, log, partial(self._order, place), partial(self._expel, place))
        with self._changed:
            place.children[process] = child
            self._order(place, Start(process, task))
        return child

    def waits(self, process: Process) -> bool:
        """Whether a process has not been started yet, because its host is not there."""
        return any(process in place.waiting for place in self._places.values())

    def remind(self) -> None:
        """Says from time to time which hosts are still waited for."""
        missing = [place.name for place in self._places.values() if place.hello is None and place.waiting]
        if missing and time.monotonic() > self._remind_at:
            self._remind_at = time.monotonic() + REMIND_SECONDS
            for name in missing:
                self._say(f"waiting for host {name}: runner up {self._document.label} --host {name}", "info")

    def overdue(self, host_of: Mapping[str, set[str]]) -> str | None:
        """Why the graph cannot go on without a host that stays away; ``host_of`` has the hosts of each stage."""
        for place in self._places.values():
            if place.lost_at is None or time.monotonic() < place.lost_at + ABSENT_SECONDS:
                continue
            away = {other.name for other in self._places.values() if other.hello is None}
            stranded = [stage for stage, hosts in host_of.items() if place.name in hosts and hosts <= away]
            if stranded:
                stages = ", ".join(stranded)
                return f"host {place.name} has been cut off for {ABSENT_SECONDS:g} s, and {stages} runs nowhere else"
        return None

    def close(self, code: int, reason: str) -> None:
        """Sends every host home and closes the place where all meet."""
        with self._changed:
            for place in self._places.values():
                self._order(place, Dismiss(code, reason))
                place.hello = None
            self._changed.wait_for(lambda: not self._present, LEAVE_SECONDS)
        self._bus.close()
        if self._router is not None:
            self._router.close()

    # ------------------------------------------------------------------------------------------ what is heard

    def _join(self, hello: Hello) -> str:
        """Takes a host in and returns the run's id, or raises Refused with the reason."""
        place = self._places.get(hello.host)
        if place is None:
            raise Refused(f"host {hello.host!r}: the head starts that itself{suggest(hello.host, self._places)}")
        own = introduce(self._document, self.network.host, 0)
        _refuse_other_graph(own, hello)
        process = Process(hello.host, 0, hello.session)
        with self._changed:
            if not self._changed.wait_for(lambda: process in self._present, JOIN_SECONDS):
                raise Refused(f"host {hello.host} was not seen for {JOIN_SECONDS:g} s; start it again")
            if place.hello is not None:
                raise Refused(f"host {hello.host} takes part already; valid: one `runner up` a host")
            back = place.lost_at is not None
            place.hello, place.lost_at = hello, None
            for start in place.waiting.values():
                self._order(place, start)
            place.waiting.clear()
        self._say(f"host {hello.host} is {'back' if back else 'there'}", "info")
        if hello.source != own.source:
            self._say(f"host {hello.host} has {hello.source}, the head {own.source}", "warning")
        if hello.fingerprint != own.fingerprint:
            floats = "floats may differ in their last bits"
            self._say(f"host {hello.host} has another processor or other libraries: {floats}", "warning")
        return self._run

    def _on_presence(self, process: Process, present: bool) -> None:
        place = self._places.get(process.stage)
        if place is None:
            return
        with self._changed:
            (self._present.add if present else self._present.discard)(process)
            self._changed.notify_all()
            if not present and place.hello is not None and place.hello.session == process.incarnation:
                self._lose(place)

    def _on_report(self, packet: Packet) -> None:
        _, host, session = packet.key.split("/")
        place = self._places.get(host)
        with self._changed:
            if place is None or place.hello is None or str(place.hello.session) != session:
                return
            try:
                report: Report = msgspec.json.decode(packet.payload, type=Report)
            except (msgspec.MsgspecError, UnicodeDecodeError) as error:
                self._say(f"a report of host {host} is refused: {error}", "warning")
                return
            match report:
                case Started(process, pid) if process in place.children:
                    place.children[process].pid = pid
                case Ended(process, code, output) if process in place.children:
                    place.children.pop(process).end(code, output)
                case _:
                    pass

    def _lose(self, place: _Place) -> None:
        """Counts everything on a host as gone; what cannot be started elsewhere is started when it is back."""
        place.hello, place.lost_at = None, time.monotonic()
        children, place.children = place.children, {}
        self._say(f"host {place.name} is cut off, with {len(children)} processes", "warning")
        for child in children.values():
            child.end(CUT_OFF, f"host {place.name} is cut off\n")

    def _expel(self, place: _Place) -> None:
        """Counts a host as gone that has a link and does not answer, and should it go on, has it end."""
        reason = f"the head was not answered for {ANSWER_SECONDS:g} s; start this host again"
        with self._changed:
            self._order(place, Dismiss(CUT_OFF, reason))
            self._lose(place)

    # ------------------------------------------------------------------------------------------ what is said

    def _order(self, place: _Place, order: Order) -> None:
        """Sends an order; one to start a process waits for its host, and is withdrawn by a signal."""
        with self._changed:
            if place.hello is not None:
                if isinstance(order, Start):
                    order = Start(order.process, self._moved(order.task, place.hello))
                self._bus.publish(f"order/{place.name}/{place.hello.session}", msgspec.json.encode(order))
            elif isinstance(order, Start):
                place.waiting[order.process] = order
            elif isinstance(order, Signal) and order.process in place.children:
                place.waiting.pop(order.process, None)
                place.children.pop(order.process).end(0, "")

    def _moved(self, task: Assignment, hello: Hello) -> Assignment:
        """Paths below the folders of the head become paths below those of the host."""
        folders = {str(self._document.folder): hello.folder, str(Path.cwd()): hello.cwd}
        return msgspec.structs.replace(task, entry=provenance.portable(task.entry, folders))


def introduce(document: Document, host: str, session: int) -> Hello:
    """What a host says of itself: of its graph file without the changes of the command line."""
    written = read_document(Path(document.label)).values
    named = document.values.get("numerical")
    names = map(str, cast("list[Any]", named)) if isinstance(named, list) else NUMERICAL
    revision = provenance.revision(document.values)
    return Hello(
        host=host,
        session=session,
        graph=msgspec.json.encode(written, enc_hook=str).decode(),
        folder=str(document.folder),
        cwd=str(Path.cwd()),
        fingerprint=provenance.fingerprint(provenance.machine(), provenance.package_versions(), names),
        source=f"runner {provenance.runner_version()}, stages {revision or 'of unknown revision'}",
    )


def _refuse_other_graph(own: Hello, hello: Hello) -> None:
    """All hosts must mean the same graph; settings are the head's alone and reach them with their tasks."""
    found = list(differences(msgspec.json.decode(own.graph), msgspec.json.decode(hello.graph)))
    if found:
        shown = listed([f"{key}: {there} at {hello.host}, {here} at the head" for key, here, there in found], "; ")
        raise Refused(f"host {hello.host} has another graph: {shown}; copy the head's file to it")


def differences(own: Any, theirs: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """(key, own value, their value) of everything that differs between two trees."""
    if isinstance(own, dict) and isinstance(theirs, dict):
        mine, other = cast("dict[str, Any]", own), cast("dict[str, Any]", theirs)
        for name in {**mine, **other}:
            inner = f"{key}.{name}" if key else name
            yield from differences(mine.get(name, _MISSING), other.get(name, _MISSING), inner)
    elif own != theirs:
        yield key, _short(own), _short(theirs)


def _read(file: Path, offset: int) -> bytes:
    with file.open("rb") as opened:
        opened.seek(offset)
        return opened.read(PIECE_BYTES)


def _short(value: Any) -> str:
    return clipped(value if value is _MISSING else repr(value), SHOWN)


def network_of(layout: Layout, host: str) -> Network:
    """What the sessions of one host are told; raises Refused where its credentials do not hold."""
    if layout.keys is None:
        return layout.network(host, None)
    from runner.hosts.keys import credentials  # cryptography takes longer to load than the rest of this package

    return layout.network(host, credentials(layout.keys, host))
