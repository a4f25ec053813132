"""What sharing, dropping and the first look save in the search over hypotheses: `python -m benchmarks.search`."""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, detections_file, images
from runner.process.children import ENVIRONMENT
from stages.perception.filter.likelihood import ObservedScene
from stages.perception.filter.particle_filter import Track
from stages.perception.filter.settings import FilterSettings
from stages.perception.hypotheses.combinations import cheapest, ordered
from stages.perception.hypotheses.composition import FirstLook
from stages.perception.hypotheses.scene_filter import SceneFilter, SceneResult, Suspect
from stages.perception.observation.preprocessing import preprocess
from stages.scene.catalogue import Catalogue

Way = Literal["apart", "shared", "shared, dropped", "first look"]
WAYS: dict[Way, str] = {
    "apart": "every hypothesis from nothing",
    "shared": "looks at candidates shared",
    "shared, dropped": "and hypotheses dropped by their bound",
    "first look": "and only the cheapest at first look estimated",
}
_MAX_HEIGHT = 0.6
"""The setting of the hypotheses stage."""


@dataclass(frozen=True)
class Search:
    """How one image is searched."""

    dataset: Path
    image: Image
    n_objects: int
    way: Way
    finalists: int


@dataclass(frozen=True)
class Outcome:
    """What the search of one image took."""

    winner: tuple[int, ...]
    poses: bytes
    """Of the winner's objects."""
    estimated: int
    dropped: int
    left_out: int
    runs: int
    visits: int
    cpu_seconds: float
    megabytes: float
    """Peak of the process."""


def search(task: Search) -> Outcome:
    """Searches one image on one core; what is measured begins with the observation."""
    catalogue = Catalogue.load(task.dataset / "models")
    scenes = SceneFilter(catalogue, FilterSettings(), memory=0 if task.way == "apart" else 256)
    scenes.warm_up()
    seen = preprocess(task.image.frame, task.image.boxes, np.random.default_rng(0), max_height=_MAX_HEIGHT)
    scene = ObservedScene.of(seen.depth, seen.foreground, seen.K, seen.T_camera_table)
    suspects = [Suspect(candidate.label, candidate.box) for candidate in task.image.boxes]
    began = time.process_time()
    combinations, results = _search(task, scenes, scene, suspects)
    seconds = time.process_time() - began
    winner = min(range(len(results)), key=lambda i: (results[i].cost, combinations[i]))
    return Outcome(
        combinations[winner],
        b"".join(found.track.T_camera_object.tobytes() for found in results[winner].objects),
        estimated=sum(not result.dropped for result in results),
        dropped=sum(result.dropped for result in results),
        left_out=len(list(itertools.combinations(suspects, task.n_objects))) - len(results),
        runs=scenes.runs,
        visits=scenes.visits,
        cpu_seconds=seconds,
        megabytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    )


def _search(
    task: Search, scenes: SceneFilter, scene: ObservedScene, suspects: list[Suspect]
) -> tuple[list[tuple[int, ...]], list[SceneResult]]:
    """The combinations that are estimated, and their scenes."""
    m = len(suspects)

    def look(i: int) -> Track:
        return scenes.look(scene, suspects[i], among=m)

    def estimate(chosen: tuple[int, ...], reached: float = np.inf) -> SceneResult:
        return scenes.estimate(scene, [suspects[i] for i in chosen], [look(i) for i in chosen], reached=reached)

    everything = list(itertools.combinations(range(m), task.n_objects))
    if task.way in ("apart", "shared"):
        return everything, [estimate(chosen) for chosen in everything]
    glimpses = [scenes.glimpse(scene, suspects[i], look(i)) for i in range(m)]
    first = FirstLook(glimpses)
    kept = task.finalists if task.way == "first look" else len(everything)
    combinations = cheapest(first.cost, m, task.n_objects, kept)
    best = combinations[0]
    reached = scenes.begun_cost(scene, [suspects[i] for i in best], [look(i).T_camera_object for i in best])
    return combinations, [estimate(chosen, reached) for chosen in combinations]


def outcome(task: Search) -> Outcome:
    """The same in a process of its own, so that its peak of memory is its own."""
    os.environ |= dict(ENVIRONMENT)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(search, task).result()


def chosen_images(dataset: Path, m: int, limit: int) -> list[Image]:
    """Images with at least m candidates in the noisy boxes, cut down to the m most confident."""
    found = (image for image in images(dataset, detections_file(dataset, "noisy")) if len(image.boxes) >= m)
    return [_cut(image, m) for image in itertools.islice(found, limit)]


def _cut(image: Image, m: int) -> Image:
    boxes = tuple(ordered(image.boxes)[:m])
    return replace(image, candidates=msgspec.structs.replace(image.candidates, candidates=boxes))


HEADER = (
    f"{'image':<16}{'way':<17}{'hypotheses':>10}{'dropped':>9}{'left out':>9}{'filters':>9}{'visits':>8}"
    f"{'CPU s':>8}{'ratio':>7}{'MB':>6}  winner"
)


def line(image: Image, way: Way, one: Outcome, plain: Outcome) -> str:
    """One row of the table."""
    same = "the same bytes" if (one.winner, one.poses) == (plain.winner, plain.poses) else "ANOTHER"
    return (
        f"{image.frame.name:<16}{way:<17}{one.estimated:>10}{one.dropped:>9}{one.left_out:>9}{one.runs:>9}{one.visits:>8}"
        f"{one.cpu_seconds:>8.1f}{one.cpu_seconds / plain.cpu_seconds:>7.2f}{one.megabytes:>6.0f}  {same}"
    )


@command
def main() -> int:
    """Prints the table; exits 1 where a way finds another winner."""
    options = _options()
    chosen = chosen_images(options.dataset, options.candidates, options.images)
    if not chosen:
        print(f"{options.dataset}: no image has {options.candidates} candidates", file=sys.stderr)
        return 2
    print(HEADER)
    return int(not all(_compared(options, image) for image in chosen))


def _compared(options: argparse.Namespace, image: Image) -> bool:
    """Prints the rows of one image; whether all ways agree."""
    plain: Outcome | None = None
    for way in WAYS:
        task = Search(options.dataset, image, options.objects, way, options.finalists)
        one = outcome(task)
        plain = plain or one
        print(line(image, way, one, plain), flush=True)
        if (one.winner, one.poses) != (plain.winner, plain.poses):
            return False
    return True


def _options() -> argparse.Namespace:
    ways = "; ".join(f"'{way}': {what}" for way, what in WAYS.items())
    parser = argparse.ArgumentParser(description=f"{__doc__} Ways: {ways}.")
    parser.add_argument("dataset", type=Path, help="BOP data set folder with noisy detections")
    parser.add_argument("--candidates", type=int, default=8, help="m: the most confident of each image")
    parser.add_argument("--objects", type=int, default=5, help="N_c")
    parser.add_argument("--finalists", type=int, default=8, help="hypotheses that the first look lets pass")
    parser.add_argument("--images", type=int, default=2)
    return parser.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())
