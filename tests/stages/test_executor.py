"""The executor and the simulated world, played against each other."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from runner.contract import Level, Refused
from stages.devices.suites import tray
from stages.executor import Executor
from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3
from stages.messages import Arrangement, LookRequest, Outcome, RobotCommand, SceneGraph, Transfer, TransferRequest
from stages.messages.scene import SceneObject
from stages.robots import BUILT_IN, read_robot
from stages.world import World
from tests.stages.planning.scenes import CATALOGUE_FILE, ROBOT, standing


@dataclass
class StepContext:
    rng: np.random.Generator
    time_ns: int = 0
    directory: Path = Path()
    lines: list[str] = field(default_factory=list[str])

    def log(self, text: str, *, level: Level = "info") -> None:
        self.lines.append(text)


class Bench:
    """World and executor without a runner between them."""

    def __init__(self, seed: int, goal: str, robot: Path = BUILT_IN) -> None:
        self.ctx, self.robot = StepContext(np.random.default_rng(seed)), read_robot(robot)
        self.world = World(World.Config(catalogue=CATALOGUE_FILE, robot=robot, seed=seed, goal=goal))
        self.executor = Executor(Executor.Config(catalogue=CATALOGUE_FILE, robot=robot, attempts=2))
        self.world.on_arrangement(Arrangement(kind="start"), self.ctx)

    def poses(self) -> dict[str, Floats]:
        snapshot = self.world.on_look_request(LookRequest(purpose="test"))
        return dict(zip(snapshot.names, snapshot.T_base_objects, strict=True))

    def transfer(self, poses: dict[str, Floats], name: str, destination: str, target: Floats) -> Outcome:
        transfer = Transfer(
            object=name, source="table", destination=destination, T_base_targets=target[None], pick="", place=""
        )
        request = TransferRequest(transfer=transfer, scene=graph(poses, self.robot.table.height), number=1)
        answer = self.executor.on_transfer_request(request, self.ctx)
        while isinstance(answer, RobotCommand):
            following = self.executor.on_robot_state(self.world.on_robot_command(answer), self.ctx)
            assert following is not None
            answer = following
        return answer

    def is_home(self) -> bool:
        state = self.world.on_robot_command(RobotCommand(times=np.zeros(0), positions=NONE, velocities=NONE))
        where = dict(zip(state.joint_names, state.positions, strict=True))
        is_open = state.gripper_width > 0.9 * self.robot.gripper.open_width
        return is_open and all(abs(where[n] - p) < 0.02 for n, p in self.robot.posture.items())


NONE = np.zeros((0, 8))
OTHERS = [
    BUILT_IN.with_name("ur5e.yaml"),
    BUILT_IN.with_name("panda.yaml"),
    Path(__file__).parent / "robots" / "arm.yaml",
]
"""Two that come with the package, and one that is a URDF."""


def graph(poses: dict[str, Floats], height: float) -> SceneGraph:
    T_base_table = np.eye(4)
    T_base_table[2, 3] = height
    return SceneGraph(
        objects=tuple(SceneObject(name=name, label=name, T_base_object=T) for name, T in poses.items()),
        virtual_objects=(),
        assertions=(),
        T_base_table=T_base_table,
        T_base_camera=None,
        K=np.eye(3),
    )


def misperceived(T: Floats, rng: np.random.Generator) -> Floats:
    """A pose with the errors that perception makes: about 3 mm and 2 degrees."""
    result = T.copy()
    result[:3, :3] = exp_so3(np.deg2rad(1.2) * rng.normal(size=3)) @ T[:3, :3]
    result[:3, 3] += 0.002 * rng.normal(size=3)
    return result


@pytest.mark.slow
def test_places_in_the_tray_and_stacks_despite_errors_of_perception() -> None:
    bench, rng = Bench(0, "tea"), np.random.default_rng(1)
    goal = tray.sample_goal("tea", bench.world._catalogue, ROBOT, rng)  # pyright: ignore[reportPrivateUsage]
    for name, destination in (("tea_box", "tray"), ("soup_can", "tea_box")):
        before = bench.poses()
        perceived = {key: misperceived(T, rng) for key, T in before.items()}
        T_destination_object = np.linalg.inv(goal[destination]) @ goal[name]
        outcome = bench.transfer(perceived, name, destination, perceived[destination] @ T_destination_object)
        assert outcome.success, outcome.reason
        assert outcome.robot_seconds > 5
        wanted, after = before[destination] @ T_destination_object, bench.poses()
        assert np.linalg.norm(after[name][:3, 3] - wanted[:3, 3]) < 0.02
        assert after[name][2, 2] > 0.99
        assert outcome.T_base_object is not None
        assert np.linalg.norm(outcome.T_base_object[:3, 3] - after[name][:3, 3]) < 0.01
        others = set(after) - {name}
        assert all(np.linalg.norm(after[o][:3, 3] - before[o][:3, 3]) < 0.01 for o in others)
        assert bench.is_home()
    assert any("grasped" in line for line in bench.ctx.lines)


@pytest.mark.parametrize("robot", OTHERS, ids=lambda robot: robot.stem)
def test_other_robots_pick_and_place_by_their_descriptions_alone(robot: Path) -> None:
    bench = Bench(0, "tea", robot)
    target = standing("sugar_box", 0.34, -0.08, height=bench.robot.table.height)
    before = bench.poses()
    outcome = bench.transfer(before, "sugar_box", "table", target)
    assert outcome.success, outcome.reason
    after = bench.poses()
    np.testing.assert_allclose(after["sugar_box"], target, atol=0.01)
    assert all(np.linalg.norm((after[o] - before[o])[:3, 3]) < 0.01 for o in set(after) - {"sugar_box"})
    assert bench.is_home()


def test_an_unreachable_object_fails_in_ik() -> None:
    bench = Bench(0, "tea")
    poses = bench.poses() | {"cup": standing("cup", 1.10, 0.5)}
    outcome = bench.transfer(poses, "cup", "table", standing("cup", 0.6, 0.0))
    assert (outcome.success, outcome.failed_stage) == (False, "ik")
    assert outcome.reason
    assert bench.is_home()


def test_an_unreachable_target_fails_in_place_motion() -> None:
    bench = Bench(0, "tea")
    poses = bench.poses()
    outcome = bench.transfer(poses, "cup", "table", standing("cup", 1.10, -0.5))
    assert (outcome.success, outcome.failed_stage) == (False, "place motion")
    np.testing.assert_allclose(bench.poses()["cup"], poses["cup"], atol=1e-3)


@pytest.mark.slow
def test_a_missing_object_fails_in_grasp() -> None:
    bench = Bench(0, "tea")
    poses = {"tray": bench.poses()["tray"]} | {"salt_shaker": standing("salt_shaker", 0.45, 0.0, height=0.75)}
    outcome = bench.transfer(poses, "salt_shaker", "table", standing("salt_shaker", 0.6, 0.0, height=0.75))
    assert (outcome.success, outcome.failed_stage) == (False, "grasp")
    assert outcome.attempts == 2
    assert outcome.T_base_object is None
    assert bench.is_home()


def test_an_object_that_was_not_perceived_is_reported() -> None:
    bench = Bench(0, "tea")
    poses = bench.poses()
    target = poses.pop("cup")
    outcome = bench.transfer(poses, "cup", "table", target)
    assert outcome.failed_stage == "ik"
    assert "cup" in outcome.reason


def test_states_between_transfers_are_ignored() -> None:
    bench = Bench(1, "lunch")
    state = bench.world.on_arrangement(Arrangement(kind="goal"), bench.ctx)
    assert bench.executor.on_robot_state(state, bench.ctx) is None


def test_configs_refuse_nonsense() -> None:
    with pytest.raises(Refused, match="attempts"):
        Executor.Config(attempts=0)
    with pytest.raises(Refused, match="seed"):
        World.Config(seed=-1)
    with pytest.raises(Refused, match="goal"):
        World.Config(goal="dinner")
