"""What recording costs: `python -m benchmarks.recording [--seconds 20]`.

A camera of 640 x 480 RGB-D at 30 Hz and a stage that sends 1000 small messages a second run under `runner up`. Printed:
how many of them the recording holds, its verdict, and what share of one core the recorder's process took.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import psutil

from runner.recording.recording import Recording


def record(folder: Path, seconds: float) -> float:
    """Runs the graph; returns the largest share of a core that the recorder took over a second or more."""
    stages = {
        "camera": {"stage": "benchmarks.recording_stages:Camera", "config": {"hertz": 30, "seconds": seconds}},
        "speaker": {"stage": "benchmarks.recording_stages:Speaker", "config": {"hertz": 1000, "seconds": seconds}},
    }
    graph = folder / "graph.yaml"
    graph.write_text(json.dumps({"name": "recording", "stages": stages}))
    command = [sys.executable, "-m", "runner.cli", "up", str(graph), "--recordings", str(folder)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as run:
        return _share(run, seconds)


def _share(run: subprocess.Popen[bytes], seconds: float) -> float:
    """CPU time of the recorder over wall time, from its first image on."""
    begun: tuple[float, float] | None = None
    share = 0.0
    while run.poll() is None:
        used = _recorder_seconds(run.pid)
        now = time.monotonic()
        if begun is None and used > 0 and list(_growing(run)):
            begun = now, used
        elif begun is not None and now - begun[0] < seconds:
            share = (used - begun[1]) / (now - begun[0])
        time.sleep(0.25)
    return share


def _growing(run: subprocess.Popen[bytes]) -> list[Path]:
    """Recordings that hold images already."""
    folder = Path(str(run.args[-1]))  # type: ignore[index]
    return [path for path in folder.glob("*.mcap") if path.stat().st_size > 10_000_000]


def _recorder_seconds(supervisor: int) -> float:
    with contextlib.suppress(psutil.NoSuchProcess):
        for child in psutil.Process(supervisor).children():
            if "runner.process.recorder" in child.cmdline():
                return sum(child.cpu_times()[:2])
    return 0.0


def main() -> None:
    """Prints counts, verdict and share."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        share = record(Path(folder), options.seconds)
        (path,) = Path(folder).glob("*.mcap")
        recording = Recording(path)
        counts = Counter(message.topic for message in recording.messages.values())
        for topic, hertz in (("camera/picture", 30), ("speaker/word", 1000)):
            print(f"{topic:16} {counts[topic]:6} of {round(hertz * options.seconds)} recorded")
        print(f"{recording.verdict}, {path.stat().st_size / 1e6:.0f} MB")
        print(f"the recorder took {share:.1%} of one core")


if __name__ == "__main__":
    main()
