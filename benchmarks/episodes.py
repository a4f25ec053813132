"""Runs the main job for several seeds and prints a table: `python -m benchmarks.episodes 0 1 2 ... [--graph FILE]`."""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from runner.message.codec import open_envelope
from runner.recording.recording import Recording
from stages.messages import Outcome, Verdict

M = TypeVar("M", Outcome, Verdict)
ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Episode:
    """How one run ended."""

    seed: int
    code: int
    seconds: float
    verdict: Verdict | None
    outcomes: tuple[Outcome, ...]
    complete: bool
    reason: str


def run(seed: int, graph: Path) -> Episode:
    """Runs the graph in a process of its own and reads what it recorded."""
    command = [sys.executable, "-m", "runner.cli", "up", str(graph), "--set", f"world.seed={seed}"]
    begun = time.monotonic()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    seconds = time.monotonic() - begun
    named = re.search(r"^recording (\S+\.mcap)", done.stdout, re.MULTILINE)
    if named is None:
        raise SystemExit(f"seed {seed}: no recording\n{done.stdout}\n{done.stderr}")
    recording = Recording(ROOT / named[1])
    verdicts = list(_messages(recording, Verdict))
    outcomes = tuple(_messages(recording, Outcome))
    reason = done.stdout.strip().splitlines()[-1]
    return Episode(
        seed, done.returncode, seconds, verdicts[-1] if verdicts else None, outcomes, recording.verdict.complete, reason
    )


def _messages(recording: Recording, kind: type[M]) -> Iterator[M]:
    for envelope in recording.envelopes():
        if envelope.type == kind.__name__:
            yield open_envelope(kind, envelope)


def row(episode: Episode) -> str:
    """One line of the table."""
    verdict, outcomes = episode.verdict, episode.outcomes
    held = f"{len(verdict.satisfied)} of {len(verdict.satisfied) + len(verdict.violated)}" if verdict else "-"
    done = f"{sum(outcome.success for outcome in outcomes)} of {len(outcomes)}"
    word = "COMPLETE" if episode.complete else "INCOMPLETE"
    looks = verdict.looks if verdict else 0
    why = "" if episode.code == 0 else episode.reason
    return f"| {episode.seed} | {episode.code} | {held} | {done} | {looks} | {episode.seconds:.0f} s | {word} | {why} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table as it grows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--graph", type=Path, default=ROOT / "graph.yaml")
    options = parser.parse_args(arguments)
    print("| seed | exit | relations hold | transfers done | looks | wall time | recording | reason |")
    print("|---|---|---|---|---|---|---|---|")
    episodes: list[Episode] = []
    for seed in options.seeds:
        episodes.append(run(seed, options.graph))
        print(row(episodes[-1]), flush=True)
    print(f"\n{sum(episode.code == 0 for episode in episodes)} of {len(episodes)} restored")


if __name__ == "__main__":
    main()
