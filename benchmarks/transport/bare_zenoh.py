"""Bare Zenoh as a user would write it, for `benchmarks.transport`: raw bytes, default settings, explicit endpoint."""

from __future__ import annotations

import json
import queue
import struct
import subprocess
import sys
import time

import numpy as np
import zenoh

from benchmarks.transport.schedule import Schedule
from runner.transport.session import new_endpoint


def session(listen: str, connect: str | None) -> zenoh.Session:
    """A peer on loopback that looks for nobody else."""
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([listen]))
    config.insert_json5("connect/endpoints", json.dumps([connect] if connect else []))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def receive(endpoint: str) -> None:
    """Answers each array with the time at which its callback had it, until stdin closes."""
    peer = session("tcp/127.0.0.1:0", endpoint)
    answers = peer.declare_publisher("transport/arrived")

    def handle(sample: zenoh.Sample) -> None:
        array = np.frombuffer(sample.payload.to_bytes(), np.uint8)
        now = time.monotonic_ns()
        answers.put(struct.pack("<qq", now, len(array)))

    peer.declare_subscriber("transport/blob", handle)
    token = peer.liveliness().declare_token("transport/there")
    sys.stdin.read()
    token.undeclare()
    peer.close()


def send(messages: int) -> None:
    """Prints the times of all sizes as JSON."""
    endpoint = new_endpoint()
    peer = session(endpoint, None)
    arrived: queue.SimpleQueue[int] = queue.SimpleQueue()
    peer.declare_subscriber("transport/arrived", lambda sample: arrived.put(_time(sample)))
    command = [sys.executable, "-m", "benchmarks.transport.bare_zenoh", endpoint]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as receiver:
        while not list(peer.liveliness().get("transport/there")):
            time.sleep(0.05)
        blobs = peer.declare_publisher("transport/blob", congestion_control=zenoh.CongestionControl.BLOCK)
        schedule = Schedule(messages)
        while not schedule.done:
            data = schedule.pause()
            schedule.sent_ns = time.monotonic_ns()
            blobs.put(data.tobytes())
            schedule.arrived(arrived.get(timeout=60))
        assert receiver.stdin is not None
        receiver.stdin.close()
    peer.close()
    print(json.dumps(schedule.microseconds))


def _time(sample: zenoh.Sample) -> int:
    return struct.unpack("<qq", sample.payload.to_bytes())[0]


if __name__ == "__main__":
    if sys.argv[1].isdigit():
        send(int(sys.argv[1]))
    else:
        receive(sys.argv[1])
