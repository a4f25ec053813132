"""The paper's experiments with the robot, redone: `python -m benchmarks.paper [--out FOLDER]`.

The proof of concept (two goals from four starts each; poses from features, of objects that are known, so there are no
strangers) and programming by demonstration with DIGEST (five goals from two starts each, with three strangers). Prints
the table beside the paper's figures, and how often which stage failed; writes a picture of every goal with its starts
and ends. ``--episodes FILE...`` adds to the failures those that `benchmarks.episodes --json FILE` found.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from benchmarks.common.command import command
from benchmarks.robot.episodes import HEADER, ROOT, Episode, row, run
from benchmarks.robot.pictures import QUALITY, sheet, views
from stages.devices.suites.tray import GOALS
from stages.messages.arrays import Rgb

_GRAPH = ROOT / "graph.yaml"
_OBJECTS = 6
"""Of each goal, the tray among them: the experiment takes them to be known."""
_DIGEST = ("hypotheses", "particle_filter", "ranker", "refiner")


@dataclass(frozen=True)
class Experiment:
    """Some goals, each restored from several starts."""

    title: str
    features: bool
    """Poses come from features instead of DIGEST."""
    goals: tuple[str, ...]
    starts: int
    strangers: int
    """Objects of no goal in each start."""
    paper: int
    """Restored in the paper, of as many."""

    @property
    def episodes(self) -> int:
        """Goals times starts."""
        return len(self.goals) * self.starts

    def settings(self, goal: str) -> tuple[str, ...]:
        """Of the graph, for an episode of this goal."""
        return f"world.goal={goal}", f"world.strangers={self.strangers}"


EXPERIMENTS = (
    Experiment("proof of concept, poses from features", True, ("breakfast", "lunch"), 4, 0, 8),
    Experiment("programming by demonstration, DIGEST", False, tuple(GOALS), 2, 3, 10),
)


@command
def main() -> int:
    """Runs all episodes, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("comparisons/paper"))
    parser.add_argument("--first-seed", type=int, default=0, help="of the starts; each has a seed of its own")
    parser.add_argument("--strangers", type=int, help="objects of no goal in each start, instead of 0 and 3")
    parser.add_argument("--episodes", type=Path, nargs="*", default=[], help="JSON files of benchmarks.episodes")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    done: list[tuple[Experiment, list[Episode]]] = []
    for number, each in enumerate(EXPERIMENTS):
        experiment = each if options.strangers is None else replace(each, strangers=options.strangers)
        graph = with_features(options.out / "proof.yaml") if experiment.features else _GRAPH
        print(f"\n{experiment.title}\n\n{HEADER}")
        episodes = [_printed(run(options.first_seed + start, graph, experiment.settings(goal)))
                    for goal in experiment.goals for start in range(experiment.starts)]  # fmt: skip
        sheet(rows(experiment, episodes)).save(options.out / f"experiment-{number + 1}.webp", quality=QUALITY)
        done.append((experiment, episodes))
    print(f"\n{table(done)}")
    summaries = [each.summary() for _, episodes in done for each in episodes]
    for path in options.episodes:
        summaries += json.loads(path.read_text())
    print(f"\n{failures(summaries)}")
    return 0


def with_features(path: Path) -> Path:
    """Writes the graph of the main job with a baseline in place of DIGEST."""
    content: dict[str, Any] = yaml.safe_load(_GRAPH.read_text())
    stages = {name: stage for name, stage in content["stages"].items() if name not in _DIGEST}
    stages["features"] = {
        "stage": "benchmarks.robot.paper.stages:FeatureScene",
        "config": {"catalogue": "${world.catalogue}", "n_objects": _OBJECTS},
        "inputs": {port: content["stages"]["hypotheses"]["inputs"][port] for port in ("frame", "candidates")},
    }
    text = yaml.safe_dump({**content, "name": "proof", "stages": stages}, sort_keys=False)
    for stage in ("hypotheses", "refiner"):
        text = text.replace(f"{stage}.", "features.")
    path.write_text(text)
    return path


def _printed(episode: Episode) -> Episode:
    print(row(episode), flush=True)
    return episode


def table(done: Iterable[tuple[Experiment, Sequence[Episode]]]) -> str:
    """Restored in the paper and here, by the simulator's truth."""
    lines = [
        "| experiment | goals | starts of each | strangers | paper | here, in truth | false successes |",
        "|---" * 7 + "|",
    ]
    for one, episodes in done:
        judgements = [episode.judgement for episode in episodes]
        restored, false = sum(each.restored for each in judgements), sum(each.false_success for each in judgements)
        lines.append(
            f"| {one.title} | {len(one.goals)} | {one.starts} | {one.strangers} | {one.paper} of {one.episodes} | "
            f"{restored} of {one.episodes} | {false} |"
        )
    return "\n".join(lines)


def failures(summaries: Sequence[dict[str, Any]]) -> str:
    """How many episodes failed by which stage, and the reasons, as the paper's discussion has them."""
    failed = [each for each in summaries if not each["restored_by_truth"] or each["false_success"]]
    stages = Counter(str(each["failing_stage"]) or "none" for each in failed)
    lines = ["| failing stage | episodes | reasons |", "|---" * 3 + "|"]
    for stage, count in stages.most_common():
        reasons = sorted({str(each["reason"]) for each in failed if (str(each["failing_stage"]) or "none") == stage})
        lines.append(f"| {stage} | {count} of {len(summaries)} | {'; '.join(reasons)} |")
    return "\n".join(lines) if failed else f"All of {len(summaries)} episodes were restored."


def rows(experiment: Experiment, episodes: Sequence[Episode]) -> list[list[tuple[str, Rgb]]]:
    """A row for each goal: the goal as it was shown, then start and end of every episode."""
    found: list[list[tuple[str, Rgb]]] = []
    for i, goal in enumerate(experiment.goals):
        seen = [views(one.recording) for one in episodes[i * experiment.starts : (i + 1) * experiment.starts]]
        ends = [(f"{when} {n + 1}", each[when]) for n, each in enumerate(seen) for when in ("start", "end")]
        found.append([(f"goal: {goal}", seen[0]["goal"]), *ends])
    return found


if __name__ == "__main__":
    raise SystemExit(main())
