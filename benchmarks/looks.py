"""What the robot perceives of a suite's goal and start scenes: `python -m benchmarks.looks SUITE SEED... [--set ...]`.

Prints for each look how many hypotheses competed, which objects were missed and which were found that are not there,
and the seconds of processor time. Nothing moves: a seed takes seconds, an episode a minute.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.suites import looks
from runner.graph.graph import Graph, load_graph
from stages.devices.suites import kinds
from stages.estimate import FiltersHere, Quiet, SceneEstimator
from stages.messages import Frame, SceneEstimate, SceneGraph, Snapshot
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.scoring import errors

ROOT = Path(__file__).parents[1]
NEAR = 0.04, np.deg2rad(15.0)
"""Metres and radians within which an object is found; the camera is up to 3 cm off, and always by the same."""
HEADER = "look                   objects  boxes  hypotheses  CPU s  missed, false"


class Perception:
    """A graph's perception in one process."""

    def __init__(self, graph: Graph) -> None:
        made: dict[str, Any] = {
            name: graph.nodes[name].construct()
            for name in ("detector", "hypotheses", "particle_filter", "ranker", "refiner", "scene_graph")
        }
        self._detector, self._scene_graph = made["detector"], made["scene_graph"]
        self._estimator = SceneEstimator(
            made["hypotheses"], FiltersHere(made["particle_filter"]), made["ranker"], made["refiner"]
        )

    def __call__(self, frame: Frame) -> tuple[int, SceneEstimate, SceneGraph]:
        """Number of boxes, the scene, and what is asserted of it."""
        candidates = self._detector.on_frame(frame, Quiet())
        *_, final = self._estimator.messages(frame, candidates, Quiet())
        assert isinstance(final, SceneEstimate)
        return len(candidates.candidates), final, self._scene_graph.on_scene_estimate(final)


def compared(snapshot: Snapshot, scene: SceneGraph, catalogue: Catalogue) -> tuple[list[str], list[str]]:
    """Names of the objects that were missed, and of those that are not there; what stands elsewhere is both."""
    found = errors(snapshot.names, snapshot.T_base_objects, scene.objects, catalogue)
    missed = [each.name for each in found if not (each.position < NEAR[0] and each.rotation < NEAR[1])]
    more = len(scene.objects) - (len(found) - len(missed))
    return missed, [f"{more} false"] if more else []


def main() -> None:
    """Prints a line for each look."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=kinds.NAMES)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE")
    options = parser.parse_args()
    perception, catalogue = (
        Perception(load_graph(ROOT / "graph.yaml", tuple(options.set))),
        Catalogue.shared(BUILT_IN),
    )
    print(HEADER)
    for seed, snapshot, frame in looks(options.suite, options.seeds):
        began = time.process_time()
        boxes, final, scene = perception(frame)
        seconds = time.process_time() - began
        missed, false = compared(snapshot, scene, catalogue)
        name = f"{options.suite} {seed} {frame.name}"
        print(
            f"{name:<21}  {len(snapshot.names):>7}  {boxes:>5}  {len(final.log_weights):>10}  {seconds:>5.1f}  "
            f"{', '.join([*missed, *false])}".rstrip(),
            flush=True,
        )


if __name__ == "__main__":
    main()
