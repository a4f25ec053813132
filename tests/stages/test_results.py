"""What is written of looks, and how a graph ends at some of which nothing was to be seen."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from stages.messages import Frame
from stages.results import BopResults, SceneGraphs
from tests.stages.episodes import Recorded
from tests.stages.layouts import CATALOGUE, Layout, builder

SEEN = Layout().put("mug", 0.0, 0.0).estimate()
BLIND = msgspec.structs.replace(SEEN, objects=(), unusable="look 1: no support plane")
FRAME = Frame(
    rgb=np.zeros((4, 6, 3), np.uint8), depth=np.zeros((4, 6), np.float32), K=SEEN.K, T_base_camera=None,
    robot_mask=None, name="look", index=0, total=2,
)  # fmt: skip


@pytest.mark.parametrize("kind", ["looks", "images"])
def test_an_image_in_which_nothing_was_to_be_seen_is_no_empty_table(kind: str, tmp_path: Path) -> None:
    results = BopResults.Config(path=str(tmp_path / "out.csv"), catalogue=CATALOGUE)
    stage = SceneGraphs() if kind == "looks" else BopResults(results)
    ctx = Recorded()
    ctx.directory = tmp_path
    frames = [msgspec.structs.replace(FRAME, index=k, image_id=k) for k in range(2)]
    assert stage.on_scene_graph(frames[0], SEEN, builder().on_scene_estimate(SEEN), ctx) is None
    ended = stage.on_scene_graph(frames[1], BLIND, builder().on_scene_estimate(BLIND), ctx)
    assert ended is not None and ended.code == 1
    assert ended.reason.endswith("; nothing is known of 1 of them: look 1: no support plane")
    assert "nothing is known: look 1: no support plane" in ctx.lines[-1] and "sure of" not in ctx.lines[-1]
    first, second = (json.loads(file.read_text()) for file in sorted(tmp_path.rglob("*.json")))
    assert "unusable" not in first and second["unusable"] == "look 1: no support plane"
