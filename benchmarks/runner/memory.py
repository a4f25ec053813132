"""Whether a graph that runs for long takes more and more memory: `python -m benchmarks.memory [--millions 1 2 4]`.

A source that sends small messages as fast as it may and a stage that takes them run under `runner up`, recorded.
Printed: what the supervisor, the recorder, the publisher and the consumer hold (resident set) after so many messages,
and by how much that grows with each further million.
"""

from __future__ import annotations

import argparse
import itertools
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil

from benchmarks.common.command import command
from benchmarks.runner.live import process, running
from runner.live.live import Live

STAGES = {
    "publisher": {"stage": "benchmarks.runner.recording_stages:Speaker", "config": {"hertz": 1e9, "seconds": 1e9}},
    "consumer": {
        "stage": "benchmarks.runner.recording_stages:Listener",
        "inputs": {"word": {"from": "publisher.word", "policy": "block", "queue": 64}},
    },
}
POLL_SECONDS = 0.5
Sizes = dict[str, float]
"""Megabytes by process."""


def sizes(live: Live, millions: Sequence[float]) -> Iterator[tuple[float, float, Sizes]]:
    """Millions of messages that the consumer has had, seconds since the first look, and what the processes hold."""
    began = time.monotonic()
    for wanted in millions:
        while (taken := _taken(live)) < wanted * 1e6:
            time.sleep(POLL_SECONDS)
        yield taken / 1e6, time.monotonic() - began, _sizes(live)


def _taken(live: Live) -> int:
    pulse = process(live.status(), "consumer").pulse
    return pulse.steps if pulse is not None else 0


def _sizes(live: Live) -> Sizes:
    pids = {"supervisor": live.entry.pid} | {found.stage: found.pid for found in live.status().processes}
    return {name: psutil.Process(pid).memory_info().rss / 1e6 for name, pid in pids.items()}


@command
def main() -> int:
    """Prints a line per count, then the growth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--millions", type=float, nargs="+", default=[0.1, 1.0, 2.0, 4.0], help="of messages")
    options = parser.parse_args()
    found: list[tuple[float, Sizes]] = []
    with tempfile.TemporaryDirectory() as folder, running(Path(folder), "memory", STAGES) as live:
        for millions, seconds, held in sizes(live, sorted(options.millions)):
            found.append((millions, held))
            line = ", ".join(f"{name} {size:.1f} MB" for name, size in held.items())
            print(f"{millions:.2f} million after {seconds:.0f} s: {line} (load {os.getloadavg()[0]:.1f})", flush=True)
    for (before, smaller), (after, larger) in itertools.pairwise(found):
        growth = ", ".join(f"{name} {(larger[name] - smaller[name]) / (after - before):+.1f} MB" for name in larger)
        print(f"from {before:.2f} to {after:.2f} million, per million: {growth}")
    return 0


if __name__ == "__main__":
    main()
