"""dora-rs through its Python API, for `benchmarks.transport`: `dora run` starts this file for every node."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pyarrow as pa  # type: ignore[import-not-found]
from dora import Node  # type: ignore[import-not-found]
from schedule import Schedule  # type: ignore[import-not-found] - run as a file, beside it

_node: Any = Node()


def receive(role: str) -> None:
    """Takes each array; the receiver answers it with the time at which it was there."""
    for event in _node:
        if event["type"] == "INPUT":
            event["value"].to_numpy(zero_copy_only=True)
            now = time.monotonic_ns()
            if role == "receiver":
                _node.send_output("arrived", pa.array([now]))
        elif event["type"] == "STOP":
            return


def send() -> None:
    """Writes the times of all sizes as JSON."""
    schedule: Any = Schedule(int(os.environ["MESSAGES"]))
    while not schedule.done:
        data = schedule.pause()
        schedule.sent_ns = time.monotonic_ns()
        _node.send_output("blob", pa.array(data))
        schedule.arrived(_answer())
    Path(os.environ["OUT"]).write_text(json.dumps(schedule.microseconds))


def _answer() -> int:
    while (event := _node.next())["type"] != "INPUT":
        pass
    return int(event["value"][0].as_py())


if __name__ == "__main__":
    send() if os.environ["ROLE"] == "sender" else receive(os.environ["ROLE"])
