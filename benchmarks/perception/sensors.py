"""Whether settings that some sensors chose suit another: `python -m benchmarks.sensors DATASET [DATASET ...]`.

Every image is filtered once, with exact boxes, and its ranked scene refined with each of several settings of how the
photograph is read. For each sensor the settings that do best on the images of all others are judged on its own.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.common.command import command
from benchmarks.common.datasets import detections_file, images
from benchmarks.comparison.accuracy import Score, score
from benchmarks.comparison.estimate import Settings, estimates
from benchmarks.perception.candidates import sensor_of
from benchmarks.perception.flips import refined
from stages.devices.bop import read_dataset
from stages.messages import Observation, SceneEstimate
from stages.perception.refinement.colour import ColourSettings
from stages.perception.refinement.refinement import RefinementSettings, SceneRefiner
from stages.scene.catalogue import Catalogue

READINGS = (ColourSettings(), *(
    ColourSettings(nats=nats, alike=alike, reach=np.deg2rad(reach))
    for nats, alike, reach in product((15.0, 60.0), (20.0, 80.0), (0.4, 1.6))
))  # fmt: skip
"""The default, and the corners of a box around it: half and twice of each."""
Scores = dict[str, list[list[Score]]]
"""By sensor, for each of the settings."""


def judged(datasets: Sequence[Path]) -> Scores:
    """The scores of all images with each of the settings."""
    found: Scores = defaultdict(lambda: [[] for _ in READINGS])
    for dataset in datasets:
        catalogue = Catalogue.load(dataset / "models")
        refiners = [SceneRefiner(catalogue, RefinementSettings(reading=reading)) for reading in READINGS]
        sensors = {(image.scene_id, image.image_id): sensor_of(image) for image in read_dataset(dataset)}
        chosen = list(images(dataset, detections_file(dataset, "exact")))
        for image, estimate in zip(chosen, estimates(dataset, chosen, Settings()), strict=True):
            observation = next(m for m in estimate.messages if isinstance(m, Observation))
            ranked = next(m for m in estimate.messages if isinstance(m, SceneEstimate))
            for scores, refiner in zip(found[sensors[image.id]], refiners, strict=True):
                scores.extend(score(image.truths, refined(refiner, observation, ranked, catalogue), catalogue))
    return found


def right(scores: Sequence[Score]) -> int:
    """Objects within 2 cm and 15 degrees, and labels that face as they should."""
    return sum(one.within(0.02, 15) for one in scores) + sum(one.label_right for one in scores if one.truth.label_known)


def table(found: Scores) -> str:
    """A row for each sensor, in Markdown."""
    lines = [
        "| sensor | objects right | with settings of the others | labels right | with settings of the others |",
        "|---|---|---|---|---|",
    ]
    for sensor, scores in found.items():
        others = [sum(right(other[k]) for name, other in found.items() if name != sensor) for k in range(len(READINGS))]
        chosen = scores[int(np.argmax(others))]
        cells = [sensor, *map(_poses, (scores[0], chosen)), *map(_labels, (scores[0], chosen))]
        lines.append(f"| {' | '.join(cells)} |")
    totals = [sum(right(scores[k]) for scores in found.values()) for k in range(len(READINGS))]
    return "\n".join([*lines, "", *(f"{total}: {reading}" for total, reading in zip(totals, READINGS, strict=True))])


def _poses(scores: Sequence[Score]) -> str:
    return f"{sum(one.within(0.02, 15) for one in scores)} of {len(scores)}"


def _labels(scores: Sequence[Score]) -> str:
    known = [one.label_right for one in scores if one.truth.label_known]
    return f"{sum(known)} of {len(known)}"


@command
def main() -> int:
    """Prints the table, and how much is right with each of the settings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", type=Path, nargs="+", help="BOP data set folders")
    print(table(judged(parser.parse_args().datasets)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
