"""What the robot perceives of a suite's goal and start scenes: `python -m benchmarks.looks SUITE SEED... [--set ...]`.

Prints for each look how many hypotheses competed, the seconds of processor time, and what is wrong: objects that were
missed, found where they are not or turned otherwise, and what is said to be on or in something else than in truth. The
errors of the camera are none of perception's, and are taken out. Nothing moves: a seed takes seconds, an episode a
minute. Then, by the share of an object that the camera sees, how many were right, stand elsewhere or turned, and were
missed; and how many objects were found that there are not.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.robot.suites import looks
from runner.graph.graph import Graph
from runner.graph.reading import load_graph
from stages.devices.suites import kinds
from stages.estimate import FiltersHere, Quiet, SceneEstimator
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages import Frame, SceneEstimate, SceneGraph, Snapshot
from stages.messages.scene import SceneObject
from stages.perception.filter.likelihood import Shape
from stages.perception.rendering.rasteriser import View, inverse_depth
from stages.robots import BUILT_IN as FETCH
from stages.robots import Robot, read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.naming import unique_names
from stages.scene.relations import Tolerances, assertions, supports
from stages.scene.scoring import ObjectError, errors, label_of, matched
from stages.scene.stance import Stances, standing_of

ROOT = Path(__file__).parents[2]
NEAR = 0.02, np.deg2rad(15.0)
"""Metres and radians within which an object's pose is right."""
SHARES = (0.5, 0.25, 0.1, 0.0)
"""Lower ends of the visible shares that are told apart."""
OUTCOMES = ("right", "elsewhere or turned", "missed")
_TRIANGLES = 500
HEADER = "look                   objects  boxes  hypotheses  CPU s  wrong"


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


def as_seen(snapshot: Snapshot, T_base_camera: Floats, robot: Robot) -> Snapshot:
    """The truth as a perception without errors has it of a camera that is said to be at ``T_base_camera``."""
    errors = snapshot.errors
    if errors is None:
        return snapshot
    T_base_color = robot.camera_pose(snapshot.joint_names, snapshot.joint_positions + errors.joints)
    T_camera_objects = inverse(T_base_color @ errors.T_believed_true @ errors.T_color_depth) @ snapshot.T_base_objects
    T_camera_objects[:, :3, 3] *= errors.depth
    return msgspec.structs.replace(snapshot, T_base_objects=T_base_camera @ T_camera_objects)


def visible_shares(seen: Snapshot, frame: Frame, catalogue: Catalogue) -> list[float]:
    """Of each object the share of its silhouette that no other object hides."""
    assert frame.T_base_camera is not None
    view = View.of(frame.K, frame.depth.shape[1], frame.depth.shape[0])
    shapes = [Shape.of(catalogue[label_of(name, catalogue)].simplified(_TRIANGLES)) for name in seen.names]
    T_camera_objects = inverse(frame.T_base_camera) @ seen.T_base_objects
    layers = [inverse_depth(one.soup, T, view) for one, T in zip(shapes, T_camera_objects, strict=True)]
    nearest = np.maximum.reduce(layers)
    return [float(((layer > 0) & (layer == nearest)).sum() / max(1, (layer > 0).sum())) for layer in layers]


class Tally:
    """What became of objects, by how much of them shows."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[float, str]] = Counter()
        self._false = 0

    def add(self, found: Sequence[ObjectError], shares: Sequence[float], perceived: int) -> None:
        """The objects of one look, of which ``perceived`` are said to be there."""
        for each, share in zip(found, shares, strict=True):
            outcome = OUTCOMES[0] if is_right(each) else OUTCOMES[1 if each.found else 2]
            self._counts[next(least for least in SHARES if share >= least), outcome] += 1
        self._false += perceived - sum(each.found for each in found)

    def lines(self) -> list[str]:
        """A table."""
        rows = [f"of which shows >= {least:<4.0%} " + self._row(least) for least in SHARES]
        return [*rows, f"{self._false} false"]

    def _row(self, least: float) -> str:
        return ", ".join(f"{self._counts[least, outcome]} {outcome}" for outcome in OUTCOMES)


def is_right(found: ObjectError) -> bool:
    """Whether an object was perceived, and where it is."""
    return found.found and found.position < NEAR[0] and found.rotation < NEAR[1]


class Judge:
    """Compares what is perceived with the truth."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._stances = {label: Stances(item) for label, item in catalogue.objects.items()}

    def found(self, seen: Snapshot, scene: SceneGraph) -> tuple[ObjectError, ...]:
        """How far each object is off; ``seen`` is the snapshot as a perception without errors has it."""
        return errors(seen.names, seen.T_base_objects, scene.objects, self._catalogue)

    def wrong(self, snapshot: Snapshot, seen: Snapshot, scene: SceneGraph) -> list[str]:
        """What is wrong with a scene."""
        found = self.found(seen, scene)
        missed = [f"missed {each.name}" for each in found if not each.found]
        false = len(scene.objects) - (len(found) - len(missed))
        beside = [
            f"{each.name} {1000 * each.position:.0f} mm {np.rad2deg(each.rotation):.0f} deg"
            for each in found
            if each.found and not is_right(each)
        ]
        return [*missed, *([f"{false} false"] if false else []), *beside, *self._relations(snapshot, seen, scene)]

    def _relations(self, snapshot: Snapshot, seen: Snapshot, scene: SceneGraph) -> list[str]:
        """What is on or in another object, of the objects that were found, and is not said to be."""
        assert snapshot.T_base_table is not None
        matches = matched(seen.names, seen.T_base_objects, scene.objects, self._catalogue)
        labels = [label_of(name, self._catalogue) for name in snapshot.names]
        kept = [matches[k].name if k in matches else None for k in range(len(labels))]
        objects = [
            SceneObject(name=name, label=label, T_base_object=T)
            for name, label, T in zip(unique_names(labels, kept), labels, snapshot.T_base_objects, strict=True)
        ]
        true = assertions(supports(standing_of(objects, self._stances, snapshot.T_base_table), Tolerances()))
        return [
            f"not {item}"
            for item in true
            if item.predicate in ("on", "in") and item.arguments[0] in kept and item not in scene.assertions
        ]


def main() -> None:
    """Prints a line for each look."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=kinds.NAMES)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE")
    options = parser.parse_args()
    graph = load_graph(ROOT / "graph.yaml", tuple(options.set))
    catalogue = Catalogue.shared(BUILT_IN)
    perception, judge, tally = Perception(graph), Judge(catalogue), Tally()
    robot = read_robot(FETCH)
    print(HEADER)
    for seed, snapshot, frame in looks(options.suite, options.seeds):
        began = time.process_time()
        boxes, final, scene = perception(frame)
        seconds = time.process_time() - began
        assert frame.T_base_camera is not None
        seen = as_seen(snapshot, frame.T_base_camera, robot)
        wrong = judge.wrong(snapshot, seen, scene)
        tally.add(judge.found(seen, scene), visible_shares(seen, frame, catalogue), len(scene.objects))
        name = f"{options.suite} {seed} {frame.name}"
        print(
            f"{name:<21}  {len(snapshot.names):>7}  {boxes:>5}  {len(final.log_weights):>10}  {seconds:>5.1f}  "
            f"{', '.join(wrong)}".rstrip(),
            flush=True,
        )
    print(*tally.lines(), sep="\n")


if __name__ == "__main__":
    main()
