"""An arm behind ROS 2 in a graph whose lab loses its router: nothing is lost from the recording, and it replays."""

from pathlib import Path

import pytest

from runner.contract import Refused
from runner.graph.reading import load_graph
from runner.testing import finish, read_until, start_graph
from stages.messages import Frame, LookRequest, RobotCommand, RobotState, Ros2Heard, Ros2Sent
from tests.runner.common.waiting import wait_until
from tests.stages.devices.ros2.bags import SOURCE
from tests.stages.devices.ros2.lab import free_port, node, open_router, router
from tests.stages.devices.ros2.robot import ROBOT, WHERE, FakeRobot
from tests.stages.devices.ros2.test_live import Driver

ROOT = Path(__file__).parents[1]
GRAPH = """
name: arm
stages:
  commander:
    stage: tests.stages.devices.ros2.commander:Commander
    inputs: {robot_state: arm.robot_state}
  arm:
    stage: stages.arm:Ros2Arm
    config: {armed: false, calibrated: true, controllers: {efforts: false}, care: {stale: 5.0, answer: 5.0}}
    inputs: {robot_command: commander.robot_command, brake: commander.brake}
"""


@pytest.mark.slow
def test_a_router_that_dies_costs_nothing_of_the_recording(tmp_path: Path) -> None:
    port = free_port()
    ours = open_router(port)
    endpoint = f"tcp/127.0.0.1:{port}"
    with node(endpoint, "robot") as one:
        robot = FakeRobot(one)
        settings = (f"arm.robot={ROBOT}", f"arm.link.router={endpoint}")
        graph = start_graph(GRAPH, *settings, folder=tmp_path, options=["--arm"])
        printed = read_until(graph, "processes are ready")
        try:
            wait_until(lambda: robot.arm.busy)
            begun = robot.q.copy()
            wait_until(lambda: abs(robot.q - begun).max() > 0.1)
            ours.close()
        finally:
            robot.stop()
            run = finish(graph, tmp_path, before=printed)
    assert "COMPLETE" in run.output and "could not be told to stop" in run.output, run.output
    states, commands = run.messages(RobotState), run.messages(RobotCommand)
    assert states[-1].stopped == "fault" and len(states) == len(commands)
    sent = [item for message in run.messages(Ros2Sent) for item in message.messages]
    heard = [item for message in run.messages(Ros2Heard) for item in message.messages]
    assert [item.topic for item in sent][-2:] == [
        f"{WHERE.trajectory}/_action/{call}" for call in ("send_goal", "cancel_goal")
    ]
    positions = [
        one.types.decode(item.data.tobytes(), item.type).position[5] for item in heard if "states" in item.topic
    ]
    assert max(positions) - min(positions) > 0.05, "what it heard until then"


LOOKING = """
name: looking
stages:
  looker:
    stage: tests.stages.devices.ros2.commander:Looker
    inputs: {frame: camera.frame}
  camera:
    stage: stages.camera:Ros2Camera
    config: {patience: {warn: 0.5, give_up: 10, settle: 0.05}}
    inputs: {look_request: looker.look_request}
"""


@pytest.mark.slow
def test_a_camera_that_stops_costs_nothing_of_the_recording(tmp_path: Path) -> None:
    with router() as endpoint, node(endpoint, "driver") as one:
        driver = Driver(one)
        graph = start_graph(LOOKING, f"camera.link.router={endpoint}", folder=tmp_path)
        printed = read_until(graph, "processes are ready")
        try:
            printed += read_until(graph, "has look 2")
        finally:
            driver.stop()
            run = finish(graph, tmp_path, before=printed)
    said = f"camera: {SOURCE.color}: is published, but no message has come for"
    assert said in run.output and "COMPLETE" in run.output, run.output
    frames, requests = run.messages(Frame), run.messages(LookRequest)
    assert len(requests) == len(frames) + 1 and len(frames) >= 2


def test_nodes_keep_their_names_where_another_router_is_named() -> None:
    routers = (f"{stage}.link.router=tcp/lab:7447" for stage in ("camera", "arm", "ros2"))
    nodes = load_graph(ROOT / "graphs" / "arm.yaml", (*routers, "arm.care.speed=0.3")).nodes
    links = [nodes[stage].config.link for stage in ("camera", "arm", "ros2")]
    assert [link.node for link in links] == ["scene_camera", "scene_arm", "scene_programming"]
    assert {link.router for link in links} == {"tcp/lab:7447"}


def test_an_unknown_key_of_a_group_is_refused() -> None:
    with pytest.raises(Refused, match=r"camera\.link\.rooter: unknown key 'rooter'; did you mean 'router'"):
        load_graph(ROOT / "graphs" / "arm.yaml", ("camera.link.rooter=tcp/lab:7447",))


def test_the_graph_of_a_lab_moves_nothing_as_it_stands() -> None:
    config = load_graph(ROOT / "graphs" / "arm.yaml").nodes["arm"].config
    assert not config.armed and not config.calibrated
