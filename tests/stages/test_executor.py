"""The executor and the simulated world, played against each other."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from runner.contract import Level, Refused
from stages.devices.simulation import Simulation
from stages.devices.suites import tray
from stages.executor import Executor
from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, pose
from stages.messages import (
    Arrangement,
    Arrived,
    Brake,
    Halt,
    LookRequest,
    Outcome,
    PostureRequest,
    Recover,
    RobotCommand,
    RobotState,
    SceneGraph,
    Transfer,
    TransferRequest,
)
from stages.messages.scene import SceneObject, UnknownRegion
from stages.messages.task import STOPPED
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.posture import postures_in_view
from stages.robots import BUILT_IN, read_robot
from stages.world import World
from tests.stages.planning.scenes import CATALOGUE_FILE, ROBOT, catalogue, standing


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
        self.meddle: Callable[[str], None] = lambda label: None
        """Called while a command is carried out, with what it is for."""
        self.states: list[RobotState] = []

    @property
    def simulation(self) -> Simulation:
        return self.world._simulation  # pyright: ignore[reportPrivateUsage]

    def poses(self) -> dict[str, Floats]:
        snapshot = self.world.on_look_request(LookRequest(purpose="test"), self.ctx)
        return dict(zip(snapshot.names, snapshot.T_base_objects, strict=True))

    def transfer(
        self,
        poses: dict[str, Floats],
        name: str,
        destination: str,
        target: Floats,
        unknown: tuple[UnknownRegion, ...] = (),
    ) -> Outcome:
        transfer = Transfer(
            object=name, source="table", destination=destination, T_base_targets=target[None], pick="", place=""
        )
        scene = replace(graph(poses, self.robot.table.height), unknown=unknown)
        request = TransferRequest(transfer=transfer, scene=scene, number=1)
        outcome = self.played(self.executor.on_transfer_request(request, self.ctx))
        assert isinstance(outcome, Outcome)
        return outcome

    def played(self, answer: RobotCommand | Outcome | Arrived) -> Outcome | Arrived:
        while isinstance(answer, RobotCommand):
            following = self.executor.on_robot_state(self.does(answer), self.ctx)
            assert following is not None
            answer = following
        return answer

    def does(self, command: RobotCommand) -> RobotState:
        for state in self.world.on_robot_command(command, self.ctx):
            if state is not None:
                self.states.append(state)
                return state
            self.meddle(command.label)
        raise AssertionError("no answer")

    def since(self, holds: Callable[[], bool]) -> list[float]:
        """Gets the time of the first step of the physics after which something holds."""
        servo, times = self.simulation.servo, list[float]()
        step = servo._step  # pyright: ignore[reportPrivateUsage]

        def stepped() -> None:
            step()
            if not times and holds():
                times.append(self.simulation.time)

        servo._step = stepped  # pyright: ignore[reportPrivateUsage]
        return times

    def stands_after(self, times: list[float]) -> float:
        """Seconds from then until the arm that was stopped stood."""
        return next(state.time for state in self.states if state.stopped and state.time > times[0]) - times[0]

    def touched(self, name: str) -> bool:
        """Whether anything but the table touches an object."""
        return bool(self.simulation._touched(name) - {"table"})  # pyright: ignore[reportPrivateUsage]

    def is_home(self) -> bool:
        state = self.does(READ)
        where = dict(zip(state.joint_names, state.positions, strict=True))
        is_open = state.gripper_width > 0.9 * self.robot.gripper.open_width
        return is_open and all(abs(where[n] - p) < 0.02 for n, p in self.robot.posture.items())


NONE = np.zeros((0, 8))
READ = RobotCommand(times=np.zeros(0), positions=NONE, velocities=NONE)
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


def test_an_arm_that_only_shows_is_shown_the_whole_plan() -> None:
    poses = {"soup_can": standing("soup_can", 0.6, 0.1), "tuna_can": standing("tuna_can", 0.65, -0.15)}
    first, second = (
        Transfer(object=name, source="table", destination="table", T_base_targets=target[None], pick="", place="")
        for name, target in (("soup_can", standing("soup_can", 0.6, -0.3)), ("tuna_can", poses["soup_can"]))
    )
    executor = Executor(Executor.Config(catalogue=CATALOGUE_FILE))
    ctx, home = StepContext(np.random.default_rng(0)), tuple(ROBOT.joints)
    request = TransferRequest(transfer=first, scene=graph(poses, ROBOT.table.height), number=1, then=(second,))
    still = RobotState(
        joint_names=home, positions=ROBOT.home, gripper_width=0.1, time=0.0, reason="nothing moves", shown=True
    )
    shown: list[RobotCommand] = []
    answer = executor.on_transfer_request(request, ctx)
    while isinstance(answer, RobotCommand):
        shown.append(answer)
        answer = executor.on_robot_state(still, ctx)
    assert isinstance(answer, Outcome)
    assert (answer.failed_stage, answer.reason, answer.held) == ("fault", "nothing moves", "")
    moving = shown[1:]
    assert [one.label for one in moving if "reach" in one.label] == ["reach for soup_can", "reach for tuna_can"]
    assert all(np.allclose(b.positions[0], a.positions[-1], atol=1e-6) for a, b in pairwise(moving)), "without a gap"
    assert np.allclose(moving[0].positions[0], ROBOT.home) and np.allclose(moving[-1].positions[-1], ROBOT.home)
    assert all(one.gripper_width is None for one in moving)


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


def test_a_stop_reaches_the_arm_on_its_way_and_what_it_held_goes_back() -> None:
    bench = Bench(0, "tea")
    before, asked = bench.poses(), list[float]()

    def stop(label: str) -> None:
        if label == "carry soup_can" and not asked and bench.simulation.time > bench.states[-1].time + 0.5:
            asked.append(bench.simulation.time)
            bench.world.on_brake(bench.executor.on_stop(Halt(), bench.ctx))

    bench.meddle = stop
    outcome = bench.transfer(before, "soup_can", "table", standing("soup_can", 0.55, 0.45))
    assert (outcome.success, outcome.failed_stage, outcome.held) == (False, STOPPED, "soup_can")
    assert outcome.reason == "stopped, as asked; in the hand: soup_can"
    stood = bench.states[-1]
    assert stood.stopped == "stop" and stood.time - asked[0] < 0.2
    bench.simulation.run(2.0)
    (still,) = (s for s in bench.world.on_robot_command(READ, bench.ctx) if s is not None)
    assert np.abs(still.positions - stood.positions).max() < 0.01
    assert bench.poses()["soup_can"][2, 3] > before["soup_can"][2, 3] + 0.05
    with pytest.raises(Refused, match="not under way"):
        bench.executor.on_stop(Halt(), bench.ctx)
    home = bench.played(bench.executor.on_recover(Recover(), bench.ctx))
    assert isinstance(home, Outcome) and (home.success, home.number, home.held) == (True, 0, "")
    assert bench.is_home()
    assert np.linalg.norm(bench.poses()["soup_can"][:3, 3] - before["soup_can"][:3, 3]) < 0.01


@pytest.mark.parametrize(("label", "seconds", "error"), [("lift cup", 0.2, 7971), ("go home", 2.0, 26471)])
def test_an_arm_that_is_called_home_right_after_a_stop_gets_there(label: str, seconds: float, error: int) -> None:
    """Stopped while lifting it held the cup where no free motion began; on its way home it felt its own jerk."""
    bench = Bench(1, "breakfast")
    before, rng, stopped = bench.poses(), np.random.default_rng(error), list[float]()
    seen = {name: misperceived(T, rng) for name, T in before.items()}
    target = seen["cup"].copy()
    target[1, 3] += 0.1 if target[1, 3] < 0 else -0.1

    def stop(doing: str) -> None:
        if doing == label and not stopped and bench.simulation.time > bench.states[-1].time + seconds:
            stopped.append(bench.simulation.time)
            bench.world.on_brake(bench.executor.on_stop(Halt(), bench.ctx))

    bench.meddle = stop
    assert bench.transfer(seen, "cup", "table", target).failed_stage == STOPPED
    home = bench.played(bench.executor.on_recover(Recover(), bench.ctx))
    assert isinstance(home, Outcome) and (home.success, home.reason, home.held) == (True, "", "")
    assert bench.is_home()
    stands = before["cup"] if label == "lift cup" else target
    assert np.linalg.norm(bench.poses()["cup"][:3, 3] - stands[:3, 3]) < 0.02


def test_an_arm_that_was_to_stand_between_two_motions_stands_until_it_is_to_recover() -> None:
    bench = Bench(0, "tea")
    assert bench.executor.on_brake(Brake()) == Brake()
    home = bench.played(bench.executor.on_recover(Recover(), bench.ctx))
    assert isinstance(home, Outcome) and home.success and not bench.states
    before = bench.poses()
    for _ in range(2):
        bench.world.on_brake(bench.executor.on_brake(Brake()))
        outcome = bench.transfer(before, "soup_can", "table", standing("soup_can", 0.55, 0.45))
        assert (outcome.failed_stage, outcome.reason) == (STOPPED, "stopped, as asked; in the hand: nothing")
        request = PostureRequest(
            joint_names=ROBOT.joints, positions=ROBOT.home, table_height=0.7, occupied=np.zeros((0, 6)), label="go home"
        )
        arrived = bench.played(bench.executor.on_posture_request(request, bench.ctx))
        assert isinstance(arrived, Arrived) and (arrived.stopped, arrived.reason) == ("stop", "as asked")
        assert bench.is_home()
        home = bench.played(bench.executor.on_recover(Recover(), bench.ctx))
        assert isinstance(home, Outcome) and home.success and bench.is_home()
    assert bench.transfer(before, "soup_can", "table", standing("soup_can", 0.55, 0.45)).success


def test_the_arm_may_be_stopped_on_its_way_into_a_posture_and_comes_home() -> None:
    bench = Bench(0, "tea")
    q = next(postures_in_view(CollisionWorld(ROBOT, ROBOT.table, {}), np.random.default_rng(0), 1))
    request = PostureRequest(
        joint_names=ROBOT.joints, positions=q, table_height=ROBOT.table.height, occupied=np.zeros((0, 6)), label="show"
    )

    def stop(label: str) -> None:
        if label == "show" and bench.simulation.time > bench.states[-1].time + 0.5:
            bench.world.on_brake(bench.executor.on_stop(Halt(), bench.ctx))
            bench.meddle = lambda label: None

    bench.meddle = stop
    stopped = bench.played(bench.executor.on_posture_request(request, bench.ctx))
    read = bench.executor.on_recover(Recover(), bench.ctx)
    bench.executor.on_brake(Brake())
    stays = bench.played(read)
    assert isinstance(stays, Outcome) and (stays.failed_stage, stays.reason) == (STOPPED, "as asked")
    assert not bench.is_home()
    assert isinstance(stopped, Arrived) and (stopped.success, stopped.stopped) == (False, "stop")
    assert stopped.reason == "as asked on the way to show" and 0.5 < stopped.robot_seconds < 1.0
    bench.simulation.run(1.0)
    home = bench.played(bench.executor.on_recover(Recover(), bench.ctx))
    assert isinstance(home, Outcome) and home.success and bench.is_home()
    there = bench.played(bench.executor.on_posture_request(request, bench.ctx))
    assert isinstance(there, Arrived) and there.success
    where = dict(zip(there.joint_names, there.positions, strict=True))
    assert np.allclose([where[name] for name in ROBOT.joints], q, atol=0.02)


def test_a_stop_between_two_motions_is_heard() -> None:
    bench = Bench(0, "tea")
    before = bench.poses()
    transfer = Transfer(
        object="soup_can", source="table", destination="table", T_base_targets=standing("soup_can", 0.55, 0.45)[None],
        pick="", place="",
    )  # fmt: skip
    read = bench.executor.on_transfer_request(
        TransferRequest(transfer=transfer, scene=graph(before, bench.robot.table.height), number=1), bench.ctx
    )
    assert isinstance(read, RobotCommand)
    state = bench.does(read)
    bench.executor.on_stop(Halt(), bench.ctx)
    outcome = bench.executor.on_robot_state(state, bench.ctx)
    assert isinstance(outcome, Outcome) and outcome.failed_stage == STOPPED


def test_an_object_that_falls_from_the_hand_is_noticed_at_once() -> None:
    bench = Bench(0, "tea")
    before, fell = bench.poses(), list[float]()

    def let_fall(label: str) -> None:
        if label == "carry soup_can" and not fell and bench.simulation.time > bench.states[-1].time + 0.5:
            fell.append(bench.simulation.time)
            bench.simulation.place("soup_can", standing("soup_can", 1.0, 0.0), settle=0.0)

    bench.meddle = let_fall
    outcome = bench.transfer(before, "soup_can", "table", standing("soup_can", 0.55, 0.45))
    assert (outcome.success, outcome.failed_stage, outcome.held) == (False, "slip", "")
    assert bench.stands_after(fell) < 0.2
    assert bench.is_home()


@pytest.mark.parametrize("name", ["soup_can", "sugar_box", "tea_box"])
def test_an_object_that_stays_behind_when_it_is_lifted_is_noticed_at_once(name: str) -> None:
    """The fingers slide along it: nothing but its weight is missing."""
    bench, low = Bench(0, "tea"), np.inf
    before, target = bench.poses(), bench.poses()[name]
    target[0, 3] += 0.02
    does = bench.does

    def lifts_smoothly(command: RobotCommand) -> RobotState:
        nonlocal low
        lifts = command.label == f"lift {name}"
        low = bench.simulation.hand()[2] if lifts else np.inf
        bench.simulation.slide(0.0 if lifts else 1.0)
        return does(command)

    def stays_behind() -> bool:
        risen = bench.simulation.layout()[name][2, 3] - before[name][2, 3]
        return bench.simulation.hand()[2] > low + 0.002 and abs(risen) < 0.0005

    bench.does = lifts_smoothly
    stays = bench.since(stays_behind)
    outcome = bench.transfer(before, name, "table", target)
    assert (outcome.success, outcome.failed_stage, outcome.held) == (False, "slip", "")
    assert outcome.reason.startswith("nothing weighs on the hand")
    assert bench.stands_after(stays) < 0.2
    assert bench.is_home()
    assert np.linalg.norm(bench.poses()[name][:3, 3] - before[name][:3, 3]) < 0.005


def test_what_the_hand_bears_before_it_lifts_is_not_left_behind() -> None:
    """Fingers that close may raise a thing a little; here the hand does, and then lifts."""
    bench = Bench(0, "tea")
    before, target = bench.poses(), bench.poses()["sugar_box"]
    target[0, 3] += 0.02
    does = bench.does

    def raises_first(command: RobotCommand) -> RobotState:
        if command.label != "lift sugar_box":
            return does(command)
        risen = command.positions[25] - command.positions[0]
        first = command.positions[:1] + np.array([[0.0], [1.0]]) * risen
        does(replace(command, times=np.array([0.0, 1.0]), positions=first, velocities=0 * first, guard=None))
        return does(replace(command, positions=command.positions + risen))

    bench.does = raises_first
    assert bench.transfer(before, "sugar_box", "table", target).success
    assert not any(state.stopped == "slip" for state in bench.states)


@pytest.mark.parametrize(("destination", "barred"), [("table", False), ("tray", False), ("table", True)])
def test_what_slides_down_in_the_hand_is_put_down_all_the_same(destination: str, barred: bool) -> None:
    """Where it was to go; where something bars that, where it was taken from. It slides once it is lifted."""
    bench, began = Bench(0, "tea"), list[float]()
    before, target = bench.poses(), standing("soup_can", 0.55, 0.45)
    if destination == "tray":
        target[:3, 3] = before["tray"][:3, 3] + [0, 0, 0.04]

    def let_slide(label: str) -> None:
        if label == "lift soup_can":
            began.append(bench.simulation.time)
            bench.simulation.slide(0.01 if 0.2 < bench.simulation.time - began[0] < 0.6 else 1.0)
        if label == "carry soup_can" and barred:
            bench.simulation.place("sugar_box", standing("sugar_box", *target[:2, 3]), settle=0.0)

    bench.meddle = let_slide
    outcome = bench.transfer(before, "soup_can", destination, target)
    after, expected = bench.poses()["soup_can"], before["soup_can"] if barred else target
    assert outcome.failed_stage == ("touch" if barred else "") and bench.is_home()
    assert outcome.T_base_object is not None
    for T in (after, outcome.T_base_object):
        np.testing.assert_allclose(T[:3, 3], expected[:3, 3], atol=0.01)


def test_what_turns_in_the_hand_and_spreads_the_fingers_goes_back() -> None:
    """As it is held from then on: what made the arm stop does not bar the way back."""
    bench, began = Bench(0, "tea"), list[float]()
    before, target = bench.poses(), bench.poses()["tea_box"]
    target[1, 3] += 0.12

    def turn(label: str) -> None:
        if label == "carry tea_box":
            began.append(bench.simulation.time)
            if began[-1] > began[0] + 0.7 and bench.simulation.servo.opening() < 0.07:
                bench.simulation.place("tea_box", turned(bench.simulation.layout()["tea_box"]), settle=0.0)

    def turned(T: Floats) -> Floats:
        """By 45 degrees about the hand, the 2 mm from which an object is dropped taken off."""
        hand, R = bench.simulation.hand(), exp_so3(np.array([0.0, 0.0, np.pi / 4]))
        return np.block([[R @ T[:3, :3], (hand + R @ (T[:3, 3] - hand) - [0, 0, 0.002])[:, None]], [T[3:]]])

    bench.meddle = turn
    outcome = bench.transfer(before, "tea_box", "table", target)
    assert (outcome.success, outcome.failed_stage, outcome.held) == (False, "slip", "") and bench.is_home()
    assert outcome.reason.startswith("the fingers are 74 mm apart")
    assert np.linalg.norm(bench.poses()["tea_box"][:3, 3] - before["tea_box"][:3, 3]) < 0.02


def test_what_is_not_quite_where_it_was_seen_is_grasped_beside_that() -> None:
    bench = Bench(0, "tea")
    seen, target = bench.poses(), bench.poses()["cup"]
    seen["cup"][:2, 3] += 0.012
    target[0, 3] += 0.02
    outcome = bench.transfer(seen, "cup", "table", target)
    assert outcome.success, outcome.reason
    assert any("tries beside it" in line for line in bench.ctx.lines)
    assert np.linalg.norm(bench.poses()["cup"][:2, 3] - target[:2, 3]) < 0.02


def test_what_stands_in_the_way_unseen_is_felt_and_what_is_held_goes_back() -> None:
    bench = Bench(0, "breakfast")
    before = bench.poses()
    seen = {name: T for name, T in before.items() if name != "tea_box"}
    x, y = before["tea_box"][:2, 3]
    touched = bench.since(lambda: bench.touched("tea_box"))
    outcome = bench.transfer(seen, "cup", "table", standing("cup", x, y))
    assert (outcome.success, outcome.failed_stage) == (False, "touch")
    assert bench.stands_after(touched) < 0.2
    assert "N at the hand" in outcome.reason
    assert bench.is_home()
    after = bench.poses()
    assert np.linalg.norm(after["cup"][:3, 3] - before["cup"][:3, 3]) < 0.02
    assert after["tea_box"][2, 2] > 0.99


def test_what_goes_back_to_where_nothing_bears_it_any_more_has_failed_for_the_reason_that_it_went_back() -> None:
    bench, gone = Bench(0, "breakfast"), list[str]()
    x, y = bench.poses()["tea_box"][:2, 3]
    height = bench.poses()["milk_carton"][2, 3] + catalogue()["milk_carton"].dimensions[2]
    on_top = standing("cup", *bench.poses()["milk_carton"][:2, 3])
    on_top[2, 3] = height
    bench.simulation.place("cup", on_top)
    seen = {name: T for name, T in bench.poses().items() if name != "tea_box"}

    def take_away(label: str) -> None:
        if label == "carry cup back" and not gone:
            gone.append("milk_carton")
            bench.simulation.place("milk_carton", standing("milk_carton", 0.5, 0.6), settle=0.0)

    bench.meddle = take_away
    outcome = bench.transfer(seen, "cup", "table", standing("cup", x, y))
    assert gone and (outcome.failed_stage, outcome.held) == ("touch", "") and outcome.T_base_object is not None
    assert "N at the hand" in outcome.reason


def test_an_arm_of_which_nobody_knows_where_it_is_stands_and_says_why() -> None:
    bench = Bench(0, "tea")
    request = PostureRequest(
        joint_names=ROBOT.joints, positions=ROBOT.home, table_height=0.7, occupied=np.zeros((0, 6)), label="go home"
    )
    lost = RobotState(
        joint_names=(), positions=np.zeros(0), gripper_width=0.0, time=0.0, stopped="fault", reason="no joint states"
    )
    assert isinstance(bench.executor.on_posture_request(request, bench.ctx), RobotCommand)
    arrived = bench.executor.on_robot_state(lost, bench.ctx)
    assert isinstance(arrived, Arrived) and (arrived.stopped, arrived.reason) == ("fault", "no joint states")
    assert isinstance(bench.executor.on_recover(Recover(), bench.ctx), RobotCommand)
    stays = bench.executor.on_robot_state(lost, bench.ctx)
    assert isinstance(stays, Outcome) and (stays.failed_stage, stays.reason) == ("fault", "no joint states")


def test_what_is_seen_but_not_known_is_kept_clear_of() -> None:
    bench = Bench(0, "breakfast")
    before = bench.poses()
    seen = {name: T for name, T in before.items() if name != "tea_box"}
    T, extent = before["tea_box"], catalogue()["tea_box"].dimensions
    region = UnknownRegion(
        box=np.array([0.0, 0.0, 9.0, 9.0]),
        points=90,
        centre_table=np.array([*T[:2, 3], extent[2] / 2]),
        extent_table=np.array([*np.full(2, np.hypot(*extent[:2])), extent[2]]),
    )
    outcome = bench.transfer(seen, "cup", "table", standing("cup", *T[:2, 3]), (region,))
    assert (outcome.success, outcome.failed_stage) == (False, "place motion")
    assert outcome.reason == "no free way down to the target"
    assert bench.poses()["cup"] == pytest.approx(before["cup"], abs=1e-3)


def test_what_somebody_puts_in_the_way_home_is_felt_and_another_way_is_found() -> None:
    bench, hand = Bench(0, "breakfast"), list[Floats]()

    def bar(label: str) -> None:
        if label != "go home" or len(hand) == 3:
            return
        hand.append(bench.simulation.hand()[:2])
        if len(hand) == 3:
            ahead = (hand[2] - hand[1]) / np.linalg.norm(hand[2] - hand[1])
            bench.simulation.place("milk_carton", standing("milk_carton", *(hand[2] + 0.12 * ahead)), settle=0.0)

    bench.meddle = bar
    touched = bench.since(lambda: bench.touched("milk_carton"))
    outcome = bench.transfer(bench.poses(), "cup", "table", standing("cup", 0.62, -0.30))
    assert bench.stands_after(touched) < 0.2
    assert (outcome.failed_stage, outcome.held) == ("unknown", "")
    assert "on the way to go home" in outcome.reason
    assert bench.is_home()
    after = bench.poses()
    assert np.linalg.norm(after["cup"][:2, 3] - [0.62, -0.30]) < 0.02
    assert after["milk_carton"][2, 2] > 0.99


def test_a_hand_that_somebody_has_put_something_against_gets_away_from_it() -> None:
    """The arm could not go home before: it stands against a carton, and cannot go straight up."""
    bench = Bench(0, "tea")
    T = pose(exp_so3(np.array([0.23, -0.011, -1.784])), np.array([0.5397, -0.3127, 0.7845]))
    q = np.array([0.3847, -0.8036, -0.588, 0.307, 1.6126, 0.8445, 0.102, 0.4494])
    transfer = Transfer(object="carton", source="table", destination="table", T_base_targets=T[None], pick="", place="")
    carton = SceneObject(name="carton", label="cereal_box", T_base_object=T)
    scene = replace(graph({}, ROBOT.table.height), objects=(carton,))
    asked = bench.executor.on_transfer_request(TransferRequest(transfer=transfer, scene=scene, number=1), bench.ctx)
    assert isinstance(asked, RobotCommand)
    stands = RobotState(joint_names=ROBOT.joints, positions=q, gripper_width=0.1, time=0.0, stopped="", reason="")
    answer = bench.executor.on_robot_state(stands, bench.ctx)
    assert isinstance(answer, RobotCommand) and answer.label == "go home"
    assert answer.guard is not None and np.allclose(answer.positions[-1], ROBOT.home, atol=1e-6)


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
