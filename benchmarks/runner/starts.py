"""From `runner up` to ready, and whether a cold start loses anything: `python -m benchmarks.starts [--times 200]`.

First the default graph: how long after its start every process is ready, how much processor time that takes and how
much memory all processes hold then, where each is a new interpreter and where each is forked. Then, again and again, a
small graph whose source speaks the moment it may: each recording must be COMPLETE and hold every message.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from runner.process.forks import clean_environment
from runner.recording.recording import Recording

_GRAPH = Path(__file__).parents[2] / "graph.yaml"
_MESSAGES = 100
_TICKS = os.sysconf("SC_CLK_TCK")
FORKED = ("-m", "runner.cli")
SPAWNED = (
    "-c",
    "import sys, threading; threading.Thread(target=threading.Event().wait, daemon=True).start();"
    "from runner.cli.main import main; sys.exit(main())",
)
"""A process with a second thread is not forked."""


@dataclass(frozen=True)
class Start:
    """What it took until a graph was ready."""

    seconds: float
    """From the command to the line that says so."""
    processor: float
    """Seconds of all its processes."""
    memory: float
    """Bytes that they hold, what is shared divided among those that share it (proportional set size)."""


def start(graph: Path, folder: Path, program: tuple[str, ...]) -> Start:
    """Starts a graph, and ends it once it is ready."""
    environment = clean_environment() if program == SPAWNED else None  # or it would start again, without the thread
    command = [sys.executable, *program, "up", str(graph), "--recordings", str(folder)]
    began = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as run:
        assert run.stdout is not None
        for line in run.stdout:
            if "processes are ready" in line:
                seconds = time.monotonic() - began
                processes = [run.pid, *_descendants(run.pid)]
                found = Start(seconds, sum(map(_processor, processes)), sum(map(_memory, processes)))
                run.terminate()
                run.stdout.read()
                return found
    raise SystemExit(f"{graph} never became ready")


def _descendants(pid: int) -> Iterator[int]:
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in map(int, (task / "children").read_text().split()):
            yield child
            yield from _descendants(child)


def _processor(pid: int) -> float:
    """User and system time of a process and of its children that have ended."""
    return sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:15])) / _TICKS


def _memory(pid: int) -> float:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))


def cold_start(folder: Path) -> bool:
    """Whether a recording of a graph that speaks at once is complete and holds all of it."""
    seconds = _MESSAGES / 1000
    stages = {
        "speaker": {
            "stage": "benchmarks.runner.recording_stages:Speaker",
            "config": {"hertz": 1000, "seconds": seconds},
        }
    }
    stages["ender"] = {
        "stage": "benchmarks.runner.recording_stages:Camera",
        "config": {"hertz": 30, "seconds": seconds},
    }
    graph = folder / "graph.yaml"
    graph.write_text(json.dumps({"name": "start", "stages": stages}))
    command = [sys.executable, "-m", "runner.cli", "up", str(graph), "--recordings", str(folder)]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    (path,) = folder.glob("*.mcap")
    words = sum(message.topic == "speaker/word" for message in Recording(path).messages.values())
    return done.returncode == 0 and words == _MESSAGES


def main() -> None:
    """Prints the times of the default graph and how many cold starts were whole."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3, help="of the default graph")
    options = parser.parse_args()
    for name, program in (("a new interpreter", SPAWNED), ("forked", FORKED)):
        starts: list[Start] = []
        for _ in range(options.rounds):
            with tempfile.TemporaryDirectory() as folder:
                starts.append(start(_GRAPH, Path(folder), program))
        seconds = sorted(one.seconds for one in starts)
        print(
            f"default graph, every process {name}: ready after {median(seconds):.1f} s ({seconds[0]:.1f} to "
            f"{seconds[-1]:.1f}), {median(one.processor for one in starts):.1f} s of processor time, "
            f"{median(one.memory for one in starts) / 1e9:.2f} GB"
        )
    whole = 0
    for _ in range(options.times):
        with tempfile.TemporaryDirectory() as folder:
            whole += cold_start(Path(folder))
    print(f"{whole} of {options.times} cold starts lost nothing")


if __name__ == "__main__":
    main()
