"""The paper's experiments with the robot, redone: `python -m benchmarks.paper [--out FOLDER]`.

The proof of concept (two goals from four starts each, poses from features) and programming by demonstration with
DIGEST (five goals from two starts each). Prints the table beside the paper's figures, and how often which stage failed;
writes a picture of every goal with its starts and ends. ``--episodes FILE...`` adds to the failures those that
`benchmarks.episodes --json FILE` found.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from PIL import Image, ImageDraw

from benchmarks.common.command import command
from benchmarks.robot.episodes import HEADER, ROOT, Episode, row, run
from runner.message.codec import open_envelope
from runner.recording.recording import Recording
from stages.devices.suites.tray import GOALS
from stages.messages import Frame
from stages.messages.arrays import Rgb

_GRAPH = ROOT / "graph.yaml"
_OBJECTS = 6
"""Of each goal, the tray among them: the experiment takes them to be known."""
_DIGEST = ("hypotheses", "particle_filter", "ranker", "refiner")
_WIDTH = 320
"""Of one picture of a sheet, pixels."""


@dataclass(frozen=True)
class Experiment:
    """Some goals, each restored from several starts."""

    title: str
    features: bool
    """Poses come from features instead of DIGEST."""
    goals: tuple[str, ...]
    starts: int
    paper: int
    """Restored in the paper, of as many."""

    @property
    def episodes(self) -> int:
        """Goals times starts."""
        return len(self.goals) * self.starts


EXPERIMENTS = (
    Experiment("proof of concept, poses from features", True, ("breakfast", "lunch"), 4, 8),
    Experiment("programming by demonstration, DIGEST", False, tuple(GOALS), 2, 10),
)


@command
def main() -> int:
    """Runs all episodes, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("comparisons/paper"))
    parser.add_argument("--first-seed", type=int, default=0, help="of the starts; each has a seed of its own")
    parser.add_argument("--episodes", type=Path, nargs="*", default=[], help="JSON files of benchmarks.episodes")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    done: list[tuple[Experiment, list[Episode]]] = []
    for number, experiment in enumerate(EXPERIMENTS):
        graph = with_features(options.out / "proof.yaml") if experiment.features else _GRAPH
        print(f"\n{experiment.title}\n\n{HEADER}")
        episodes = [_printed(run(options.first_seed + start, graph, (f"world.goal={goal}",)))
                    for goal in experiment.goals for start in range(experiment.starts)]  # fmt: skip
        sheet(experiment, episodes).save(options.out / f"experiment-{number + 1}.webp", quality=80)
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
    lines = ["| experiment | goals | starts of each | paper | here, in truth | false successes |", "|---" * 6 + "|"]
    for one, episodes in done:
        judgements = [episode.judgement for episode in episodes]
        restored, false = sum(each.restored for each in judgements), sum(each.false_success for each in judgements)
        lines.append(
            f"| {one.title} | {len(one.goals)} | {one.starts} | {one.paper} of {one.episodes} | "
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


def sheet(experiment: Experiment, episodes: Sequence[Episode]) -> Image.Image:
    """A row for each goal: the goal as it was shown, then start and end of every episode."""
    columns = 1 + 2 * experiment.starts
    rows = [episodes[i : i + experiment.starts] for i in range(0, len(episodes), experiment.starts)]
    cells = [[views(chosen[0])["goal"], *(views(one)[when] for one in chosen for when in ("start", "end"))]
             for chosen in rows]  # fmt: skip
    height, width = cells[0][0].shape[:2]
    size = _WIDTH, _WIDTH * height // width
    found = Image.new("RGB", (columns * size[0], len(rows) * size[1]))
    draw = ImageDraw.Draw(found)
    for i, (goal, line) in enumerate(zip(experiment.goals, cells, strict=True)):
        titles = [f"goal: {goal}", *(f"{when} {n + 1}" for n in range(experiment.starts) for when in ("start", "end"))]
        for j, (title, rgb) in enumerate(zip(titles, line, strict=True)):
            corner = j * size[0], i * size[1]
            found.paste(Image.fromarray(rgb).resize(size, Image.Resampling.LANCZOS), corner)
            draw.text((corner[0] + 6, corner[1] + 4), title, fill="white", stroke_width=2, stroke_fill="black")
    return found


def views(episode: Episode) -> dict[str, Rgb]:
    """What the camera saw of the goal, of the start and at the end."""
    corrected = (each for each in Recording(episode.recording).envelopes() if each.id.startswith("corrector.frame#"))
    frames = [open_envelope(Frame, envelope) for envelope in corrected]
    later = [frame for frame in frames if not frame.name.startswith("goal")]
    return {"goal": frames[0].rgb, "start": later[0].rgb, "end": later[-1].rgb}


if __name__ == "__main__":
    raise SystemExit(main())
