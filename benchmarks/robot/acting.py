"""Planning and acting alone: `python -m benchmarks.acting [--suite NAME] 0 1 2 ... [--millimetres 2] [--verbose]`.

Every look is the simulator's truth with a little noise instead of an estimate, so an episode takes seconds, and what
fails is the planner's, the demonstrator's or the executor's doing. Judged by the truth, as `benchmarks.episodes`.
"""

from __future__ import annotations

import argparse
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.robot.suites import world_config
from runner import contract
from runner.contract import Level, Message
from stages.demonstrator import Demonstrator
from stages.devices.suites import kinds
from stages.executor import Executor
from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, pose
from stages.messages import (
    Arrangement,
    Arrived,
    Goal,
    LookRequest,
    Observation,
    Outcome,
    Plan,
    Recover,
    RobotCommand,
    SceneEstimate,
    SceneGraph,
    Snapshot,
    Task,
    TransferRequest,
    Verdict,
)
from stages.messages.digest import ObjectPose
from stages.planner import Planner
from stages.robots import BUILT_IN as ROBOT
from stages.robots import read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.scoring import label_of
from stages.scene.truth import Judgement, Truth
from stages.scene_graph import SceneGraphBuilder
from stages.world import World

_K = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])


@dataclass
class Context:
    """What stages log and draw from."""

    rng: np.random.Generator
    verbose: bool
    time_ns: int = 0
    directory: Path = Path()

    def log(self, text: str, *, level: Level = "info") -> None:
        """Prints it where asked to."""
        if self.verbose:
            print(f"   {text}", flush=True)


@dataclass
class Episode:
    """What happened."""

    snapshots: list[Snapshot] = field(default_factory=list[Snapshot])
    outcomes: list[Outcome] = field(default_factory=list[Outcome])
    plans: list[Plan] = field(default_factory=list[Plan])
    planning: list[float] = field(default_factory=list[float])
    """Seconds of each plan."""
    tasks: list[Task] = field(default_factory=list[Task])
    goal: Goal | None = None
    verdict: Verdict | None = None

    def judged(self) -> Judgement:
        """By the truth."""
        assert self.verdict is not None
        began = self.tasks[0].current if self.tasks else None
        return Truth(Catalogue.shared(BUILT_IN)).judge(self.snapshots, self.goal, self.verdict, self.outcomes, began)


class Robot:
    """The stages of the main job without perception and without a runner between them."""

    def __init__(self, suite: str, seed: int, *, metres: float, verbose: bool) -> None:
        self._ctx = Context(np.random.default_rng(seed), verbose)
        self._metres = metres
        self._catalogue, self._robot = Catalogue.shared(BUILT_IN), read_robot(ROBOT)
        self._world = World(world_config(suite, seed))
        self._builder = SceneGraphBuilder(SceneGraphBuilder.Config(catalogue=BUILT_IN))
        self._planner = Planner(Planner.Config(catalogue=BUILT_IN))
        self._executor = Executor(Executor.Config())
        self._demonstrator = Demonstrator(Demonstrator.Config(catalogue=BUILT_IN))
        self.episode = Episode()

    def run(self) -> Episode:
        """One episode, to its verdict."""
        pending: deque[Any] = deque([self._demonstrator.on_start(self._ctx)])
        while pending:
            answer = self._handle(pending.popleft())
            pending.extend(_messages(answer))
        return self.episode

    def _handle(self, message: Message) -> Any:
        ctx, episode = self._ctx, self.episode
        match message:
            case Arrangement():
                return self._demonstrator.on_robot_state(self._world.on_arrangement(message, ctx), ctx)
            case LookRequest():
                return self._demonstrator.on_scene_graph(self._look(message), _NO_OBSERVATION, ctx)
            case Task():
                episode.tasks.append(message)
                begun = time.perf_counter()
                plan = self._planner.on_task(message, ctx)
                episode.planning.append(time.perf_counter() - begun)
                episode.plans.append(plan)
                return self._demonstrator.on_plan(plan, ctx)
            case TransferRequest():
                outcome = self._carry_out(self._executor.on_transfer_request(message, ctx))
                return self._demonstrator.on_outcome(outcome, ctx)
            case Recover():
                return self._demonstrator.on_outcome(self._carry_out(self._executor.on_recover(message, ctx)), ctx)
            case Goal():
                episode.goal = message
            case Verdict():
                episode.verdict = message
            case _:
                raise TypeError(type(message).__name__)
        return None

    def _look(self, request: LookRequest) -> SceneGraph:
        snapshot = self._world.on_look_request(request, self._ctx)
        self.episode.snapshots.append(snapshot)
        assert snapshot.T_base_table is not None and snapshot.table_size is not None
        T_base_camera = inverse(self._robot.T_camera_base)
        half = snapshot.table_size / 2
        objects = tuple(
            ObjectPose(
                name=name,
                label=label_of(name, self._catalogue),
                T_camera_object=inverse(T_base_camera) @ self._perceived(T),
                confidence=1.0,
                cost=0.0,
                box=np.zeros(4),
            )
            for name, T in zip(snapshot.names, snapshot.T_base_objects, strict=True)
            if T[2, 3] > snapshot.T_base_table[2, 3]
        )
        return self._builder.on_scene_estimate(
            SceneEstimate(
                objects=objects,
                winner=0,
                log_weights=np.zeros(1),
                left_out=0,
                T_camera_table=inverse(T_base_camera) @ snapshot.T_base_table,
                T_base_camera=T_base_camera,
                K=_K,
                support=regions.rectangle((-half).tolist(), half.tolist()),
            )
        )

    def _perceived(self, T: Floats) -> Floats:
        rng = self._ctx.rng
        turn = Rotation.from_rotvec(rng.normal(0, np.deg2rad(1.0), 3)).as_matrix()
        return pose(turn @ T[:3, :3], T[:3, 3] + rng.normal(0, self._metres, 3))

    def _carry_out(self, answer: RobotCommand | Outcome | Arrived | None) -> Outcome:
        outcome = carried_out(answer, self._executor, self._world, self._ctx)
        assert isinstance(outcome, Outcome)
        self.episode.outcomes.append(outcome)
        return outcome


def carried_out(
    answer: RobotCommand | Outcome | Arrived | None, executor: Executor, world: World, ctx: contract.Context
) -> Outcome | Arrived | None:
    """What comes of an executor's motion when the world moves as it says."""
    while isinstance(answer, RobotCommand):
        state = next(each for each in world.on_robot_command(answer, ctx) if each is not None)
        answer = executor.on_robot_state(state, ctx)
    return answer


_NO_OBSERVATION = Observation(
    depth=np.zeros((1, 1), np.float32),
    rgb=np.zeros((1, 1, 3), np.uint8),
    foreground=np.zeros((1, 1), np.bool_),
    K=_K,
    T_camera_table=np.eye(4),
    T_base_camera=None,
)
"""Shows nothing, so that nothing is remembered either: every look says where everything is."""


def _messages(answer: Any) -> Iterator[Message]:
    if isinstance(answer, Message):
        yield answer
    elif answer is not None:
        yield from answer


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a line for each seed as it ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--suite", choices=kinds.NAMES, default="tray", help="kind of scenes")
    parser.add_argument("--millimetres", type=float, default=2.0, help="standard deviation of perceived positions")
    parser.add_argument("--verbose", action="store_true", help="also what the stages log")
    options = parser.parse_args(arguments)
    for seed in options.seeds:
        begun = time.monotonic()
        episode = Robot(options.suite, seed, metres=options.millimetres / 1000, verbose=options.verbose).run()
        judged, verdict = episode.judged(), episode.verdict
        assert verdict is not None
        word = "FALSE SUCCESS" if judged.false_success else "restored" if judged.restored else "failed"
        done = f"{sum(one.success for one in episode.outcomes)} of {len(episode.outcomes)} transfers"
        seconds = f"plan {max(episode.planning, default=0):.1f} s, {time.monotonic() - begun:.0f} s"
        robot = f"robot {sum(one.robot_seconds for one in episode.outcomes):.0f} s"
        why = "" if verdict.success else f"; {verdict.failed_stage}: {verdict.reason}"
        lost = "".join(f"; LOST: {loss}" for loss in judged.losses)
        print(f"{options.suite} {seed}: {word}, {done}, {robot}, {seconds}{why}{lost}", flush=True)


if __name__ == "__main__":
    main()
