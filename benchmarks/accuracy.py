"""Scores BOP results: `python -m benchmarks.accuracy DATASET CSV`."""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.datasets import ImageId, Truth, read_truth
from runner.contract import Refused
from stages.devices.bop_results import Result, read_results
from stages.perception.metrics import add_s, is_near_flip, pose_errors
from stages.scene.catalogue import Catalogue, CatalogueObject

_POINTS = 2000
_FLIP = np.deg2rad(15.0)


@dataclass(frozen=True)
class Score:
    """What became of one true object; errors are infinite where nothing of its label was found."""

    truth: Truth
    adds: float = np.inf
    metres: float = np.inf
    radians: float = np.inf
    flip: bool = False

    def within(self, metres: float, degrees: float) -> bool:
        """Whether position and rotation are that close, modulo symmetries."""
        return self.metres < metres and self.radians < np.deg2rad(degrees)


def score(truths: list[Truth], results: list[Result], catalogue: Catalogue) -> list[Score]:
    """One score per true object against the results of its image and label, each result used once."""
    items = {item.label: item for item in catalogue.objects.values()}
    groups: dict[tuple[ImageId, int], tuple[list[Truth], list[Result]]] = defaultdict(lambda: ([], []))
    for truth in truths:
        groups[truth.image, truth.label][0].append(truth)
    for result in results:
        groups[(result.scene_id, result.image_id), result.label][1].append(result)
    return [one for (_, label), group in groups.items() for one in _matched(*group, items[label])]


def _matched(truths: list[Truth], results: list[Result], item: CatalogueObject) -> list[Score]:
    scores = [[_scored(truth, result, item) for result in results] for truth in truths]
    costs = np.array([[min(one.adds, 1e3) for one in row] for row in scores]).reshape(len(truths), len(results))
    rows, columns = linear_sum_assignment(costs)
    matched = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    return [scores[i][matched[i]] if i in matched else Score(truth) for i, truth in enumerate(truths)]


def _scored(truth: Truth, result: Result, item: CatalogueObject) -> Score:
    points = item.mesh.vertices[:: max(1, len(item.mesh.vertices) // _POINTS)]
    T, T_true = result.T_camera_object, truth.T_camera_object
    metres, radians = pose_errors(T, T_true, item.symmetries.transforms())
    flip = is_near_flip(T, T_true, item.symmetries, tolerance=_FLIP)
    return Score(truth, add_s(T, T_true, points), metres, radians, flip)


def right_sets(truths: list[Truth], results: list[Result]) -> tuple[int, int]:
    """Images whose set of labels is exactly right, and all images."""
    images = sorted({truth.image for truth in truths})
    found = [sorted(r.label for r in results if (r.scene_id, r.image_id) == image) for image in images]
    wanted = [sorted(t.label for t in truths if t.image == image) for image in images]
    return sum(f == w for f, w in zip(found, wanted, strict=True)), len(images)


def table(scores: list[Score], sets: tuple[int, int]) -> str:
    """The summary that people read."""
    bounds = {
        "ADD-S < 1 cm": [one.adds < 0.01 for one in scores],
        "ADD-S < 2 cm": [one.adds < 0.02 for one in scores],
        "1 cm and 10 degrees": [one.within(0.01, 10) for one in scores],
        "2 cm and 15 degrees": [one.within(0.02, 15) for one in scores],
    }
    lines = [
        f"{name:22s} {100 * np.mean(hits):5.1f} %  ({sum(hits)} of {len(scores)})" for name, hits in bounds.items()
    ]
    lines.append(f"{'near-symmetric flips':22s} {sum(one.flip for one in scores)} (counted as errors above)")
    lines.append(f"{'set of objects right':22s} {sets[0]} of {sets[1]} images")
    return "\n".join(lines)


def failures(scores: list[Score], catalogue: Catalogue) -> str:
    """A line for every object that is not within 2 cm and 15 degrees."""
    names = {item.label: item.name for item in catalogue.objects.values()}
    lines = [
        f"  scene {one.truth.image[0]} image {one.truth.image[1]} {names[one.truth.label]}: "
        + (f"{100 * one.metres:.1f} cm, {np.rad2deg(one.radians):.0f} degrees, ADD-S {100 * one.adds:.1f} cm"
           + (", near-symmetric flip" if one.flip else "") if np.isfinite(one.adds) else "not found")
        for one in scores
        if not one.within(0.02, 15)
    ]  # fmt: skip
    return "\n".join(lines)


def main() -> int:
    """Prints the table; exits 2 where an input is refused."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="BOP data set folder")
    parser.add_argument("csv", type=Path, help="results in BOP format")
    arguments = parser.parse_args()
    try:
        catalogue = Catalogue.load(arguments.dataset / "models")
        truths, results = read_truth(arguments.dataset), read_results(arguments.csv)
    except Refused as refusal:
        print(refusal, file=sys.stderr)
        return 2
    scores = score(truths, results, catalogue)
    print(table(scores, right_sets(truths, results)))
    print(failures(scores, catalogue))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
