"""Runs a baseline over a data set: `python -m benchmarks.baselines METHOD DATASET exact|noisy|FILE OUT.csv`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, detections_file, images, parse_ids
from benchmarks.comparison.accuracy import failures, right_sets, score, table
from benchmarks.comparison.baselines import METHODS
from stages.devices.bop_results import HEADER, Result
from stages.scene.catalogue import Catalogue


@command
def main() -> int:
    """Estimates, writes, prints the table."""
    return _run(_options())


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("method", choices=sorted(METHODS))
    parser.add_argument("dataset", type=Path, help="BOP data set folder")
    parser.add_argument("detections", help="exact, noisy or a file of detections")
    parser.add_argument("out", type=Path, help="BOP results, CSV")
    parser.add_argument("--dof", type=int, choices=(3, 4, 6), default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--images", default=None, help="the first N, or ids such as 1/0,2/0")
    return parser.parse_args()


def _run(options: argparse.Namespace) -> int:
    text = options.images
    wanted = int(text) if text and text.isdecimal() else parse_ids(text) if text else None
    chosen = list(images(options.dataset, detections_file(options.dataset, options.detections), wanted))
    catalogue = Catalogue.load(options.dataset / "models")
    found = list(_estimated(chosen, catalogue, options))
    with options.out.open("w") as file:
        file.writelines(f"{line}\n" for line in (HEADER, *(result.line() for result in found)))
    truths = [truth for image in chosen for truth in image.truths]
    scores = score(truths, found, catalogue)
    print(table(scores, right_sets(truths, found)))
    print(failures(scores, catalogue))
    return 0


def _estimated(chosen: list[Image], catalogue: Catalogue, options: argparse.Namespace) -> Iterator[Result]:
    estimate = METHODS[options.method]
    used = {box.label for image in chosen for box in image.boxes}
    estimate.prepare(Catalogue({name: item for name, item in catalogue.objects.items() if name in used}))
    if chosen:
        # Compiles, so that the first image waits for nothing.
        estimate(chosen[0], catalogue, dof=options.dof, seed=options.seed)
    for image in chosen:
        began, cpu = time.perf_counter(), time.process_time()
        objects = estimate(image, catalogue, dof=options.dof, seed=options.seed)
        seconds = time.perf_counter() - began
        print(f"{image.frame.name}: {seconds:.2f} s, {time.process_time() - cpu:.2f} s of CPU", flush=True)
        for label, T_camera_object, value in objects:
            yield Result(*image.id, catalogue[label].label, value, T_camera_object, seconds)


if __name__ == "__main__":
    raise SystemExit(main())
