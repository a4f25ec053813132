"""One process' way to the others of its run: what it publishes, hears, asks and answers, and who is present.

The keys are listed in docs/runner/keys.md. Links keep their order: who has a step has what it emitted.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import queue
import struct
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zenoh
from zenoh.handlers import Callback, FifoChannel

from runner.contract import Level, Refused
from runner.graph.placement import Network
from runner.message.codec import LogLine, pack
from runner.message.packet import Packet, Process
from runner.transport.session import (
    CLOSE_SECONDS,
    close_dead_links_at_once,
    close_session,
    new_endpoint,
    open_session,
    private,
)
from runner.transport.vital import vital_thread

ASK_AGAIN_SECONDS = 0.05
"""A peer that has just been met has not heard of every queryable."""
CHANNEL = 4096
"""Messages that may wait to be taken; then their links wait."""
REFUSAL = zenoh.Encoding.TEXT_PLAIN
"""Of an error that was given as an answer; Zenoh's own, such as a time-out, have another."""
_SENT = struct.Struct("<qQ")
"""What accompanies a message: when it was sent, and by which clock."""


def _clock() -> int:
    """Names the monotonic clock of this machine: it starts anew with every boot."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    seed = boot.read_bytes() if boot.exists() else str(uuid.getnode()).encode()
    return int.from_bytes(hashlib.sha256(seed).digest()[:8], "little")


_CLOCK = _clock()


class Bus:
    """One process' connection to the others of its run.

    Callbacks run on one thread, in the order in which their causes arrived: Zenoh's own would run each subscription on
    a thread of its own, and a step could overtake what it emitted.
    """

    def __init__(
        self,
        run: str,
        endpoint: str,
        *,
        gateway: str = "",
        network: Network | None = None,
        process: Process | None = None,
        listen: bool = False,
        client: bool = False,
    ):
        """Calls at ``endpoint``, or with ``listen`` is the one who is called there, and at the run's ``gateway``.

        ``process`` is who this is. As a ``client`` it is called by nobody: a tool, which listens at a gateway. Raises
        Refused where this machine cannot listen as it is told, or nobody takes a client's call.
        """
        self._run = run
        self._process = process
        self._gateway = gateway if network is None else ""
        self._far = network is not None
        calls = [*([] if listen else [endpoint]), *filter(None, [self._gateway])]
        if client or (network is not None and network.routed):
            self._session = open_session([], calls, network, mode="client", calls_once=client)
        else:
            own = endpoint if listen else new_endpoint(endpoint) if network is None else private(network.listen)
            self._session = open_session([own], calls, network)
        self._listener: zenoh.Session | None = None
        self._declared: list[zenoh.Subscriber[Any] | zenoh.LivelinessToken | zenoh.Queryable[None]] = []
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._closed = threading.Event()
        self._calls: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._caller = vital_thread("bus", self._call_all)
        self._caller.start()

    def publish(self, path: str, payload: bytes | bytearray, *, may_be_dropped: bool = False) -> None:
        """Sends without loss: a full link blocks. ``path`` is the key without the run. Once closed it sends nothing."""
        if self._closed.is_set():
            return
        try:
            publisher = self._publishers.get(path) or self._declare_publisher(path, may_be_dropped)
            publisher.put(payload, attachment=_SENT.pack(time.monotonic_ns(), _CLOCK))
        except zenoh.ZError:
            if not self._closed.is_set():  # meanwhile
                raise
        os.sched_yield()  # Zenoh's thread that sends was often woken on this one's core

    def _declare_publisher(self, path: str, may_be_dropped: bool) -> zenoh.Publisher:
        control = zenoh.CongestionControl
        publisher = self._publishers[path] = self._session.declare_publisher(
            f"{self._run}/{path}",
            congestion_control=control.DROP if may_be_dropped else control.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
        )
        return publisher

    def log(self, text: str, level: Level) -> LogLine:
        """Sends a line of this process' log, which is shown and recorded, and returns it."""
        assert self._process is not None
        line = LogLine(*self._process.place, level, text, time.time_ns())
        self.publish(f"l/{self._process.stage}", pack(line))
        return line

    def subscribe(self, path: str, callback: Callable[[Packet], None]) -> None:
        """Calls back, in turn, for everything sent to ``path`` (``*`` and ``**`` allowed)."""
        self.hand_over(path, lambda packet: self._calls.put(lambda: callback(packet)))

    def hand_over(self, path: str, take: Callable[[Packet], None]) -> None:
        """Gives everything sent to ``path`` to ``take`` as it comes, on the link's own thread: it must not wait."""
        self._declare(self._session, path, self._taker(take))

    def overhear(self, path: str, take: Callable[[Packet], None]) -> None:
        """Does the same at the gateway, where there is one on this machine: what this process does not take in time is
        dropped, and nobody waits."""
        if self._listener is None and self._gateway:
            self._listener = open_session([], [self._gateway], None, mode="client")
        self._declare(self._listener or self._session, path, self._taker(take))

    def _taker(self, take: Callable[[Packet], None]) -> Callback[zenoh.Sample]:
        return Callback(lambda sample: None if _is_stray(sample) else take(self._packet(sample)), indirect=False)

    def channel(self, path: str) -> Callable[[], Iterator[Packet]]:
        """Takes all that has been sent to ``path`` by others, whenever it is called; when it came is not known.

        Cheaper than calls one by one.
        """
        subscriber = self._declare(self._session, path, FifoChannel(CHANNEL))

        def take() -> Iterator[Packet]:
            while (sample := subscriber.try_recv()) is not None:
                if not _is_stray(sample):
                    yield Packet(self._path(sample), sample.payload.to_bytes(), 0, 0)

        return take

    def _declare(self, session: zenoh.Session, path: str, handler: Any) -> zenoh.Subscriber[Any]:
        origin = zenoh.Locality.REMOTE  # who publishes knows it already
        found: Any = session.declare_subscriber(f"{self._run}/{path}", handler, allowed_origin=origin)
        self._declared.append(found)
        return found

    def _packet(self, sample: zenoh.Sample) -> Packet:
        arrived_ns = time.monotonic_ns()
        return Packet(self._path(sample), sample.payload.to_bytes(), _sent_ns(sample), arrived_ns)

    def _path(self, sample: zenoh.Sample) -> str:
        return str(sample.key_expr)[len(self._run) + 1 :]

    def announce(self) -> None:
        """Declares this process present, until it closes or dies."""
        assert self._process is not None
        key = f"{self._run}/present/{self._process.path}"
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch(
        self, callback: Callable[[Process, bool], None], refuse: Callable[[str, Exception], None] = lambda *_: None
    ) -> None:
        """Calls back for every process that is or becomes present (True) and that goes (False).

        A process that goes need not be dead: its host may be cut off. ``refuse`` is told of keys that name none.
        """

        def receive(sample: zenoh.Sample) -> None:
            key, present = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            try:
                process = Process.of(key)
            except Refused as refusal:
                refuse(key.removeprefix(f"{self._run}/"), refusal)
                return
            if self._far and present:
                close_dead_links_at_once()
            callback(process, present)

        def take_in_turn(sample: zenoh.Sample) -> None:
            self._calls.put(lambda: receive(sample))

        key, callback_in_turn = f"{self._run}/present/**", Callback(take_in_turn, indirect=False)
        self._declared.append(self._session.liveliness().declare_subscriber(key, callback_in_turn, history=True))

    def serve(self, name: str, answer: Callable[[bytes], bytes]) -> None:
        """Answers the questions called ``name``, each on a thread of its own: an answer may take its time.

        What ``answer`` raises becomes an error reply: the text of a Refused, of anything else its type too.
        """
        key = f"{self._run}/q/{name}"

        def receive(query: zenoh.Query) -> None:
            threading.Thread(target=_reply, args=(query, key, answer), name=name, daemon=True).start()

        self._declared.append(self._session.declare_queryable(key, Callback(receive, indirect=False)))

    def ask(self, name: str, question: bytes, timeout_s: float) -> bytes:
        """The answer of whoever serves ``name``; raises Refused with its reason, or where nobody answers in time."""
        deadline = time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0:
            for reply in self._session.get(f"{self._run}/q/{name}", payload=question, timeout=left):
                if reply.ok is not None and not _is_stray(reply.ok):
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
            self._caller.join(CLOSE_SECONDS)
        for session in filter(None, (self._listener, self._session)):
            close_session(session)

    def _call_all(self) -> None:
        while (call := self._calls.get()) is not None:
            call()


def _reply(query: zenoh.Query, key: str, answer: Callable[[bytes], bytes]) -> None:
    with query, contextlib.suppress(zenoh.ZError):  # the bus closes while somebody waits
        try:
            query.reply(key, answer(query.payload.to_bytes() if query.payload else b""))
        except Refused as refusal:
            query.reply_err(str(refusal), encoding=REFUSAL)
        except Exception as error:
            query.reply_err(f"{type(error).__name__}: {error}", encoding=REFUSAL)


def _is_stray(sample: zenoh.Sample) -> bool:
    """Whether it says that a key is to be deleted, or was sent to many keys at once, for which rules on who may speak
    do not hold: nobody here does either."""
    return sample.kind != zenoh.SampleKind.PUT or "*" in str(sample.key_expr)


def _sent_ns(sample: zenoh.Sample) -> int:
    """When it was sent, 0 where that is not known."""
    data = sample.attachment.to_bytes() if sample.attachment is not None else b""
    if len(data) != _SENT.size:
        return 0
    sent_ns, clock = _SENT.unpack(data)
    return sent_ns if clock == _CLOCK else 0
