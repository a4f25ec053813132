"""What recording costs: `python -m benchmarks.recording [--seconds 20]`.

A camera of 640 x 480 RGB-D at 30 Hz and a stage that sends 1000 small messages a second run under `runner up`. Printed:
how many of them the recording holds, its verdict, and what share of one core the recorder's process took.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import Counter
from pathlib import Path

import psutil

from benchmarks.common.command import command
from benchmarks.runner.live import process, running
from runner.live.live import Live, wait_until_gone
from runner.message.packet import RECORDER
from runner.recording.recording import Recording

AIM = 0.35
"""Of a core."""
LEAD_SECONDS = 1.0
"""Before the processor time is read for the first time: set-up is not recording."""


def record(folder: Path, seconds: float) -> float:
    """Runs the graph to its end; returns the share of a core that the recorder took."""
    pace = {"seconds": LEAD_SECONDS + seconds}
    stages = {
        "camera": {"stage": "benchmarks.runner.recording_stages:Camera", "config": {"hertz": 30, **pace}},
        "speaker": {"stage": "benchmarks.runner.recording_stages:Speaker", "config": {"hertz": 1000, **pace}},
    }
    with running(folder, "recording", stages) as live:
        time.sleep(LEAD_SECONDS)
        began, used = time.monotonic(), _used(live)
        time.sleep(seconds - LEAD_SECONDS)
        share = (_used(live) - used) / (time.monotonic() - began)
        wait_until_gone(live.entry)
    return share


def _used(live: Live) -> float:
    """Processor time of the recorder so far, seconds."""
    return sum(psutil.Process(process(live.status(), RECORDER).pid).cpu_times()[:2])


@command
def main() -> int:
    """Prints counts, verdict and share; exits 1 where something is missing or the recorder takes more than its aim."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        share = record(Path(folder), options.seconds)
        (path,) = Path(folder).glob("*.mcap")
        recording = Recording(path)
        counts = Counter(message.topic for message in recording.messages.values())
        size = path.stat().st_size / 1e6
    for topic, hertz in (("camera/picture", 30), ("speaker/word", 1000)):
        print(f"{topic:16} {counts[topic]:6} of {round(hertz * (LEAD_SECONDS + options.seconds))} recorded")
    print(f"{recording.verdict}, {size:.0f} MB")
    print(f"the recorder took {share:.1%} of one core (aim {AIM:.0%}), load {os.getloadavg()[0]:.1f}")
    return int(share > AIM or not recording.verdict.complete)


if __name__ == "__main__":
    raise SystemExit(main())
