"""Scenes as ROS 2 tools get them: live, and as a bag of a recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from runner.cli.main import main
from runner.contract import Refused
from runner.message.codec import open_envelope
from runner.recording.recording import Recording
from runner.testing import run_stage
from stages.camera import BagCamera
from stages.devices.ros2.outgoing import Outgoing, Scenes
from stages.devices.ros2.recorded import RecordedScenes
from stages.devices.ros2.settings import Frames, Source
from stages.messages import Frame, ObjectPose, SceneEstimate, SceneGraph
from stages.messages.scene import Alternative
from stages.scene.catalogue import BUILT_IN, Catalogue
from tests.stages.devices.ros2.bags import START, TYPES

REFERENCE = Path(__file__).parents[4] / "recordings" / "reference.mcap"
T_BASE_CAMERA = np.array([[0, -0.6, 0.8, 0.1], [-1, 0, 0, 0], [0, -0.8, -0.6, 1.1], [0, 0, 0, 1.0]])
NAME = "/scene_programming"


@pytest.fixture(scope="module")
def reference() -> tuple[Frame, SceneEstimate, SceneGraph]:
    recording = Recording(REFERENCE)
    ids = "camera.frame#0", "refiner.scene_estimate#0", "scene_graph.scene_graph#0"
    frame, estimate, graph = (
        open_envelope(kind, recording.envelope(id))
        for kind, id in zip((Frame, SceneEstimate, SceneGraph), ids, strict=True)
    )
    return frame, estimate, graph


def in_base(estimate: SceneEstimate, graph: SceneGraph) -> tuple[SceneEstimate, SceneGraph]:
    """The same scene where it is known how the camera stands to the robot."""
    T_base_table = T_BASE_CAMERA @ estimate.T_camera_table
    objects = tuple(
        msgspec.structs.replace(item, T_base_object=T_base_table @ item.T_base_object) for item in graph.objects
    )
    return (
        msgspec.structs.replace(estimate, T_base_camera=T_BASE_CAMERA),
        msgspec.structs.replace(graph, T_base_camera=T_BASE_CAMERA, T_base_table=T_base_table, objects=objects),
    )


def told(estimate: SceneEstimate, graph: SceneGraph) -> dict[str, Any]:
    """By topic, as who hears it reads it."""
    scenes = Scenes(TYPES, Catalogue.shared(BUILT_IN), Frames())
    return {one.topic: heard(one) for one in scenes.scene(estimate, graph, START)}


def heard(one: Outgoing) -> Any:
    return TYPES.decode(TYPES.encode(one.message), one.message.__msgtype__)


def matrix(pose: Any) -> np.ndarray:
    T = np.eye(4)
    turn = pose.orientation
    T[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    T[:3, 3] = pose.position.x, pose.position.y, pose.position.z
    return T


def test_detections_have_poses_probabilities_and_spread(reference: Any) -> None:
    _, estimate, graph = reference
    doubted: ObjectPose = msgspec.structs.replace(
        estimate.objects[0],
        probability=0.7,
        spread_metres=0.03,
        spread_radians=0.3,
        alternatives=(Alternative(T_camera_object=np.eye(4), probability=0.2),),
    )
    changed = msgspec.structs.replace(estimate, objects=(doubted, *estimate.objects[1:]))
    found = told(*in_base(changed, graph))["~/detections"]
    assert (found.header.frame_id, found.header.stamp.sec) == ("base_link", START // 10**9)
    assert [one.id for one in found.detections] == [item.name for item in graph.objects]
    first = next(one for one in found.detections if one.id == doubted.name)
    best, other = first.results
    assert (best.hypothesis.class_id, best.hypothesis.score) == (doubted.label, pytest.approx(0.7))
    assert matrix(best.pose.pose) == pytest.approx(T_BASE_CAMERA @ doubted.T_camera_object, abs=1e-9)
    assert (other.hypothesis.score, matrix(other.pose.pose)[:3, 3]) == (0.2, pytest.approx(T_BASE_CAMERA[:3, 3]))
    covariance = best.pose.covariance.reshape(6, 6)
    assert np.trace(covariance[:3, :3]) == pytest.approx(0.03**2)
    assert np.trace(covariance[3:, 3:]) == pytest.approx(0.3**2)
    size = first.bbox.size
    dimensions = Catalogue.shared(BUILT_IN)[doubted.label].dimensions
    assert [size.x, size.y, size.z] == pytest.approx(dimensions.tolist())


def test_what_was_not_judged_has_the_detectors_confidence(reference: Any) -> None:
    _, estimate, graph = reference
    plain = tuple(msgspec.structs.replace(item, probability=None) for item in estimate.objects)
    found = told(msgspec.structs.replace(estimate, objects=plain), graph)["~/detections"]
    scores = {one.id: one.results[0].hypothesis.score for one in found.detections}
    assert scores == {item.name: pytest.approx(item.confidence) for item in estimate.objects}


def test_transforms_hang_on_the_base_or_on_the_camera(reference: Any) -> None:
    _, estimate, graph = reference
    placed = told(*in_base(estimate, graph))["/tf"].transforms
    assert {one.child_frame_id for one in placed} == {f"scene/{item.name}" for item in graph.objects}
    assert {one.header.frame_id for one in placed} == {"base_link"}
    placed = {one.child_frame_id: one for one in told(estimate, graph)["/tf"].transforms}
    table = placed.pop("scene/table")
    assert table.header.frame_id == "camera_color_optical_frame"
    z = table.transform.translation.z
    assert z == pytest.approx(estimate.T_camera_table[2, 3])
    assert {one.header.frame_id for one in placed.values()} == {"scene/table"}


def test_a_recordings_frames_are_those_of_its_graph(reference: Any) -> None:
    _, estimate, graph = reference
    published = {"ros2": {"frames": {"base": "base", "camera": "eye"}}}
    heard = {"camera": {"topics": {"base_frame": "map"}}}
    for configs, base, camera in (
        (heard | published, "base", "eye"),
        (heard, "map", "camera_color_optical_frame"),
        ({"camera": {}}, "base_link", "camera_color_optical_frame"),
    ):
        for scene, frame in ((in_base(estimate, graph), base), ((estimate, graph), camera)):
            recorded = RecordedScenes(Catalogue.shared(BUILT_IN), configs)
            frame_message = msgspec.structs.replace(reference[0], T_base_camera=scene[0].T_base_camera)
            told = [one for message in (frame_message, *scene) for one in recorded.told(message, START)]
            placed = [TYPES.decode(one.data, one.type).transforms for one in told if one.topic == "/tf"]
            assert frame in {one.header.frame_id for transforms in placed for one in transforms}


def test_poses_in_a_base_without_a_name_are_refused(reference: Any) -> None:
    _, estimate, graph = reference
    scenes = Scenes(TYPES, Catalogue.shared(BUILT_IN), Frames(base=None))
    assert list(scenes.scene(estimate, graph, START))
    with pytest.raises(Refused, match=r"frames\.base is null, but it is known how the camera stands to the robot"):
        list(scenes.scene(*in_base(estimate, graph), START))


def test_markers_are_meshes_with_names_and_replace_the_last_scene(reference: Any) -> None:
    _, estimate, graph = reference
    first, *markers = told(estimate, graph)["~/markers"].markers
    assert first.action == 3
    shapes = [one for one in markers if one.type == 11]
    assert [one.ns for one in shapes] == [item.name for item in graph.objects]
    assert all(len(one.points) == len(one.colors) > 100 and len(one.points) % 3 == 0 for one in shapes)
    assert [one.text.split()[0] for one in markers if one.type == 9] == [item.name for item in graph.objects]


def test_the_scene_graph_is_json(reference: Any) -> None:
    _, estimate, graph = reference
    content = json.loads(told(estimate, graph)["~/scene_graph"].data)
    assert content["assertions"] == [str(one) for one in graph.assertions]
    assert content["labels"] == {item.name: item.label for item in graph.objects}
    assert (content["frame_id"], content["stamp_ns"]) == ("scene/table", START)


def test_of_a_look_at_nothing_only_the_reason_is_told(reference: Any) -> None:
    _, estimate, graph = reference
    blind = msgspec.structs.replace(graph, objects=(), assertions=(), virtual_objects=(), unusable="no support plane")
    (topic, said), *others = told(msgspec.structs.replace(estimate, objects=()), blind).items()
    assert (topic, others) == ("~/scene_graph", [])
    assert json.loads(said.data)["unusable"] == "no support plane"


def test_a_recording_becomes_a_bag_that_others_read_and_that_is_a_camera_again(
    tmp_path: Path, reference: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    frame, _, graph = reference
    target, foreign = tmp_path / "bag", tmp_path / "bag.part" / "foreign"
    foreign.parent.mkdir()
    foreign.touch()
    assert main(["export", str(REFERENCE), "--ros2", str(target)]) == 0
    assert foreign.exists() and {one.name for one in tmp_path.iterdir()} == {"bag", "bag.part"}
    assert f"{target}: 1 messages of {NAME}/detections" in capsys.readouterr().out
    with AnyReader([target]) as reader:
        found = {one.topic: reader.deserialize(data, one.msgtype) for one, _, data in reader.messages()}
    assert {one.id for one in found[f"{NAME}/detections"].detections} == {item.name for item in graph.objects}
    topics = Source(
        color=f"{NAME}/camera/color/image_raw",
        depth=f"{NAME}/camera/depth/image_raw",
        info=f"{NAME}/camera/color/camera_info",
        base_frame=None,
    )
    camera = BagCamera(BagCamera.Config(bag=target, topics=topics))
    (again,) = run_stage(camera)
    camera.close()
    assert np.array_equal(again.rgb, frame.rgb) and np.array_equal(again.depth, frame.depth)
    assert np.array_equal(again.K, frame.K)


def test_a_bag_is_written_into_a_folder_that_is_not_there_yet(tmp_path: Path) -> None:
    assert main(["export", str(REFERENCE), "--ros2", str(tmp_path / "new" / "bag")]) == 0


def test_what_cannot_be_exported_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(REFERENCE), "--ros2", str(tmp_path)]) == 2
    assert f"{tmp_path}: cannot be written: File exists" in capsys.readouterr().err
