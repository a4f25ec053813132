"""The transport: a Zenoh session on loopback, its keys, and who is present.

=========================================  ====================================================================
``RUN/m/STAGE/PORT``                       every message once (Envelope), for the recorder
``RUN/d/STAGE/REPLICA/PORT``               the same bytes, delivered to one consumer's input port
``RUN/s/STAGE``                            a step that was done (Step), for the recorder
``RUN/j/STAGE``                            journal: the recorder's echo of steps; what they consumed is done with
``RUN/a/STAGE/PORT``                       the recorder's echo of messages that the supervisor waits for
``RUN/gone/STAGE/REPLICA/INCARNATION``     the recorder's word that it has all that a dead process has sent
``RUN/r/STAGE``                            what has arrived at a consumer (Receipt)
``RUN/l/STAGE``                            log lines (LogLine)
``RUN/h/STAGE/REPLICA``                    a sign of life twice a second (Pulse); not recorded
``RUN/present/STAGE/REPLICA/INCARNATION``  liveliness token, declared after the process' subscribers; ends with /BADGE
``RUN/flush``                              query answered by the recorder once it has everything sent before
``RUN/q/NAME``                             question to the supervisor (status, down, restart, call), answered in JSON
=========================================  ====================================================================

What is for one process (``m``, ``d`` and ``s``) goes straight to it where it runs on the same machine, see
:mod:`runner.transport.links`, under the same key.

Links keep their order, so that a step that the recorder has is there with everything it emitted. A process that is
killed may have reached some peers and not others: what the recorder has is what counts, for everybody.

A message may be published on its ``m`` key twice, with equal bytes, when its publisher crashed before the step
was journalled or its part was handed to another replica: readers tell by the id.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import queue
import struct
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import zenoh
from zenoh.handlers import Callback

from runner.contract import Refused
from runner.graph.placement import Network
from runner.message.packet import Packet, Process, badge
from runner.transport.arena import Block, Store
from runner.transport.links import INLINE_BYTES, Door, Link, address_of
from runner.transport.session import close_dead_links_at_once, open_session

A = TypeVar("A")

REST_SECONDS = 0.001
"""How long callbacks wait for others to be called with."""
FLUSH_SECONDS = 1.0
ASK_AGAIN_SECONDS = 0.05
"""A peer that has just been met has not heard of every queryable."""
TEND_SECONDS = 0.05
"""How often links are looked after while their process is busy elsewhere."""
REFUSAL = zenoh.Encoding.TEXT_PLAIN
"""Of an error that was given as an answer; Zenoh's own, such as a time-out, have another."""


_SENT = struct.Struct("<qQ8s")
"""What accompanies a message: when it was sent, by which clock, and the sender's badge."""


def _clock() -> int:
    """Names the monotonic clock of this machine: it starts anew with every boot."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    seed = boot.read_bytes() if boot.exists() else str(uuid.getnode()).encode()
    return int.from_bytes(hashlib.sha256(seed).digest()[:8], "little")


_CLOCK = _clock()


class Bus:
    """One process' connection to the others of its run.

    All callbacks run on one thread, in the order in which their causes arrived: Zenoh's own would run each
    subscription on a thread of its own, and a step could overtake what it emitted.
    """

    def __init__(
        self,
        run: str,
        *,
        listen: str | None = None,
        connect: str | None = None,
        network: Network | None = None,
        secret: str = "",
        process: Process | None = None,
        guest: bool = False,
    ):
        """``connect`` is called first; without a ``network`` all of it stays on loopback.

        ``process`` is who this is; None for who only listens.

        What is published without the run's ``secret`` is refused by its processes. A ``guest`` speaks with the
        process it connects to and with nobody else: were it to stand still, no other would wait for it.

        Raises Refused where this machine cannot listen as it is told.
        """
        self._run = run
        self._secret = secret
        self._session = open_session(listen, connect, network, mode="client" if guest else None)
        self._declared: list[zenoh.Subscriber[None] | zenoh.LivelinessToken | zenoh.Queryable[None]] = []
        self._far = network is not None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._offered: dict[str, _Offer] = {}
        self._process = process
        self._host = network.host if network is not None else ""
        self._present: dict[tuple[str, int], Process] = {}
        """The newest process of each replica."""
        self._links: dict[tuple[str, int], Link | None] = {}
        """To those of them on this machine; None for the others."""
        self._retired: list[Link] = []
        """Of processes that are gone, as far as they may still read."""
        self._linking = threading.Lock()
        self._store = Store()
        self._door: Door | None = None
        self._closed = threading.Event()
        self._tender = threading.Thread(target=self._tend, name="links", daemon=True)
        if process is not None:
            self._tender.start()
        self._calls: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._caller = threading.Thread(target=self._call_all, name="bus", daemon=True)
        self._caller.start()

    def publish(self, path: str, payload: bytes) -> None:
        """Sends without loss: a full link blocks. ``path`` is the key without the run. Once closed it sends nothing."""
        if self._closed.is_set():
            return
        publisher = self._publishers.get(path)
        if publisher is None:
            publisher = self._publishers[path] = self._declare(path, zenoh.CongestionControl.BLOCK)
        publisher.put(payload, attachment=self._attachment(path))

    def load(self, parts: Sequence[bytes | memoryview]) -> bytes | Block:
        """The parts of a message as one payload: in memory that consumers can read where it is large."""
        if sum(map(len, parts)) > INLINE_BYTES:
            with contextlib.suppress(OSError):  # where there is none, Zenoh takes the message
                return self._store.write(parts)
        return b"".join(parts)

    def deliver(self, to: tuple[str, int], path: str, payload: bytes | Block) -> bool:
        """Sends to one process, (stage, replica), without loss, straight where it is on this machine.

        True where it is in that process' hands, or the kernel's, and arrives even if this process dies now.
        """
        link = self._links.get(to) or self._connect(to)
        if link is not None and link.send(path, payload):
            return True
        self.publish(path, bytes(payload.view) if isinstance(payload, Block) else payload)
        return False

    def _connect(self, to: tuple[str, int]) -> Link | None:
        """The link to a process that is present, made when it is first wanted; None where it is on another machine."""
        with self._linking:
            process = self._present.get(to)
            if self._process is None or process is None or to in self._links:
                return self._links.get(to)
            link = None
            with contextlib.suppress(OSError):
                address = address_of(self._run, self._secret, self._host, process)
                link = Link(address, self._secret, self._process.path, self._store)
            self._links[to] = link
            return link

    def open_door(self, receive: Callable[[Packet], None], refuse: Callable[[str, Exception], None]) -> Door:
        """Lets those on this machine deliver straight to this process, once it is announced.

        ``receive`` gets what they send from whoever looks: see :class:`runner.transport.links.Door`.
        """
        assert self._process is not None
        address = address_of(self._run, self._secret, self._host, self._process)
        self._door = Door(address, self._secret, receive, refuse)
        return self._door

    def _tend(self) -> None:
        while not self._closed.wait(TEND_SECONDS):
            if self._door is not None:
                self._door.tend()
            with self._linking:
                links = [*filter(None, self._links.values()), *self._retired]
            for link in links:
                if not link.collect() and link in self._retired:
                    self._retired.remove(link)
                    link.close()

    def _note(self, process: Process, present: bool) -> None:
        """Keeps to the newest process of a replica; the link to an older one lasts as long as that may read."""
        place = process.stage, process.replica
        with self._linking:
            newest = self._present.get(place)
            if present and (newest is None or process > newest):
                self._present[place] = process
            elif not present and process == newest:
                del self._present[place]
            else:
                return
            link = self._links.pop(place, None)
        self._retired += [link] if link is not None else []

    def offer(self, path: str, payload: bytes | memoryview) -> None:
        """Sends to whoever listens, and to nobody who would have to be waited for."""
        offered = self._offered.get(path)
        if offered is None:
            publisher = self._declare(path, zenoh.CongestionControl.DROP, zenoh.Priority.DATA_LOW)
            offered = self._offered[path] = _Offer(publisher)
        if offered.wanted:
            offered.publisher.put(bytes(payload), attachment=self._attachment(path))

    def _declare(
        self, path: str, congestion: zenoh.CongestionControl, priority: zenoh.Priority = zenoh.Priority.DATA
    ) -> zenoh.Publisher:
        reliable = zenoh.Reliability.RELIABLE
        return self._session.declare_publisher(
            f"{self._run}/{path}", congestion_control=congestion, priority=priority, reliability=reliable
        )

    def _attachment(self, path: str) -> bytes:
        return _SENT.pack(time.monotonic_ns(), _CLOCK, badge(self._secret, path))

    def subscribe(
        self, path: str, callback: Callable[[Packet], None], *, first: Callable[[Packet], None] | None = None
    ) -> None:
        """Calls back for everything sent to ``path`` (``*`` and ``**`` allowed).

        ``first`` is called before, on the link's own thread: it may only hand the packet on.
        """
        skipped = len(self._run) + 1

        def receive(sample: zenoh.Sample) -> None:
            arrived_ns = time.monotonic_ns()
            key, (sent_ns, shown) = str(sample.key_expr)[skipped:], _attached(sample)
            genuine = shown == badge(self._secret, key)
            packet = Packet(key, sample.payload.to_bytes(), sent_ns, arrived_ns, genuine)
            if first is not None:
                first(packet)
            self._calls.put(lambda: callback(packet))

        receiver = Callback(receive, indirect=False)
        self._declared.append(self._session.declare_subscriber(f"{self._run}/{path}", receiver))

    def announce(self) -> None:
        """Declares this process present, until it closes or dies."""
        assert self._process is not None
        self._declared.append(self._session.liveliness().declare_token(self._token(self._process)))

    def watch(
        self, callback: Callable[[Process, bool], None], refuse: Callable[[str, Exception], None] = lambda *_: None
    ) -> None:
        """Calls back for every process that is or becomes present (True) and that goes (False).

        ``refuse`` is told of keys that name none.
        """

        def receive(sample: zenoh.Sample, _: int) -> None:
            key = str(sample.key_expr)
            try:
                process = Process.of(key.rpartition("/")[0])
                if key != self._token(process):
                    raise Refused("no process of this run")
            except Refused as refusal:
                refuse(key.removeprefix(f"{self._run}/"), refusal)
            else:
                present = sample.kind == zenoh.SampleKind.PUT
                if self._far and present:
                    close_dead_links_at_once()
                self._note(process, present)
                callback(process, present)

        subscriber = self._session.liveliness().declare_subscriber(
            f"{self._run}/present/**", self._in_turn(receive), history=True
        )
        self._declared.append(subscriber)

    def _token(self, process: Process) -> str:
        path = f"present/{process.path}"
        return f"{self._run}/{path}/{badge(self._secret, path).hex()}"

    def answer_flush(self, afterwards: Callable[[Callable[[], None]], None]) -> None:
        """Lets the others wait for the recorder: its answer follows everything they sent to it.

        ``afterwards`` is given each answer, to be called once what has come straight is taken and echoed too.
        """
        key = f"{self._run}/flush"

        def answer(query: zenoh.Query) -> None:
            with query, contextlib.suppress(zenoh.ZError):  # the bus closes while somebody waits
                query.reply(key, badge(self._secret, "flush"))

        def receive(query: zenoh.Query, _: int) -> None:
            afterwards(lambda: answer(query))

        self._declared.append(self._session.declare_queryable(key, self._in_turn(receive)))

    def flush(self) -> bool:
        """Waits until the recorder has received everything sent before; False where it does not answer in time."""
        replies = self._session.get(f"{self._run}/flush", timeout=FLUSH_SECONDS)
        shown = badge(self._secret, "flush")
        return any(reply.ok is not None and reply.ok.payload.to_bytes() == shown for reply in replies)

    def serve(self, name: str, answer: Callable[[bytes], bytes]) -> None:
        """Answers the questions called ``name``, each on a thread of its own: an answer may take its time.

        Who does not know the run's secret is refused. What ``answer`` raises becomes an error reply: the text of a
        Refused, of anything else its type too.
        """
        key = f"{self._run}/q/{name}"

        shown = badge(self._secret, f"q/{name}")

        def receive(query: zenoh.Query) -> None:
            threading.Thread(target=_reply, args=(query, key, shown, answer), name=name, daemon=True).start()

        self._declared.append(self._session.declare_queryable(key, Callback(receive, indirect=False)))

    def ask(self, name: str, question: bytes, timeout_s: float) -> bytes:
        """The answer of whoever serves ``name``; raises Refused with its reason, or where nobody answers in time."""
        deadline, shown = time.monotonic() + timeout_s, badge(self._secret, f"q/{name}")
        while (left := deadline - time.monotonic()) > 0:
            key = f"{self._run}/q/{name}"
            for reply in self._session.get(key, payload=question, attachment=shown, timeout=left):
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
                if reply.err is not None and reply.err.encoding == REFUSAL:
                    raise Refused(reply.err.payload.to_string())
            time.sleep(ASK_AGAIN_SECONDS)
        raise Refused(f"{self._run}: no answer to {name!r} within {timeout_s:g} s")

    def close(self) -> None:
        """Withdraws everything declared and closes the session."""
        for declared in reversed(self._declared):
            declared.undeclare()
        self._closed.set()
        self._calls.put(None)
        if threading.current_thread() is not self._caller:
            self._caller.join(FLUSH_SECONDS)
        with contextlib.suppress(zenoh.ZError):  # who is cut off cannot say goodbye
            self._session.close()

        if self._process is not None:
            self._tender.join()
        if self._door is not None:
            self._door.close()
        for link in (*filter(None, self._links.values()), *self._retired):
            link.close()

    def _in_turn(self, receive: Callable[[A, int], None]) -> Callback[A]:
        """A handler that only queues, so that it may run on the link's own thread; it gets the time of arrival."""

        def enqueue(cause: A) -> None:
            arrived_ns = time.monotonic_ns()
            self._calls.put(lambda: receive(cause, arrived_ns))

        return Callback(enqueue, indirect=False)

    def _call_all(self) -> None:
        """What a callback raises ends the process, with the traceback: it cannot go on half deaf."""
        try:
            while (call := self._calls.get()) is not None:
                # What has come with it goes to a handler first: two threads at once would share the interpreter.
                time.sleep(REST_SECONDS)
                call()
                for _ in range(self._calls.qsize()):
                    if (call := self._calls.get()) is None:
                        return
                    call()
        except Exception:
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(1)


class _Offer:
    """A publisher that knows whether anybody listens."""

    def __init__(self, publisher: zenoh.Publisher):
        self.publisher = publisher
        self.wanted = False
        cast("Any", publisher).declare_matching_listener(Callback(self._note, indirect=False))
        self.wanted = self.wanted or cast("Any", publisher).matching_status.matching

    def _note(self, status: Any) -> None:
        self.wanted = status.matching


class Presence:
    """Which processes are there, for the ready barrier."""

    def __init__(self):
        self._present: set[Process] = set()
        self._changed = threading.Condition()

    def update(self, process: Process, present: bool) -> None:
        """Takes note of a process that came or went."""
        with self._changed:
            change = self._present.add if present else self._present.discard
            change(process)
            self._changed.notify_all()

    def wait_for(self, expected: Iterable[tuple[str, int]], until: Callable[[], bool]) -> bool:
        """Blocks until all are present; False when ``until`` became true first."""
        wanted = set(expected)
        with self._changed:
            while not wanted <= {(process.stage, process.replica) for process in self._present}:
                if until():
                    return False
                self._changed.wait(0.1)
        return True


def _reply(query: zenoh.Query, key: str, shown: bytes, answer: Callable[[bytes], bytes]) -> None:
    with query, contextlib.suppress(zenoh.ZError):  # the bus closes while somebody waits
        try:
            if query.attachment is None or query.attachment.to_bytes() != shown:
                raise Refused("only who knows the secret of this run may ask")
            query.reply(key, answer(query.payload.to_bytes() if query.payload else b""))
        except Refused as refusal:
            query.reply_err(str(refusal), encoding=REFUSAL)
        except Exception as error:
            query.reply_err(f"{type(error).__name__}: {error}", encoding=REFUSAL)


def _attached(sample: zenoh.Sample) -> tuple[int, bytes]:
    """When it was sent, 0 where that is not known, and the sender's badge."""
    data = sample.attachment.to_bytes() if sample.attachment is not None else b""
    if len(data) != _SENT.size:
        return 0, b""
    sent_ns, clock, badge = _SENT.unpack(data)
    return (sent_ns if clock == _CLOCK else 0), badge
