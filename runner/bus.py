"""The transport: a Zenoh session on loopback, its keys, and who is present.

=========================================  ====================================================================
``RUN/m/STAGE/PORT``                       every message once (Envelope): for recorder and views
``RUN/d/STAGE/REPLICA/PORT``               the same bytes, delivered to one consumer's input port
``RUN/s/STAGE``                            a step that was done (Step), for the recorder
``RUN/j/STAGE``                            journal: the recorder's echo of it; what it consumed is done with
``RUN/gone/STAGE/REPLICA/INCARNATION``     the recorder's word that it has all that a dead process has sent
``RUN/r/STAGE``                            what has arrived at a consumer (Receipt)
``RUN/l/STAGE``                            log lines (LogLine)
``RUN/present/STAGE/REPLICA/INCARNATION``  liveliness token, declared after the process' subscribers
``RUN/flush``                              query answered by the recorder once it has everything sent before
=========================================  ====================================================================

Links keep their order, so that a step that the recorder has is there with everything it emitted. A process that is
killed may have reached some peers and not others: what the recorder has is what counts, for everybody.

A message may be published on its ``m`` key twice, with equal bytes, when its publisher crashed before the step
was journalled or its part was handed to another replica: readers tell by the id.
"""

from __future__ import annotations

import json
import os
import queue
import socket
import struct
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

import zenoh
from zenoh.handlers import Callback

A = TypeVar("A")

BLOCK_FOR_US = 600_000_000
"""How long a full link blocks its sender before Zenoh gives the link up; the default of 5 s loses messages."""
FLUSH_SECONDS = 1.0
RECORDER = "recorder"


@dataclass(frozen=True, slots=True, order=True)
class Process:
    """One process of the graph; each restart is another incarnation."""

    stage: str
    replica: int
    incarnation: int = 0

    @staticmethod
    def of(key: str) -> Process:
        """The process that a key ends with."""
        stage, replica, incarnation = key.split("/")[-3:]
        return Process(stage, int(replica), int(incarnation))

    @property
    def path(self) -> str:
        """The end of its keys."""
        return f"{self.stage}/{self.replica}/{self.incarnation}"


@dataclass(frozen=True, slots=True)
class Packet:
    """What arrived on a key."""

    key: str
    payload: bytes
    sent_ns: int
    """Monotonic clock of this machine when it was sent; 0 where the sender did not say."""
    arrived_ns: int


class Bus:
    """One process' connection to the others of its run.

    All callbacks run on one thread, in the order in which their causes arrived: Zenoh's own would run each
    subscription on a thread of its own, and a step could overtake what it emitted.
    """

    def __init__(self, run: str, *, listen: str = "tcp/127.0.0.1:0", connect: str | None = None):
        self._run = run
        self._session = zenoh.open(_config(listen, connect))
        self._declared: list[zenoh.Subscriber[None] | zenoh.LivelinessToken | zenoh.Queryable[None]] = []
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._calls: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._caller = threading.Thread(target=self._call_all, name="bus", daemon=True)
        self._caller.start()

    def publish(self, path: str, payload: bytes) -> None:
        """Sends without loss: a full link blocks. ``path`` is the key without the run."""
        publisher = self._publishers.get(path)
        if publisher is None:
            publisher = self._session.declare_publisher(
                f"{self._run}/{path}",
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
            )
            self._publishers[path] = publisher
        publisher.put(payload, attachment=struct.pack("<q", time.monotonic_ns()))

    def subscribe(self, path: str, callback: Callable[[Packet], None]) -> None:
        """Calls back for everything sent to ``path`` (``*`` and ``**`` allowed)."""

        def receive(sample: zenoh.Sample, arrived_ns: int) -> None:
            key = str(sample.key_expr).removeprefix(f"{self._run}/")
            callback(Packet(key, sample.payload.to_bytes(), _sent_ns(sample), arrived_ns))

        self._declared.append(self._session.declare_subscriber(f"{self._run}/{path}", self._in_turn(receive)))

    def announce(self, process: Process) -> None:
        """Declares this process present, until it closes or dies."""
        self._declared.append(self._session.liveliness().declare_token(f"{self._run}/present/{process.path}"))

    def watch(self, callback: Callable[[Process, bool], None]) -> None:
        """Calls back for every process that is or becomes present (True) and that goes (False)."""

        def receive(sample: zenoh.Sample, _: int) -> None:
            callback(Process.of(str(sample.key_expr)), sample.kind == zenoh.SampleKind.PUT)

        subscriber = self._session.liveliness().declare_subscriber(
            f"{self._run}/present/*/*/*", self._in_turn(receive), history=True
        )
        self._declared.append(subscriber)

    def answer_flush(self) -> None:
        """Lets the others wait for the recorder: its answer follows everything they sent to it."""
        key = f"{self._run}/flush"

        def answer(query: zenoh.Query, _: int) -> None:
            with query:
                query.reply(key, b"")

        self._declared.append(self._session.declare_queryable(key, self._in_turn(answer)))

    def flush(self) -> bool:
        """Waits until the recorder has received everything sent before; False where it does not answer in time."""
        replies = self._session.get(f"{self._run}/flush", timeout=FLUSH_SECONDS)
        return any(reply.ok is not None for reply in replies)

    def close(self) -> None:
        """Withdraws everything declared and closes the session."""
        for declared in reversed(self._declared):
            declared.undeclare()
        self._calls.put(None)
        if threading.current_thread() is not self._caller:
            self._caller.join(FLUSH_SECONDS)
        self._session.close()

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
                call()
        except Exception:
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(1)


class Presence:
    """Which processes are there, for the ready barrier."""

    def __init__(self):
        self._present: set[tuple[str, int]] = set()
        self._changed = threading.Condition()

    def update(self, process: Process, present: bool) -> None:
        """Takes note of a process that came or went."""
        with self._changed:
            change = self._present.add if present else self._present.discard
            change((process.stage, process.replica))
            self._changed.notify_all()

    def wait_for(self, expected: Iterable[tuple[str, int]], until: Callable[[], bool]) -> bool:
        """Blocks until all are present; False when ``until`` became true first."""
        wanted = set(expected)
        with self._changed:
            while not wanted <= self._present:
                if until():
                    return False
                self._changed.wait(0.1)
        return True


def free_endpoint() -> str:
    """A loopback endpoint that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _config(listen: str, connect: str | None) -> zenoh.Config:
    settings = {
        "mode": "peer",
        "listen/endpoints": [listen],
        "connect/endpoints": [connect] if connect else [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": BLOCK_FOR_US,
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _sent_ns(sample: zenoh.Sample) -> int:
    data = sample.attachment.to_bytes() if sample.attachment is not None else b""
    return struct.unpack("<q", data)[0] if len(data) == 8 else 0
