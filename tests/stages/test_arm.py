"""An arm behind ROS 2 controllers: it follows, grips, stops, and says in one line why something was not done."""

from __future__ import annotations

import contextlib
import math
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from runner.testing import run_stage
from stages.arm import Ros2Arm
from stages.devices.ros2.node import Node
from stages.devices.ros2.settings import Care, Controllers, Link
from stages.messages import Brake, RobotCommand, RobotState, Ros2Heard, Ros2Sent
from stages.messages.robot import Guard
from stages.robots import read_robot
from tests.runner.common.waiting import wait_until
from tests.stages.devices.ros2.lab import free_port, node, open_router, router
from tests.stages.devices.ros2.robot import JOINTS, ROBOT, WHERE, FakeRobot

HOME = read_robot(ROBOT).home
NAMES = read_robot(ROBOT).joints
CARE = Care(answer=1.0, stuck=1.0, stale=0.8)
CALL = "/_action/send_goal"


@contextlib.contextmanager
def lab(endpoint: str, gripper_type: str = "GripperCommand") -> Iterator[FakeRobot]:
    with node(endpoint, "robot") as one:
        robot = FakeRobot(one, gripper_type)
        try:
            yield robot
        finally:
            robot.stop()


@contextlib.contextmanager
def arm(endpoint: str, controllers: Controllers = WHERE, **settings: Any) -> Iterator[Ros2Arm]:
    given = {"armed": True, "calibrated": True, "care": CARE, **settings}
    link = Link(router=endpoint, node="scene_arm")
    stage = Ros2Arm(Ros2Arm.Config(robot=ROBOT, link=link, controllers=controllers, **given))
    try:
        yield stage
    finally:
        stage.close()


def turn(radians: float, seconds: float, *, guard: Guard | None = None, width: float | None = None) -> RobotCommand:
    """Turns the wrist from home, from rest to rest."""
    share = np.linspace(0, 1, 11)
    positions = np.tile(HOME, (11, 1))
    positions[:, -1] += radians * (3 * share**2 - 2 * share**3)
    velocities = np.zeros_like(positions)
    velocities[:, -1] = radians * 6 * (share - share**2) / seconds
    times = seconds * share
    return RobotCommand(
        joint_names=NAMES, times=times, positions=positions, velocities=velocities, gripper_width=width, guard=guard
    )


def still(width: float | None = None) -> RobotCommand:
    none = np.zeros((0, len(NAMES)))
    return RobotCommand(times=np.zeros(0), positions=none, velocities=none, gripper_width=width)


def state_of(stage: Ros2Arm, *commands: RobotCommand | Brake) -> RobotState:
    """The answer to the last command."""
    return [one for one in run_stage(stage, list(commands)) if isinstance(one, RobotState)][-1]


def once_under_way(robot: FakeRobot, act: Callable[[], object]) -> threading.Thread:
    """Does it, in a thread, as soon as the arm has begun to turn."""

    def wait_and_act() -> None:
        wait_until(lambda: robot.q[-1] > HOME[-1] + 0.005)
        act()

    thread = threading.Thread(target=wait_and_act)
    thread.start()
    return thread


def test_it_follows_and_grips_and_all_that_was_said_is_a_message() -> None:
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint) as stage:
        robot.object = 0.3
        said = run_stage(stage, [turn(0.2, 0.4, guard=Guard(), width=0.0)])
    (state,) = [one for one in said if isinstance(one, RobotState)]
    where = dict(zip(state.joint_names, state.positions.tolist(), strict=True))
    assert state.stopped == "" and state.tracking_error < 0.02
    assert where["wrist_3_joint"] == pytest.approx(HOME[-1] + 0.2)
    assert state.gripper_width == pytest.approx(robot.robot.gripper.width(0.3))
    assert abs(state.time - time.time()) < 5
    sent = [one.topic for said_one in said if isinstance(said_one, Ros2Sent) for one in said_one.messages]
    heard = [one.topic for said_one in said if isinstance(said_one, Ros2Heard) for one in said_one.messages]
    assert sent == [WHERE.trajectory + CALL, WHERE.gripper + CALL]
    assert heard.count(WHERE.trajectory + "/_action/get_result") == 1 and heard.count(WHERE.joint_states) > 20


def test_a_parallel_gripper_closes_on_what_is_there() -> None:
    where = Controllers(efforts=False, gripper_type="ParallelGripperCommand")
    with router() as endpoint, lab(endpoint, where.gripper_type) as robot, arm(endpoint, where) as stage:
        robot.object = 0.3
        state = state_of(stage, still(0.0))
    (goal,) = robot.gripper.goals
    assert state.stopped == "" and state.gripper_width == pytest.approx(robot.robot.gripper.width(0.3))
    assert list(goal.command.name) == ["gripper_right_driver_joint"] and goal.command.effort.tolist() == [40.0]


@pytest.mark.parametrize(
    ("unit", "metres", "width", "says"),
    [
        ("opening", False, 0.0, "has reached 0.000, but .* at 0.000, which is 85 mm between the fingers where 0 were"),
        ("joint", True, 0.04, "has reached 0.448, but .* at 0.040, which is 82 mm between the fingers where 40 were"),
    ],
)
def test_a_gripper_and_joint_states_of_two_units_are_named(unit: Any, metres: bool, width: float, says: str) -> None:
    where = Controllers(efforts=False, gripper_unit=unit)
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint, where) as stage:
        robot.metres = metres
        state = state_of(stage, still(width))
    assert state.stopped == "fault" and re.search(says, state.reason)
    assert state.reason.startswith(f"controllers.gripper_unit = {unit!r}: ")
    assert state.reason.endswith("valid: 'joint', 'opening'")


def test_a_goal_has_tolerances_and_the_operators_speed() -> None:
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint, care=Care(speed=0.5, stale=0.8)) as stage:
        robot.q = HOME + 0.02
        state = state_of(stage, turn(0.1, 0.3))
    (goal,) = robot.arm.goals
    times = [one.time_from_start.sec + one.time_from_start.nanosec / 1e9 for one in goal.trajectory.points]
    assert state.stopped == "" and times[-1] - times[0] == pytest.approx(0.6)
    assert 0.02 / times[0] < 0.2 * robot.robot.velocity.min(), "the way to where it begins is slow"
    assert goal.trajectory.points[5].velocities[-1] == pytest.approx(0.5 * turn(0.1, 0.3).velocities[5, -1])
    assert {one.position for one in goal.path_tolerance} == {CARE.path_tolerance}
    assert [one.name for one in goal.goal_tolerance] == list(NAMES)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"armed": False}, "nothing moves, only shown: set arm.armed=true"),
        (
            {"armed": False, "calibrated": False},
            "nothing moves, only shown: set arm.armed=true and arm.calibrated=true",
        ),
    ],
)
def test_nothing_moves_without_the_operators_word(settings: dict[str, bool], says: str) -> None:
    ghosts: list[Any] = []
    with (
        router() as endpoint,
        lab(endpoint) as robot,
        arm(endpoint, **settings) as stage,
        node(endpoint, "rviz") as rviz,
    ):
        rviz.subscribe("/scene_arm/display_planned_path", "moveit_msgs/msg/DisplayTrajectory", ghosts.append)
        wait_until(lambda: state_of(stage, still()).joint_names)
        first, second = [
            one for one in run_stage(stage, [turn(0.2, 0.4), turn(0.2, 0.4, width=0.0)]) if isinstance(one, RobotState)
        ]
        wait_until(lambda: len(ghosts) == 2)
        state = state_of(stage, still(), turn(0.3, 0.4))
        wait_until(lambda: len(ghosts) == 3)
    assert (first.stopped, second.stopped, second.reason) == ("", "fault", says) and first.shown
    assert state.shown and state.reason == says
    assert np.allclose(second.positions[:6], HOME), "the encoders are what they are"
    assert not robot.arm.goals and not robot.gripper.goals
    assert [len(one.message.trajectory) for one in ghosts] == [1, 2, 1], "all since the encoders were read"
    shown = ghosts[0].message.trajectory[0].joint_trajectory
    assert list(shown.joint_names) == list(NAMES) and shown.points[-1].positions[-1] == pytest.approx(HOME[-1] + 0.2)


def test_a_brake_stops_it_on_the_way() -> None:
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint) as stage:
        once_under_way(robot, lambda: stage.on_brake(Brake()))
        state = state_of(stage, turn(1.0, 3.0))
    assert (state.stopped, state.reason) == ("stop", "as asked")
    assert 0 < state.positions[5] - HOME[-1] < 0.5 and robot.arm.canceling


def test_a_guard_that_does_not_hold_breaks_the_motion_off() -> None:
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint) as stage:
        narrow = state_of(stage, turn(1.0, 3.0, guard=Guard(narrowest=0.09)))
        wait_until(lambda: not robot.arm.busy)
        robot.q = HOME.copy()
        robot.q[0] += 0.08
        off = state_of(stage, turn(0.2, 0.5))
        robot.held_up = 0.0
        robot.q = HOME.copy()
        wait_until(lambda: np.allclose(state_of(stage, still()).positions[:6], HOME))
        held = state_of(stage, turn(0.2, 0.5))
    assert (narrow.stopped, narrow.reason) == ("slip", "the fingers are 85 mm apart")
    assert off.stopped == ""
    assert held.stopped == "fault" and "the controller stands on the way for 1 s and says nothing" in held.reason


def broken(robot: FakeRobot, what: str) -> None:
    """Changes one thing about a robot."""
    if what == "rejected":
        robot.arm.accepts = False
    elif what == "aborted":
        robot.abort = 0.2, -100, "Protective stop: joint 3 torque limit"
    elif what == "held up":
        robot.abort = 0.2, -4, ""
    elif what == "gripper":
        robot.gripper.silent = True
    elif what == "no finger":
        robot.without_finger = True
    elif what == "old":
        robot.behind = 35.0
    elif what == "quiet":
        once_under_way(robot, lambda: setattr(robot, "quiet", True))
    elif what == "moved":
        robot.q = HOME + 0.3


@pytest.mark.parametrize(
    ("what", "stopped", "says"),
    [
        ("rejected", "fault", f"{WHERE.trajectory}{CALL}: the goal was rejected"),
        ("aborted", "fault", f"{WHERE.trajectory}: aborted: Protective stop: joint 3 torque limit"),
        ("held up", "touch", f"{WHERE.trajectory}: aborted: a joint left the tolerance of the path"),
        ("gripper", "fault", f"{WHERE.gripper}: has not ended within 1 s"),
        (
            "no finger",
            "fault",
            "/joint_states: says nothing of joint 'gripper_right_driver_joint'; there are: elbow_joint",
        ),
        (
            "old",
            "fault",
            "/joint_states: the newest stamp is 35\\.[0-9] s before its arrival; it is old, or the clocks",
        ),
        ("quiet", "fault", "/joint_states: nothing of joint 'shoulder_pan_joint' for (0\\.[89]|[1-9]\\.[0-9]) s"),
        ("moved", "fault", "the arm is 0.30 rad from where the motion begins: it was moved"),
    ],
)
def test_what_goes_wrong_is_one_line(what: str, stopped: str, says: str) -> None:
    with router() as endpoint, lab(endpoint) as robot:
        broken(robot, what)
        with arm(endpoint) as stage:
            state = state_of(stage, turn(0.4, 2.0, guard=Guard(), width=0.02))
        moved = bool(robot.arm.goals)
    assert state.stopped == stopped and re.search(says, state.reason) and "\n" not in state.reason
    assert moved == (what not in ("rejected", "no finger", "old", "moved"))
    assert what != "quiet" or robot.arm.canceling, "what cannot be watched is not let go on"


@pytest.mark.parametrize("what", ["rejected", "aborted", "gripper", "no finger", "old", "quiet"])
def test_once_it_is_mended_the_next_command_is_carried_out(what: str) -> None:
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint) as stage:
        broken(robot, what)
        assert state_of(stage, turn(0.2, 1.0, guard=Guard(), width=0.02)).stopped == "fault"
        wait_until(lambda: not robot.arm.busy)
        mended(robot)
        robot.q = HOME.copy()
        state = state_of(stage, turn(0.2, 0.4, guard=Guard(), width=0.02))
    assert (state.stopped, state.reason) == ("", "")
    assert state.positions[5] == pytest.approx(HOME[-1] + 0.2, abs=1e-3)


def mended(robot: FakeRobot) -> None:
    """Everything as it should be."""
    robot.arm.accepts, robot.abort, robot.gripper.silent = True, None, False
    robot.without_finger, robot.behind, robot.quiet = False, 0.0, False


def test_an_arm_that_tells_no_efforts_feels_no_force_and_says_so_once() -> None:
    logged: list[str] = []
    with router() as endpoint, lab(endpoint), arm(endpoint, Controllers()) as stage:
        said = run_stage(stage, [turn(0.05, 0.3), turn(0.05, 0.3)], log=lambda text, level: logged.append(text))
    assert logged == ["/joint_states: gives no efforts; no force is felt"]
    assert [one.force for one in said if isinstance(one, RobotState)] == [0.0, 0.0]


def test_an_arm_whose_joints_come_in_several_messages_is_watched_all_the_same() -> None:
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint) as stage:
        robot.split, robot.held_up = True, 0.0
        held = state_of(stage, turn(0.2, 0.5))
    assert held.stopped == "fault" and "the controller stands on the way for 1 s and says nothing" in held.reason


def test_an_arm_that_tells_no_efforts_any_more_is_stopped() -> None:
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint, Controllers()) as stage:
        robot.torques = [1.0] * len(NAMES)
        once_under_way(robot, lambda: setattr(robot, "torques", [math.nan] * len(NAMES)))
        state = state_of(stage, turn(0.05, 2.0))
    assert (state.stopped, state.reason) == ("fault", "/joint_states: gives no efforts any more")
    assert robot.arm.canceling


def test_what_was_not_given_up_is_given_up_before_anything_else_moves() -> None:
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint) as stage:
        state_of(stage, still())
        robot.arm.refuses = True
        once_under_way(robot, lambda: stage.on_brake(Brake()))
        refused = state_of(stage, turn(0.2, 0.5))
        robot.q = HOME.copy()
        again = state_of(stage, turn(0.2, 0.4))
        robot.arm.refuses = False
        mended = state_of(stage, turn(0.2, 0.4))
    assert (refused.stopped, refused.reason) == ("stop", "as asked; the controller refuses to give it up")
    assert (again.stopped, len(robot.arm.goals)) == ("fault", 2)
    assert again.reason == "a goal of before may be under way; the controller refuses to give it up"
    assert mended.stopped == "", mended.reason


def test_two_publishers_of_all_joints_are_named_though_one_tells_no_efforts() -> None:
    """As a window with sliders does that somebody opens while the arm moves."""
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint, Controllers()) as stage:
        robot.torques = [1.0] * len(NAMES)
        with node(endpoint, "sliders") as other:
            publisher, stopping = other.publisher(WHERE.joint_states, JOINTS), threading.Event()

            def open_window() -> None:
                wait_until(lambda: bool(robot.arm.goals))
                babble(other, publisher, stopping, NAMES, HOME.tolist())

            thread = threading.Thread(target=open_window)
            thread.start()
            state = state_of(stage, turn(0.05, 2.0))
            stopping.set()
            thread.join()
    assert state.stopped == "fault" and robot.arm.canceling
    assert "is published by" in state.reason or "gives no efforts any more" in state.reason


def test_two_publishers_of_one_joint_are_named_and_nothing_moves() -> None:
    with router() as endpoint, lab(endpoint) as robot, arm(endpoint) as stage, node(endpoint, "ghost") as other:
        publisher = other.publisher(WHERE.joint_states, JOINTS)
        stopping = threading.Event()
        thread = threading.Thread(target=babble, args=(other, publisher, stopping))
        thread.start()
        wait_until(lambda: "is published by" in state_of(stage, still()).reason)
        state = state_of(stage, turn(0.2, 0.4))
        stopping.set()
        thread.join()
    assert state.reason == ("/joint_states: joint 'elbow_joint' is published by /ghost and /robot; one of them must go")
    assert state.stopped == "fault" and not robot.arm.goals


def babble(
    node: Node,
    publisher: Any,
    stopping: threading.Event,
    names: Sequence[str] = ("elbow_joint",),
    positions: Sequence[float] = (1.8,),
) -> None:
    while not stopping.wait(0.02):
        sec, nanosec = divmod(time.time_ns(), 10**9)
        header = {"stamp": {"sec": sec, "nanosec": nanosec}}
        publisher.put(node.types.new(JOINTS, header=header, name=list(names), position=list(positions)))


def test_without_a_robot_it_is_said_what_there_is() -> None:
    with router() as endpoint, arm(endpoint) as stage:
        state = state_of(stage, turn(0.2, 0.4))
    assert state.reason == f"/joint_states: nobody publishes it; domain 0 at {endpoint} has none"
    assert state.joint_names == ()


def test_a_router_that_goes_ends_the_command_and_one_that_comes_back_lets_the_next_begin() -> None:
    port = free_port()
    first = open_router(port)
    endpoint = f"tcp/127.0.0.1:{port}"
    with lab(endpoint) as robot, arm(endpoint) as stage:
        closed = once_under_way(robot, first.close)
        lost = state_of(stage, turn(0.5, 1.5, guard=Guard()))
        closed.join()
        second = open_router(port)
        wait_until(lambda: not robot.arm.busy)
        robot.q = HOME.copy()
        wait_until(lambda: not state_of(stage, still()).stopped, 30.0)
        found = state_of(stage, turn(0.2, 0.4, guard=Guard()))
    second.close()
    assert lost.stopped == "fault" and "could not be told to stop" in lost.reason
    assert found.stopped == "", found.reason
