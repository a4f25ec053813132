"""Runs the main job for several seeds: `python -m benchmarks.episodes [--suite NAME] 0 1 2 ... [--json OUT]`.

Prints a table, judged by the simulator's truth as well as by what the robot claims; ``--json`` writes it per seed.
"""

from __future__ import annotations

import argparse
import json
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
from stages.devices.suites import kinds
from stages.messages import Correction, Goal, Outcome, Snapshot, Task, Verdict
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.truth import Judgement, Truth

M = TypeVar("M", Correction, Goal, Outcome, Snapshot, Task, Verdict)
ROOT = Path(__file__).parents[2]
SUITES: dict[str, tuple[str, ...]] = {"tray": ()} | {name: (f"world.suite={name}",) for name in kinds.DRAWN}
"""Settings by suite: ``tray`` is what the graph lays out as it stands."""


@dataclass(frozen=True)
class Episode:
    """How one run ended."""

    seed: int
    code: int
    seconds: float
    verdict: Verdict | None
    judgement: Judgement
    outcomes: tuple[Outcome, ...]
    complete: bool
    reason: str
    recording: Path
    corrections: tuple[Correction, ...] = ()
    """What the arm showed of the camera, which takes its time."""

    def summary(self) -> dict[str, object]:
        """What ``--json`` writes of it."""
        judgement, losses = self.judgement, self.judgement.losses
        return {
            "seed": self.seed,
            "restored_by_truth": judgement.restored,
            "restored_as_claimed": judgement.claimed,
            "false_success": judgement.false_success,
            "end_seen": judgement.end_seen,
            "objects_lost": len(losses),
            "objects_lost_unsaid": sum(not loss.said for loss in losses),
            "transfers": len(self.outcomes),
            "relations_regained": len(judgement.regained),
            "robot_seconds": round(self.robot_seconds, 2),
            "wall_seconds": round(self.seconds, 2),
            "failing_stage": self.failing_stage,
            "refused": self.refused,
            "reason": "" if self.code == 0 else self.reason,
            "differences": list(judgement.differences),
            "losses": list(map(str, losses)),
            "exit": self.code,
            "complete": self.complete,
            "recording": self.recording.name,
        }

    @property
    def robot_seconds(self) -> float:
        """How long the arm moved, simulated seconds."""
        return sum(one.robot_seconds for one in (*self.outcomes, *self.corrections))

    @property
    def failing_stage(self) -> str:
        """Whom the verdict blames; perception for a success that is none; the runner where there is no verdict."""
        if self.verdict is None:
            return "runner"
        return "perception" if self.judgement.false_success else self.verdict.failed_stage

    @property
    def refused(self) -> bool:
        """Whether the planner found no way and said so before anything moved."""
        return self.failing_stage == "planner" and not self.outcomes


def run(seed: int, graph: Path, settings: Sequence[str]) -> Episode:
    """Runs the graph in a process of its own and reads what it recorded."""
    chosen = [part for setting in (f"world.seed={seed}", *settings) for part in ("--set", setting)]
    command = [sys.executable, "-m", "runner.cli", "up", str(graph), *chosen]
    begun = time.monotonic()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    seconds = time.monotonic() - begun
    named = re.search(r"^recording (\S+\.mcap)", done.stdout, re.MULTILINE)
    if named is None:
        raise SystemExit(f"seed {seed}: no recording\n{done.stdout}\n{done.stderr}")
    reason = done.stdout.strip().splitlines()[-1]
    return judged(ROOT / named[1], seed=seed, code=done.returncode, seconds=seconds, reason=reason)


def judged(path: Path, *, seed: int, code: int, seconds: float, reason: str) -> Episode:
    """An episode as its recording tells it."""
    recording = Recording(path)
    verdict = next(iter(messages(recording, Verdict)), None)
    outcomes, corrections = tuple(messages(recording, Outcome)), tuple(messages(recording, Correction))
    goals = (goal for goal in messages(recording, Goal) if verdict is None or goal.name == verdict.goal_name)
    snapshots = list(messages(recording, Snapshot))
    began = next((task.current for task in messages(recording, Task)), None)
    judgement = Truth(Catalogue.load(BUILT_IN)).judge(snapshots, next(goals, None), verdict, outcomes, began)
    complete = recording.verdict.complete
    return Episode(seed, code, seconds, verdict, judgement, outcomes, complete, reason, path, corrections)


def messages(recording: Recording, kind: type[M]) -> Iterator[M]:
    """Every recorded message of a type, in order."""
    for envelope in recording.envelopes():
        if envelope.type == kind.__name__:
            yield open_envelope(kind, envelope)


HEADER = (
    "| seed | exit | relations hold | in truth | lost | felt to stand | looks | wall time | recording | reason |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def row(episode: Episode) -> str:
    """One line of the table."""
    verdict, judgement, outcomes = episode.verdict, episode.judgement, episode.outcomes
    held = _share(verdict.satisfied, verdict.violated) if verdict else "-"
    felt = f"{sum(outcome.success for outcome in outcomes)} of {len(outcomes)}"
    word = "COMPLETE" if episode.complete else "INCOMPLETE"
    why = "" if episode.code == 0 else episode.reason
    cells = [
        episode.seed, episode.code, held, _share(judgement.held, judgement.violated), len(judgement.losses), felt,
        verdict.looks if verdict else 0, f"{episode.seconds:.0f} s", word, why,
    ]  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def _share(held: Sequence[object], violated: Sequence[object]) -> str:
    return f"{len(held)} of {len(held) + len(violated)}"


def totals(episodes: Sequence[Episode]) -> str:
    """The last line."""
    judgements = [episode.judgement for episode in episodes]
    losses = [loss for judgement in judgements for loss in judgement.losses]
    regained = max(1, sum(len(one.regained) for one in judgements))
    return (
        f"{sum(episode.code == 0 for episode in episodes)} of {len(episodes)} restored, "
        f"{sum(episode.refused for episode in episodes)} refused before anything moved; in truth "
        f"{sum(one.restored for one in judgements)}, false successes {sum(one.false_success for one in judgements)}, "
        f"objects lost {len(losses)}, {sum(not loss.said for loss in losses)} of them unsaid; "
        f"{sum(one.robot_seconds for one in episodes) / regained:.1f} robot seconds and "
        f"{sum(one.seconds for one in episodes) / regained:.1f} wall seconds per relation regained"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table as it grows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--suite", choices=SUITES, default="tray", help="kind of scenes")
    parser.add_argument("--graph", type=Path, default=ROOT / "graph.yaml")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE")
    parser.add_argument("--json", type=Path, help="file to write, one object per seed")
    options = parser.parse_args(arguments)
    print(HEADER)
    episodes: list[Episode] = []
    for seed in options.seeds:
        episodes.append(run(seed, options.graph, (*SUITES[options.suite], *options.set)))
        print(row(episodes[-1]), flush=True)
        if options.json:
            summaries = [{"suite": options.suite, **episode.summary()} for episode in episodes]
            options.json.write_text(json.dumps(summaries, indent=1) + "\n", encoding="utf-8")
    print(f"\n{totals(episodes)}")


if __name__ == "__main__":
    main()
