"""Bare Zenoh as a user would write it, for `benchmarks.transport`: raw bytes, default settings, an explicit endpoint.

``python -m benchmarks.transport.bare_zenoh PROTOCOL LISTENERS MESSAGES`` sends to one that answers and so many others
that only take what comes, as the runner's recorder does.
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

import numpy as np
import zenoh

from benchmarks.transport.schedule import Schedule

RECEIVER, LISTENER = "receiver", "listener"


def session(listen: str | None, connect: str | None) -> zenoh.Session:
    """A peer that looks for nobody else."""
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([listen] if listen else []))
    config.insert_json5("connect/endpoints", json.dumps([connect] if connect else []))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def receive(endpoint: str, role: str) -> None:
    """Takes each array until stdin closes; the receiver answers it with the time at which its callback had it."""
    peer = session(None, endpoint)
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


def send(protocol: str, listeners: int, messages: int) -> None:
    """Prints the times of all sizes as JSON."""
    with tempfile.TemporaryDirectory() as folder:
        endpoint = f"tcp/127.0.0.1:{_free_port()}" if protocol == "tcp" else f"{protocol}/{folder}/socket"
        peer = session(endpoint, None)
        arrived: queue.SimpleQueue[int] = queue.SimpleQueue()
        peer.declare_subscriber("transport/arrived", lambda sample: arrived.put(_time(sample)))
        roles = [RECEIVER, *[LISTENER] * listeners]
        with contextlib.ExitStack() as stack:
            for role in roles:
                stack.enter_context(_child(endpoint, role))
            while len(list(peer.liveliness().get("transport/there/*"))) < len(roles):
                time.sleep(0.05)
            blobs = peer.declare_publisher("transport/blob", congestion_control=zenoh.CongestionControl.BLOCK)
            schedule = Schedule(messages)
            while not schedule.done:
                data = schedule.pause()
                schedule.sent_ns = time.monotonic_ns()
                blobs.put(data.tobytes())
                schedule.arrived(arrived.get(timeout=60))
        peer.close()
    print(json.dumps(schedule.microseconds))


@contextlib.contextmanager
def _child(endpoint: str, role: str) -> Generator[None]:
    """One that takes what is sent, until it is left."""
    command = [sys.executable, "-m", "benchmarks.transport.bare_zenoh", endpoint, role]
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
    if "/" in sys.argv[1]:
        receive(sys.argv[1], sys.argv[2])
    else:
        send(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
