"""Replays one recording again and again while the machine is busy, and says how fast a replay is.

`python -m benchmarks.replays FILE --times 100 --load 4` prints how many of the replays were identical and, for the
median replay, its time against what the stages computed when they were recorded.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[2]
IDENTICAL = re.compile(r"^IDENTICAL: (\d+)(?: of \d+)? messages", re.MULTILINE)
TIMES = re.compile(r"handlers took ([\d.]+) s .*\(when recorded ([\d.]+) s\), constructing the stages ([\d.]+) s")


@dataclass(frozen=True)
class Outcome:
    """One replay."""

    identical: bool
    messages: int
    seconds: float
    """Wall time from the start of the command to its end."""
    processor: float
    """Processor time of the whole command."""
    computed: float
    """Of it inside handlers."""
    constructing: float
    """Of it until stages were constructed."""
    recorded: float
    """Wall time inside handlers when it was recorded, all processes together."""
    verdict: str


def replay_once(path: Path, *, workers: int | None = None, settings: Sequence[str] = ()) -> Outcome:
    """`runner replay FILE --verify` in a process of its own."""
    command = [sys.executable, "-m", "runner.cli", "replay", str(path), "--verify"]
    command += [] if workers is None else ["--workers", str(workers)]
    command += [part for setting in settings for part in ("--set", setting)]
    began, before = time.monotonic(), _processor_time()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    seconds = time.monotonic() - began
    found, times = IDENTICAL.search(done.stdout), TIMES.search(done.stdout)
    computed, recorded, constructing = map(float, times.groups()) if times else (0.0, 0.0, 0.0)
    verdict = (done.stdout + done.stderr).strip().splitlines()[-1]
    identical, processor = done.returncode == 0 and found is not None, _processor_time() - before
    return Outcome(
        identical, int(found[1]) if found else 0, seconds, processor, computed, constructing, recorded, verdict
    )


def _processor_time() -> float:
    """Of all children that have ended, seconds."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@contextmanager
def busy(loops: int) -> Generator[None]:
    """Keeps so many processes computing meanwhile."""
    children = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(loops)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()


def main() -> None:
    """Prints the table; exits 1 where a replay was not identical."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("file", type=Path)
    parser.add_argument("--times", type=int, default=1, help="replays")
    parser.add_argument("--load", type=int, default=0, help="busy loops meanwhile")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)), help="stages at the same time")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="as `runner replay --set`")
    options = parser.parse_args()
    with busy(options.load):
        outcomes = list(_replays(options.file.absolute(), options.times, options.workers, options.settings))
    for line in report(outcomes, options.workers, options.load):
        print(line)
    sys.exit(not all(outcome.identical for outcome in outcomes))


def _replays(path: Path, times: int, workers: int, settings: Sequence[str]) -> Iterator[Outcome]:
    for number in range(1, times + 1):
        outcome = replay_once(path, workers=workers, settings=settings)
        if not outcome.identical:
            print(f"replay {number}: {outcome.verdict}", flush=True)
        yield outcome


def report(outcomes: Sequence[Outcome], workers: int, load: int) -> Iterator[str]:
    """The counts, then the times of the median replay."""
    middle = sorted(outcomes, key=lambda outcome: outcome.seconds)[len(outcomes) // 2]
    wall = median(outcome.seconds for outcome in outcomes)
    identical = sum(outcome.identical for outcome in outcomes)
    counts = f"{identical} of {len(outcomes)} replays identical, {middle.messages} messages each"
    yield f"{counts}, {load} busy loops meanwhile"
    rows = (
        ("stages' compute when recorded", middle.recorded),
        (f"  shared by {workers} workers", middle.recorded / workers),
        ("replay, wall (median)", wall),
        ("replay, processor time", middle.processor),
        ("  inside handlers", middle.computed),
        ("  constructing the stages", middle.constructing),
        ("  imports and all else", middle.processor - middle.computed - middle.constructing),
    )
    yield from (f"{name:<32}{seconds:8.2f} s" for name, seconds in rows)
    yield f"{'wall / recorded compute':<32}{wall / max(middle.recorded, 1e-9):8.2f}"
    yield f"{'wall / compute per worker':<32}{wall * workers / max(middle.recorded, 1e-9):8.2f}"


if __name__ == "__main__":
    main()
