"""What the robot perceives of a suite's goal and start scenes: `python -m benchmarks.looks SUITE SEED... [--set ...]`.

Prints for each look how many hypotheses competed, the seconds of processor time, and what is wrong: objects that were
missed, found where they are not or turned otherwise, and what is said to be on or in something else than in truth. The
errors of the camera are none of perception's, and are taken out. Nothing moves: a seed takes seconds, an episode a
minute.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.suites import looks
from runner.graph.graph import Graph, load_graph
from stages.devices.suites import kinds
from stages.estimate import FiltersHere, Quiet, SceneEstimator
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages import Frame, SceneEstimate, SceneGraph, Snapshot
from stages.messages.scene import SceneObject
from stages.robots import BUILT_IN as FETCH
from stages.robots import Robot, read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.naming import unique_names
from stages.scene.relations import Tolerances, assertions, supports
from stages.scene.scoring import errors, label_of, matched
from stages.scene.stance import Stances, standing_of

ROOT = Path(__file__).parents[1]
NEAR = 0.02, np.deg2rad(15.0)
"""Metres and radians within which an object's pose is right."""
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


class Judge:
    """Compares what is perceived with the truth."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._stances = {label: Stances(item) for label, item in catalogue.objects.items()}

    def wrong(self, snapshot: Snapshot, seen: Snapshot, scene: SceneGraph) -> list[str]:
        """What is wrong with a scene; ``seen`` is the snapshot as a perception without errors has it."""
        found = errors(seen.names, seen.T_base_objects, scene.objects, self._catalogue)
        missed = [f"missed {each.name}" for each in found if not each.found]
        false = len(scene.objects) - (len(found) - len(missed))
        beside = [
            f"{each.name} {1000 * each.position:.0f} mm {np.rad2deg(each.rotation):.0f} deg"
            for each in found
            if each.found and not (each.position < NEAR[0] and each.rotation < NEAR[1])
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
    perception, judge = Perception(graph), Judge(Catalogue.shared(BUILT_IN))
    robot = read_robot(FETCH)
    print(HEADER)
    for seed, snapshot, frame in looks(options.suite, options.seeds):
        began = time.process_time()
        boxes, final, scene = perception(frame)
        seconds = time.process_time() - began
        assert frame.T_base_camera is not None
        wrong = judge.wrong(snapshot, as_seen(snapshot, frame.T_base_camera, robot), scene)
        name = f"{options.suite} {seed} {frame.name}"
        print(
            f"{name:<21}  {len(snapshot.names):>7}  {boxes:>5}  {len(final.log_weights):>10}  {seconds:>5.1f}  "
            f"{', '.join(wrong)}".rstrip(),
            flush=True,
        )


if __name__ == "__main__":
    main()
