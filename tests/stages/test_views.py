"""Drawings of every message, without a viewer."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from runner.contract import Message
from runner.view.drawing import (
    BarChart,
    Boxes2D,
    Clear,
    Column,
    Drawing,
    Graph,
    Image,
    Layout,
    Lines3D,
    Mesh3D,
    NextStep,
    Panel,
    Points3D,
    Row,
    Scalar,
    Tabs,
    Text,
    Transform,
)
from stages.messages import (
    Arrangement,
    Candidate,
    Candidates,
    Frame,
    Goal,
    LookRequest,
    ObjectPose,
    Observation,
    Posterior,
    Restore,
    RobotCommand,
    RobotState,
    SceneEstimate,
    Snapshot,
    TransferRequest,
    Verdict,
)
from stages.messages.digest import ParticleTrace
from stages.messages.scene import Alternative, UnknownRegion
from stages.perception.rendering.renderer import Camera, Item, Renderer
from stages.scene.catalogue import Catalogue
from stages.views import (
    Views,
    doubt_drawings,
    node_places,
    observation_points,
    palette,
    progress_line,
    scene_nodes,
    table_plane,
)
from tests.stages.episodes import CATALOGUE, K, outcome, plan, scene, transfer, translation

CATALOGUE_DATA = Catalogue.load(Path(CATALOGUE))
SCENE = scene({"tray": "table", "cup": "tray", "soup_can": "table"}, beside={"soup_can": "tray"})
T_CAMERA_CUP = np.array([[1.0, 0, 0, 0], [0, -0.6, -0.8, 0], [0, 0.8, -0.6, 0.8], [0, 0, 0, 1]])
JOINTS = ("torso_lift_joint", "shoulder_pan_joint")


def cup(T: np.ndarray = T_CAMERA_CUP) -> ObjectPose:
    box = np.array([300.0, 200, 360, 280])
    return ObjectPose(name="cup", label="cup", T_camera_object=T, confidence=0.9, cost=1.5, box=box)


def frame() -> Frame:
    renderer = Renderer(640, 480)
    items, camera = [Item(CATALOGUE_DATA["cup"].mesh, T_CAMERA_CUP)], Camera(K=K, T_world_camera=np.eye(4))
    rgb, depth = renderer.color(items, camera), renderer.depth(items, camera)
    renderer.close()
    return Frame(
        rgb=rgb,
        depth=depth,
        K=K,
        T_base_camera=translation(0.1, 0, 1.4),
        robot_mask=None,
        name="goal",
        index=0,
        total=0,
    )


def observation(seen: Frame) -> Observation:
    return Observation(
        depth=seen.depth,
        rgb=seen.rgb,
        foreground=seen.depth > 0,
        K=K,
        T_camera_table=np.eye(4),
        T_base_camera=seen.T_base_camera,
    )


def posterior() -> Posterior:
    rows = np.array([[0.0, 0.1, 0, 0.8], [0, -0.1, 0, 0.8], [5, 0.01, 0, 0.8], [5, -0.01, 0, 0.8]])
    trace = ParticleTrace(iterations=(0, 5), costs=np.array([9.0, 1.5]), positions=rows)
    return Posterior(index=0, count=1, objects=(cup(),), log_weight=-1.5, traces=(trace,))


def estimate() -> SceneEstimate:
    return SceneEstimate(
        objects=(cup(),),
        winner=0,
        log_weights=np.array([-1.5, -4.0]),
        left_out=2,
        T_camera_table=np.eye(4),
        T_base_camera=translation(0.1, 0, 1.4),
        K=K,
        name="goal",
    )


def every_message() -> list[Message]:
    """One message of every type that is drawn, in the order of an episode."""
    seen = frame()
    step = transfer("cup", "table", "tray")
    box = Candidate(box=np.array([300.0, 200, 360, 280]), label="cup", confidence=0.9)
    motion = np.linspace([0.3, 0.0], [0.35, 0.5], 20)
    zeros = np.zeros(2)
    return [
        Arrangement(kind="goal"),
        RobotState(joint_names=JOINTS, positions=zeros, gripper_width=0.1, time=0.0),
        LookRequest(purpose="goal"),
        Snapshot(names=("cup",), T_base_objects=np.eye(4)[None], joint_names=JOINTS, joint_positions=zeros, time=1.0),
        seen,
        Candidates(candidates=(box,), labels=("cup",), confidences=np.array([[0.9]])),
        observation(seen),
        posterior(),
        estimate(),
        SCENE,
        Goal(name="breakfast", scene=SCENE, pddl=""),
        plan(step),
        TransferRequest(transfer=step, scene=SCENE, number=1),
        RobotCommand(joint_names=JOINTS, times=np.linspace(0, 1, 20), positions=motion, velocities=0 * motion),
        outcome(1, step),
        Verdict(goal_name="breakfast", success=True, failed_stage="", reason="", satisfied=(), violated=()),
    ]


@pytest.fixture(scope="module")
def drawn() -> dict[str, list[Drawing]]:
    views = Views({"world": {"seed": 0}, "ranker": {}, "camera": {"catalogue": CATALOGUE}})
    return {type(message).__name__: list(views.draw(message)) for message in every_message()}


def paths_of(drawings: list[Drawing], kind: type[Any]) -> list[str]:
    return [item.path for item in drawings if isinstance(item, kind)]


def panels(layout: Layout) -> list[Panel]:
    match layout:
        case Panel():
            return [layout]
        case Row(parts) | Column(parts) | Tabs(parts):
            return [panel for part in parts for panel in panels(part)]


def test_every_message_but_a_posterior_shows_something(drawn: dict[str, list[Drawing]]) -> None:
    assert [name for name, drawings in drawn.items() if not drawings] == ["Posterior"]


def test_every_panel_shows_something(drawn: dict[str, list[Drawing]]) -> None:
    paths = [item.path for drawings in drawn.values() for item in drawings if not isinstance(item, NextStep)]
    for panel in panels(Views({"camera": {"catalogue": CATALOGUE}}).layout()):
        assert any(path == panel.origin or path.startswith(f"{panel.origin}/") for path in paths), panel.name


def test_candidates_are_labelled_with_their_confidence(drawn: dict[str, list[Drawing]]) -> None:
    (boxes,) = drawn["Candidates"]
    assert isinstance(boxes, Boxes2D)
    assert boxes.labels == ("cup 0.90",) and boxes.colors == (palette(list(CATALOGUE_DATA.objects))["cup"],)


def test_observed_points_lie_on_the_rendered_object() -> None:
    seen = frame()
    (points,) = [item for item in observation_points(observation(seen)) if isinstance(item, Points3D)]
    local = (points.positions - T_CAMERA_CUP[:3, 3]) @ T_CAMERA_CUP[:3, :3]
    low, high = CATALOGUE_DATA["cup"].bounds
    assert len(local) > 500
    assert (local > low - 0.002).all() and (local < high + 0.002).all()


def test_an_estimate_replays_the_particles_and_ranks_the_hypotheses(drawn: dict[str, list[Drawing]]) -> None:
    drawings = drawn["SceneEstimate"]
    assert sum(isinstance(item, NextStep) for item in drawings) == 2
    assert [item.value for item in drawings if isinstance(item, Scalar)] == [9.0, 1.5]
    assert [len(item.positions) for item in drawings if isinstance(item, Points3D)] == [2, 2]
    (bars,) = [item for item in drawings if isinstance(item, BarChart)]
    assert bars.values.tolist() == [2.5, 0.0]


def test_the_overlay_shows_the_estimated_object_over_the_observation(drawn: dict[str, list[Drawing]]) -> None:
    (overlay,) = [item for item in drawn["SceneEstimate"] if isinstance(item, Image)]
    colourful = np.ptp(overlay.rgb.astype(int), axis=2) > 10
    assert colourful[200:320, 270:370].any() and not colourful[:100].any()


def test_objects_stand_in_the_world_where_the_scene_says(drawn: dict[str, list[Drawing]]) -> None:
    placed = {item.path: item.T for item in drawn["SceneGraph"] if isinstance(item, Transform)}
    for item in SCENE.objects:
        assert np.array_equal(placed[f"world/objects/{item.name}"], item.T_base_object)
    assert "world/objects/cup/mesh" in paths_of(drawn["SceneGraph"], Mesh3D)


def test_a_plan_shows_objects_where_it_puts_them(drawn: dict[str, list[Drawing]]) -> None:
    (ghost,) = [item for item in drawn["Plan"] if isinstance(item, Lines3D)]
    target = transfer("cup", "table", "tray").T_base_targets[0]
    assert ghost.path == "world/plan/cup"
    middle = np.mean(np.concatenate(ghost.strips)[:, :2], axis=0)
    np.testing.assert_allclose(middle, target[:2, 3], atol=0.03)
    assert ghost.path in paths_of(drawn["Outcome"], Clear), "it is there itself"


def test_a_scene_graph_links_objects_and_regions() -> None:
    graph = scene_nodes("graph/scene", SCENE, CATALOGUE_DATA)
    assert isinstance(graph, Graph)
    assert set(graph.edges) == {
        ("table", "tray"), ("tray", "cup"), ("table", "soup_can"),
        ("tray", "soup_can_near_tray"), ("soup_can_near_tray", "soup_can"),
    }  # fmt: skip
    assert "in: cup" in graph.labels and "beside tray" in graph.labels


def test_no_two_nodes_of_a_scene_graph_share_a_place() -> None:
    places = node_places(SCENE)
    assert len(set(places.values())) == len(places) == 5
    assert places["table"][1] < places["tray"][1] < places["soup_can_near_tray"][1] < places["cup"][1]


def test_objects_that_are_gone_leave_the_world() -> None:
    views = Views({"camera": {"catalogue": CATALOGUE}})
    list(views.draw(SCENE))
    assert paths_of(list(views.draw(scene({"tray": "table"}))), Clear) == [
        "world/objects/cup",
        "world/objects/soup_can",
    ]


def test_the_support_plane_lies_below_the_objects() -> None:
    far = msgspec.structs.replace(SCENE, T_base_table=translation(5.0, 5.0, 0.7))
    vertices = table_plane(far).vertices
    assert np.allclose(vertices[:, 2], 0.699) and np.allclose(vertices.mean(axis=0)[:2], [0.7, 0.12])


def test_the_robot_is_drawn_once_and_then_moves(drawn: dict[str, list[Drawing]]) -> None:
    assert paths_of(drawn["RobotState"], Mesh3D) and not paths_of(drawn["Snapshot"], Mesh3D)
    poses = [item.T for item in drawn["RobotCommand"] if isinstance(item, Transform) and "shoulder_pan" in item.path]
    assert len(poses) > 2 and not np.allclose(poses[0], poses[-1])


def test_an_estimate_of_another_image_is_drawn_without_its_frame() -> None:
    views = Views({"camera": {"catalogue": CATALOGUE}})
    drawings = list(views.draw(estimate()))
    assert not paths_of(drawings, Image) and paths_of(drawings, BarChart)


def doubtful() -> SceneEstimate:
    """An estimate that may be turned round, that the image contradicts, beside something unknown."""
    other = Alternative(T_camera_object=T_CAMERA_CUP @ np.diag([-1.0, -1, 1, 1]), probability=0.25)
    item = msgspec.structs.replace(
        cup(), probability=0.7, spread_metres=0.004, spread_radians=0.2, alternatives=(other,), contradicted=True
    )
    region = UnknownRegion(
        box=np.array([10.0, 20, 50, 60]),
        points=900,
        centre_table=np.array([0.1, 0.2, 0.05]),
        extent_table=np.array([0.04, 0.06, 0.1]),
    )
    return msgspec.structs.replace(
        estimate(), objects=(item,), probabilities=np.array([0.8, 0.2]), unknown=(region,), log_weights=np.zeros(2)
    )


def test_doubt_is_drawn() -> None:
    views = Views({"camera": {"catalogue": CATALOGUE}})
    list(views.draw(frame()))
    list(views.draw(estimate()))
    drawings = list(views.draw(doubtful()))
    (bars,) = [item for item in drawings if isinstance(item, BarChart)]
    assert bars.values.tolist() == [0.8, 0.2]
    assert paths_of(drawings, Image) == ["estimate/rgb"]
    assert "world/camera/doubt" in paths_of(drawings, Clear)
    (boxes,) = [item for item in drawings if isinstance(item, Boxes2D)]
    assert boxes.labels == ("contradicted", "unknown") and len(boxes.boxes) == len(boxes.colors) == 2
    (page,) = [item for item in drawings if isinstance(item, Text)]
    assert "probability 0.80" in page.markdown and "| cup | 0.70 | 4 mm 11° |" in page.markdown
    assert "or another pose (0.25)" in page.markdown and "4 x 6 x 10 cm, 900 readings" in page.markdown


def test_ghosts_and_boxes_stand_where_they_belong() -> None:
    lines = {
        item.path: np.concatenate(item.strips)
        for item in doubt_drawings(doubtful(), CATALOGUE_DATA)
        if isinstance(item, Lines3D)
    }
    unknown = lines["world/camera/doubt/unknown_1"]
    assert unknown.min(0) == pytest.approx([0.08, 0.17, 0.0]) and unknown.max(0) == pytest.approx([0.12, 0.23, 0.1])
    for path in ("world/camera/doubt/cup_0", "world/camera/doubt/cup_contradicted"):
        local = (lines[path] - T_CAMERA_CUP[:3, 3]) @ T_CAMERA_CUP[:3, :3]
        low, high = CATALOGUE_DATA["cup"].bounds
        assert (local > low - 0.003).all() and (local < high + 0.003).all()


def test_progress_tells_the_story(drawn: dict[str, list[Drawing]]) -> None:
    (page,) = [item for item in drawn["Verdict"] if isinstance(item, Text)]
    assert page.markdown.startswith("- the person lays out the **goal** scene")
    assert "- transfer 1 felt to stand" in page.markdown and page.markdown.endswith("**restored**: ")
    failed = outcome(3, transfer("cup", "table", "tray"), failed_stage="ik", reason="out of reach")
    assert progress_line(failed) == "transfer 3 failed at ik: out of reach"
    assert progress_line(Restore(name="tea")) == "asked to restore **tea**"


def test_who_calibrates_a_camera_needs_no_catalogue() -> None:
    assert panels(Views({"arm": {}, "calibrator": {}}).layout())
