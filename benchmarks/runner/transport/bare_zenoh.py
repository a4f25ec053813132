"""Bare Zenoh as a user would write it, for `benchmarks.transport`: raw bytes and an explicit endpoint.

``python -m benchmarks.transport.bare_zenoh send SETTINGS`` sends to one that answers and to listeners that only take
what comes, as the runner's recorder does. The receiver subscribes first: Zenoh serves subscribers in that order.
"""

from __future__ import annotations

import contextlib
import json
import queue
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
import zenoh

from benchmarks.runner.transport.schedule import Schedule

RECEIVER, LISTENER = "receiver", "listener"


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What is sent, and how."""

    messages: int
    listeners: int = 1
    """Besides the receiver."""
    protocol: str = "tcp"
    shared_memory: bool = False
    """By default off as in the runner; Zenoh's own default is on."""


def session(listen: str | None, connect: str | None, *, shared_memory: bool) -> zenoh.Session:
    """A peer that looks for nobody else, on all other accounts with default settings."""
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([listen] if listen else []))
    config.insert_json5("connect/endpoints", json.dumps([connect] if connect else []))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", json.dumps(shared_memory))
    return zenoh.open(config)


def receive(role: str, endpoint: str, shared_memory: bool) -> None:
    """Takes each array until stdin closes; the receiver answers it with the time at which its callback had it."""
    peer = session(None, endpoint, shared_memory=shared_memory)
    answers = peer.declare_publisher("transport/arrived")

    def handle(sample: zenoh.Sample) -> None:
        array = np.frombuffer(sample.payload.to_bytes(), np.uint8)
        now = time.monotonic_ns()
        if role == RECEIVER:
            answers.put(struct.pack("<qq", now, len(array)))

    peer.declare_subscriber("transport/blob", handle)
    token = peer.liveliness().declare_token(f"transport/there/{peer.zid()}")
    sys.stdin.read()
    token.undeclare()
    peer.close()


def send(settings: Settings) -> None:
    """Prints the times of all sizes as JSON."""
    with tempfile.TemporaryDirectory() as folder:
        tcp = settings.protocol == "tcp"
        endpoint = f"{settings.protocol}/" + (f"127.0.0.1:{_free_port()}" if tcp else f"{folder}/socket")
        peer = session(endpoint, None, shared_memory=settings.shared_memory)
        arrived: queue.SimpleQueue[int] = queue.SimpleQueue()
        peer.declare_subscriber("transport/arrived", lambda sample: arrived.put(_time(sample)))
        with contextlib.ExitStack() as stack:
            for number, role in enumerate([RECEIVER, *[LISTENER] * settings.listeners]):
                stack.enter_context(_child(role, endpoint, settings.shared_memory))
                while len(list(peer.liveliness().get("transport/there/*"))) <= number:
                    time.sleep(0.05)
            blobs = peer.declare_publisher("transport/blob", congestion_control=zenoh.CongestionControl.BLOCK)
            schedule = Schedule(settings.messages)
            while not schedule.done:
                data = schedule.pause()
                schedule.sent_ns = time.monotonic_ns()
                blobs.put(data.tobytes())
                schedule.arrived(arrived.get(timeout=60))
        peer.close()
    print(json.dumps(schedule.microseconds))


@contextlib.contextmanager
def _child(role: str, endpoint: str, shared_memory: bool) -> Generator[None]:
    """One that takes what is sent, until it is left."""
    command = [
        sys.executable,
        "-m",
        "benchmarks.runner.transport.bare_zenoh",
        role,
        endpoint,
        json.dumps(shared_memory),
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as child:
        try:
            yield
        finally:
            assert child.stdin is not None
            child.stdin.close()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _time(sample: zenoh.Sample) -> int:
    return struct.unpack("<qq", sample.payload.to_bytes())[0]


if __name__ == "__main__":
    if sys.argv[1] == "send":
        send(Settings(**json.loads(sys.argv[2])))
    else:
        receive(sys.argv[1], sys.argv[2], json.loads(sys.argv[3]))
