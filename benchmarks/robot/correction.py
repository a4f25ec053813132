"""What seeing its own arm corrects: `python -m benchmarks.correction SUITE SEED... [--robot FILE]`.

Prints for each look at a seed's goal and start scene how far objects are perceived from where they are, without and
with the correction, and the same from where the hand goes when it is sent there: encoders may be off as well.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.robot.acting import carried_out
from benchmarks.robot.looks import ROOT, Perception
from runner.contract import Message
from runner.graph.reading import load_graph
from stages.camera import SimulatedCamera
from stages.corrector import Corrector, told
from stages.devices.suites import kinds
from stages.estimate import Quiet
from stages.executor import Executor
from stages.geometry.arrays import Floats
from stages.messages import (
    Arrangement,
    Arrived,
    Correction,
    Frame,
    LookRequest,
    PostureRequest,
    SceneGraph,
    Snapshot,
)
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.motion import restarts, solve_ik
from stages.robots import BUILT_IN as ROBOT
from stages.robots import Robot, read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.scoring import matched
from stages.world import World

_FROM_ABOVE = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
HEADER = """median (90 %), mm               in the base frame             beside the hand
look                 objects   as it is        corrected       as it is        corrected"""


@dataclass(frozen=True)
class Seen:
    """One look as the camera gives it, and as it is corrected."""

    snapshot: Snapshot
    as_it_is: Frame
    corrected: Frame


class Lab:
    """World, camera, executor and corrector without a runner between them."""

    def __init__(self, suite: str, seed: int, robot: Path = ROBOT, **settings: Any) -> None:
        self._ctx = Quiet(seed)
        self._world = World(World.Config(suite=suite, seed=seed, robot=robot))
        self._camera = SimulatedCamera(SimulatedCamera.Config(catalogue=BUILT_IN, robot=robot))
        self._executor = Executor(Executor.Config(robot=robot))
        self._corrector = Corrector(Corrector.Config(robot=robot, **settings))
        self.correction: Correction | None = None

    def look(self, kind: Any) -> Seen:
        """Lays a scene out and looks at it."""
        self._world.on_arrangement(Arrangement(kind=kind), self._ctx)
        pending: list[Message] = list(self._corrector.on_look_request(LookRequest(purpose=kind), self._ctx))
        while True:
            match pending.pop(0):
                case LookRequest() as request:
                    snapshot = self._world.on_look_request(request, self._ctx)
                    frame = self._camera.on_snapshot(snapshot, self._ctx)
                    answers = list(self._corrector.on_frame(frame, self._ctx))
                    if isinstance(answers[0], Frame):
                        return Seen(snapshot, frame, answers[0])
                    pending += answers
                case PostureRequest() as request:
                    pending += self._corrector.on_arrived(self._moved(request), self._ctx)
                case Correction() as correction:
                    self.correction = correction
                case other:
                    raise TypeError(type(other).__name__)

    def close(self) -> None:
        """Frees the renderer."""
        self._camera.close()

    def _moved(self, request: PostureRequest) -> Arrived:
        asked = self._executor.on_posture_request(request, self._ctx)
        arrived = carried_out(asked, self._executor, self._world, self._ctx)
        assert isinstance(arrived, Arrived)
        return arrived


class Hand:
    """Where the hand goes when it is sent to a place, encoders being off."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._world = robot, CollisionWorld(robot, robot.table, {})

    def offset(self, place: Floats, joints: Floats) -> Floats:
        """How far the hand, from above, comes beside ``place`` (3); ``joints`` are beyond what encoders say; metres."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = _FROM_ABOVE, place
        seeds = restarts(self._world, np.random.default_rng(0), self._robot.home, extra=20)
        q = solve_ik(self._world, T, seeds=seeds, free=False)
        if q is None:
            return np.full(3, np.nan)
        beyond = joints[[self._robot.joint_names.index(name) for name in self._robot.joints]]
        return self._world.hand(q + beyond)[:3, 3] - T[:3, 3]


def distances(
    snapshot: Snapshot, scene: SceneGraph, hand: Hand, catalogue: Catalogue
) -> tuple[list[float], list[float]]:
    """Millimetres between objects as perceived and as they are, and between them and the hand that is sent there."""
    assert snapshot.errors is not None
    in_base: list[float] = []
    beside: list[float] = []
    for k, item in matched(snapshot.names, snapshot.T_base_objects, scene.objects, catalogue).items():
        place = item.T_base_object[:3, 3]
        off = place - snapshot.T_base_objects[k][:3, 3]
        in_base.append(1e3 * float(np.linalg.norm(off)))
        beside.append(1e3 * float(np.linalg.norm(off + hand.offset(place, snapshot.errors.joints))))
    return in_base, beside


def spread(values: list[float]) -> str:
    """Median and 90th percentile."""
    known = np.array(values)[np.isfinite(values)]
    return f"{np.median(known):5.1f} ({np.percentile(known, 90):5.1f})" if len(known) else "-"


def looks(suite: str, seed: int, robot: Path) -> Iterator[tuple[str, Seen]]:
    """The first look at the goal and at the start scene."""
    lab = Lab(suite, seed, robot)
    for kind in ("goal", "start"):
        seen = lab.look(kind)
        if kind == "goal" and lab.correction is not None:
            seconds = lab.correction.robot_seconds
            print(f"{suite} {seed}: {told(lab.correction)}, {seconds:.0f} robot seconds", flush=True)
        yield kind, seen
    lab.close()


def main() -> None:
    """Prints a line for each look, and the whole."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=kinds.NAMES)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--robot", type=Path, default=ROBOT)
    options = parser.parse_args()
    perception, catalogue = Perception(load_graph(ROOT / "graph.yaml", ())), Catalogue.shared(BUILT_IN)
    hand = Hand(read_robot(options.robot))
    whole: list[list[float]] = [[], [], [], []]
    print(HEADER)
    for seed in options.seeds:
        for kind, seen in looks(options.suite, seed, options.robot):
            before, after = (
                distances(seen.snapshot, perception(frame)[2], hand, catalogue)
                for frame in (seen.as_it_is, seen.corrected)
            )
            columns = [before[0], after[0], before[1], after[1]]
            _say(f"{options.suite} {seed} {kind}", len(seen.snapshot.names), columns)
            whole = [[*values, *more] for values, more in zip(whole, columns, strict=True)]
    _say("all", len(whole[0]), whole)


def _say(name: str, objects: int, columns: list[list[float]]) -> None:
    print(f"{name:<21}  {objects:>7}   " + "   ".join(spread(values) for values in columns), flush=True)


if __name__ == "__main__":
    main()
