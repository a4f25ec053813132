"""A ROS 2 bag in, scene graphs out: the graph that the README shows, on the frame of the reference recording."""

import json
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from runner.testing import run_graph
from stages.devices.recorded import RecordedFrames
from stages.messages import Frame, Observation, SceneGraph
from tests.stages.devices.ros2.bags import START, looks, write_bag

ROOT = Path(__file__).parents[1]
T_BASE_CAMERA = np.array([[0, -0.6, 0.8, 0.1], [-1, 0, 0, 0], [0, -0.8, -0.6, 1.1], [0, 0, 0, 1.0]])


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_gives_a_scene_graph_for_each_look(tmp_path: Path, storage: Literal["mcap", "sqlite3"]) -> None:
    (frame,) = RecordedFrames(ROOT / "recordings" / "reference.mcap")
    messages = looks(frame.rgb, frame.depth, frame.K, T_BASE_CAMERA, [START, START + 10**9])
    bag = write_bag(tmp_path / "bag", messages, storage=storage)
    run = run_graph(ROOT / "graphs" / "bag.yaml", f"camera.bag={bag}", "camera.times=[0.5]", folder=tmp_path)
    assert run.code == 0, run.output
    assert "looks: 1, scene graphs in" in run.output
    (seen,), (graph,) = run.messages(Frame), run.messages(SceneGraph)
    assert np.array_equal(seen.rgb, frame.rgb) and seen.stamp_ns == START + 10**9
    assert np.abs(seen.depth - frame.depth).max() <= 0.0005001  # a bag has millimetres
    assert run.messages(Observation)[0].T_base_camera == pytest.approx(T_BASE_CAMERA)
    assert {"sugar_box", "cup", "soup_can"} <= {item.label for item in graph.objects}
    assert graph.frame == "base"
    (written,) = run.recording.with_suffix("").glob("look-*.json")
    assert set(json.loads(written.read_text())["objects"]) == {item.name for item in graph.objects}


@pytest.mark.slow
def test_a_look_without_depth_is_no_empty_table(tmp_path: Path) -> None:
    (frame,) = RecordedFrames(ROOT / "recordings" / "reference.mcap")
    bag = write_bag(tmp_path / "bag", looks(frame.rgb, 0 * frame.depth, frame.K, T_BASE_CAMERA, [START]))
    run = run_graph(ROOT / "graphs" / "bag.yaml", f"camera.bag={bag}", folder=tmp_path)
    assert run.code == 1, run.output
    assert "nothing is known of 1 of them: 0.000 s: no support plane" in run.output
    (written,) = run.recording.with_suffix("").glob("look-*.json")
    assert "the depth image has 0 readings" in json.loads(written.read_text())["unusable"]
