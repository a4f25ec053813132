"""Scenes published and wishes taken as a ROS 2 node, asked by another node at a router."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from runner.graph.reading import load_graph
from runner.message.codec import open_envelope
from runner.recording.recording import Recording
from runner.testing import run_stage
from stages.demonstrator import AskedDemonstrator
from stages.devices.ros2.node import Node
from stages.devices.ros2.services import Client
from stages.devices.ros2.settings import Link
from stages.devices.ros2.wire import LATCHED
from stages.messages import Asked, Frame, Goal, LookRequest, Ros2Sent, SceneEstimate, SceneGraph, Verdict
from stages.ros2 import Ros2Demonstration, Ros2Scenes, sentence
from stages.scene.catalogue import BUILT_IN
from tests.runner.common.waiting import wait_until
from tests.stages.devices.ros2.lab import PATIENCE, node, router

ROOT = Path(__file__).parents[2]
TRIGGER = "std_srvs/srv/Trigger"
NAME = "/scene_programming"


@pytest.fixture(scope="module")
def look() -> dict[str, Any]:
    """Frame, estimate and scene graph of one look."""
    recording = Recording(ROOT / "recordings" / "reference.mcap")
    ids = {"frame": "camera.frame#0", "scene_estimate": "refiner.scene_estimate#0"}
    ids |= {"scene_graph": "scene_graph.scene_graph#0"}
    kinds = {"frame": Frame, "scene_estimate": SceneEstimate, "scene_graph": SceneGraph}
    return {port: open_envelope(kinds[port], recording.envelope(id)) for port, id in ids.items()}


def call(lab: Node, service: str) -> Any:
    client = Client(lab, service, TRIGGER)
    assert lab.wait_for(client.endpoint, PATIENCE) == ""
    return client.start(seconds=30.0)


def test_a_node_asks_for_a_look_and_gets_its_scene(look: dict[str, Any]) -> None:
    detections: list[Any] = []
    graphs: list[Any] = []
    with router() as endpoint, node(endpoint, "lab") as lab:
        stage = Ros2Scenes(Ros2Scenes.Config(catalogue=BUILT_IN, link=Link(router=endpoint)))
        heard = lab.subscribe(f"{NAME}/detections", "vision_msgs/msg/Detection3DArray", detections.append)
        assert lab.wait_for(heard, PATIENCE) == ""
        future = call(lab, f"{NAME}/look")
        (request,) = run_stage(stage, limit=1)
        assert request == LookRequest(purpose="look 1: asked by a node")
        answered = {**look, "frame": msgspec.structs.replace(look["frame"], name=request.purpose)}
        (sent,) = run_stage(stage, [answered], limit=1)
        response = future.result(5.0)
        wait_until(lambda: detections)
        lab.subscribe(f"{NAME}/scene_graph", "std_msgs/msg/String", graphs.append, LATCHED)
        wait_until(lambda: graphs)
        stage.close()
    assert response.success and response.message == sentence(look["scene_graph"])
    assert "on table" in response.message
    topics = {one.topic: one for one in sent.messages}
    assert set(topics) == {f"{NAME}/detections", "/tf", f"{NAME}/markers", f"{NAME}/scene_graph", f"{NAME}/look"}
    assert [one.id for one in detections[0].message.detections] == [one.name for one in look["scene_graph"].objects]
    assert topics[f"{NAME}/scene_graph"].data.tobytes() == lab.types.encode(graphs[0].message)


def test_who_asks_for_a_look_at_which_nothing_is_seen_is_told_why(look: dict[str, Any]) -> None:
    blind = msgspec.structs.replace(look["scene_graph"], objects=(), assertions=(), virtual_objects=())
    graph, estimate = (
        msgspec.structs.replace(one, unusable="no support plane") for one in (blind, look["scene_estimate"])
    )
    with router() as endpoint, node(endpoint, "lab") as lab:
        stage = Ros2Scenes(Ros2Scenes.Config(catalogue=BUILT_IN, link=Link(router=endpoint)))
        future = call(lab, f"{NAME}/look")
        (request,) = run_stage(stage, limit=1)
        frame = msgspec.structs.replace(look["frame"], name=request.purpose)
        (sent,) = run_stage(
            stage, [{**look, "frame": frame, "scene_estimate": estimate, "scene_graph": graph}], limit=1
        )
        response = future.result(5.0)
        stage.close()
    assert (response.success, response.message) == (False, "nothing is known: no support plane")
    assert [one.topic for one in sent.messages] == [f"{NAME}/scene_graph", f"{NAME}/look"]


def test_looks_may_be_taken_unasked(look: dict[str, Any]) -> None:
    with router() as endpoint:
        stage = Ros2Scenes(Ros2Scenes.Config(catalogue=BUILT_IN, link=Link(router=endpoint), every=0.0))
        first, second = run_stage(stage, limit=1), run_stage(stage, [look], limit=2)
        stage.close()
    assert first == [LookRequest(purpose="look 1: due")]
    assert [type(one) for one in second] == [Ros2Sent, LookRequest]


def test_goals_are_taught_and_restored_by_services(look: dict[str, Any]) -> None:
    graph = look["scene_graph"]
    verdict = Verdict(
        goal_name="tea", success=False, failed_stage="planner", reason="no way", satisfied=(), violated=()
    )
    with router() as endpoint, node(endpoint, "lab") as lab:
        config = Ros2Demonstration.Config(catalogue=BUILT_IN, link=Link(router=endpoint), goals=("tea", "lunch"))
        stage = Ros2Demonstration(config)
        taught = call(lab, f"{NAME}/teach/tea")
        assert run_stage(stage, limit=1) == [Asked(kind="teach", name="tea")]
        busy = call(lab, f"{NAME}/restore/lunch")
        assert [type(one) for one in run_stage(stage, limit=1)] == [Ros2Sent]
        assert busy.result(5.0).message == "busy: teach tea is under way"
        (sent,) = run_stage(stage, [Goal(name="tea", scene=graph, pddl="")], limit=1)
        assert taught.result(5.0).success
        assert taught.result().message == f"{len(graph.objects)} objects: {sentence(graph)}"
        assert [one.topic for one in sent.messages] == [f"{NAME}/teach/tea"]
        restored = call(lab, f"{NAME}/restore/tea")
        assert run_stage(stage, limit=1) == [Asked(kind="restore", name="tea")]
        run_stage(stage, [verdict], limit=1)
        assert (restored.result(5.0).success, restored.result().message) == (False, "no way")
        stage.close()


def test_a_demonstrator_that_is_asked_always_answers() -> None:
    stage = AskedDemonstrator(AskedDemonstrator.Config(catalogue=BUILT_IN, scripted=False))
    _, verdict = run_stage(stage, [Asked(kind="restore", name="tea")])
    assert verdict.reason == "name='tea': no such goal; valid: none, teach one first" and not verdict.success
    stage = AskedDemonstrator(AskedDemonstrator.Config(catalogue=BUILT_IN, scripted=False))
    _, request, busy = run_stage(stage, [Asked(kind="teach", name="tea"), Asked(kind="teach", name="tea")])
    assert request == LookRequest(purpose="goal tea")
    assert busy.reason.startswith("busy: waits for a scene graph")


def test_a_graph_takes_the_demonstrator_that_is_asked(tmp_path: Path) -> None:
    """As docs/ros2.md says: the graph of the robot at somebody's command, with two lines changed and one stage more."""
    text = (ROOT / "graphs" / "interactive.yaml").read_text()
    text = text.replace("stages.demonstrator:KeepingDemonstrator", "stages.demonstrator:AskedDemonstrator")
    port = "      robot_state: world.robot_state\n      scene_graph"
    text = text.replace(port, f"      asked: ros2.asked\n{port}")
    text += """
  ros2:
    stage: stages.ros2:Ros2Demonstration
    config: {catalogue: stages/scene/catalogue.yaml, goals: [breakfast]}
    inputs:
      frame: camera.frame
      scene_estimate: refiner.scene_estimate
      scene_graph: scene_graph.scene_graph
      goal: demonstrator.goal
      verdict: demonstrator.verdict
"""
    path = tmp_path / "asked.yaml"
    path.write_text(text)
    graph = load_graph(path)
    assert graph.nodes["demonstrator"].inputs["asked"].stage == "ros2"
