"""Perception as a library call."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from runner.contract import Context, Refused
from stages.estimate import Box, EstimatedScene, estimate_scene
from stages.geometry.lens import INVERSE, Lens
from stages.geometry.poses import inverse, pose
from stages.messages import Candidate, Candidates, Frame
from tests.stages.perception.scenes import CATALOGUE_FILE, VIEW, K, Rendered, camera, render, upright

PLACED = {"mug": upright("mug", -0.05, 0.0, 0.6), "tea_box": upright("tea_box", 0.1, 0.06, 0.2)}
RGB = np.zeros((VIEW.height, VIEW.width, 3), np.uint8)


@pytest.fixture(scope="module")
def seen() -> Rendered:
    return render(PLACED)


def boxes(seen: Rendered, *labels: str) -> list[Box]:
    return [(label, seen.boxes[label].tolist()) for label in labels]


def estimated(seen: Rendered, given: Sequence[Box]) -> EstimatedScene:
    return estimate_scene(RGB, seen.scene.depth, K, CATALOGUE_FILE, boxes=given, dof=3)


def test_an_image_gives_poses_probabilities_and_relations(seen: Rendered) -> None:
    found = estimated(seen, [*boxes(seen, "mug", "tea_box"), ("sponge", seen.boxes["tea_box"].tolist(), 0.4)])
    assert sorted(item.name for item in found.objects) == ["mug", "tea_box"]
    for item in found.objects:
        assert item.T_camera_object[:3, 3] == pytest.approx(seen.poses[item.name][:3, 3], abs=0.003)
        assert item.probability is not None and item.probability > 0.5
        assert item.confidence == 1.0
    assert {"exist(mug)", "clear(tea_box)", "on(mug, table)"} <= {str(relation) for relation in found.relations}
    assert found.unknown == () and found.graph.frame == "table"


def test_what_has_no_box_is_an_unknown_region() -> None:
    stranger = render({**PLACED, "salt_shaker": upright("salt_shaker", 0.02, -0.06, 0.0)})
    found = estimated(stranger, boxes(stranger, "mug", "tea_box"))
    assert sorted(item.name for item in found.objects) == ["mug", "tea_box"]
    (region,) = found.unknown
    x0, y0, x1, y1 = stranger.boxes["salt_shaker"]
    assert x0 <= region.box[[0, 2]].mean() <= x1 and y0 <= region.box[[1, 3]].mean() <= y1


def test_equal_calls_give_equal_bytes(seen: Rendered) -> None:
    one, other = (estimated(seen, boxes(seen, "mug", "tea_box")) for _ in range(2))
    for a, b in zip(one.objects, other.objects, strict=True):
        assert (a.name, a.probability) == (b.name, b.probability)
        assert a.T_camera_object.tobytes() == b.T_camera_object.tobytes()


def test_a_lens_that_bends_the_image_is_taken_out(seen: Rendered) -> None:
    lens = (-0.12, 0.03, 0.001, -0.001, 0.0)
    rgb, depth = Lens(K, seen.scene.depth.shape, lens, INVERSE).straighten(RGB, seen.scene.depth)
    given = boxes(seen, "mug", "tea_box")
    found = estimate_scene(rgb, depth, K, CATALOGUE_FILE, boxes=given, dof=3, distortion=lens)
    for item in found.objects:
        assert item.T_camera_object[:3, 3] == pytest.approx(seen.poses[item.name][:3, 3], abs=0.004)
    with pytest.raises(Refused, match="distortion: distortion model 'plumb_bob' does not have 2 coefficients"):
        estimate_scene(rgb, depth, K, CATALOGUE_FILE, boxes=given, distortion=lens[:2])


class One:
    """A detector that sees a mug."""

    def __init__(self, box: np.ndarray) -> None:
        self.box = box

    def on_frame(self, frame: Frame, ctx: Context) -> Candidates:
        mug = Candidate(box=self.box, label="mug", confidence=0.8)
        return Candidates(candidates=(mug,), labels=("mug",), confidences=np.array([[0.8]]))


def test_a_detector_gives_boxes(seen: Rendered) -> None:
    depth = seen.scene.depth.astype(np.float64)
    found = estimate_scene(
        RGB, depth, K, CATALOGUE_FILE, detector=One(seen.boxes["mug"]), dof=3, T_base_camera=inverse(camera())
    )
    assert [item.name for item in found.objects] == ["mug"]
    assert found.graph.frame == "base"


def test_the_lines_of_the_readme_run(seen: Rendered, capsys: pytest.CaptureFixture[str]) -> None:
    text = (Path(__file__).parents[2] / "README.md").read_text()
    (lines,) = [code for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "estimate_scene" in code]
    lines = lines.replace('"DIR/models"', "catalogue")
    given = {"rgb": RGB, "depth": seen.scene.depth, "K": K, "catalogue": CATALOGUE_FILE, "boxes": boxes(seen, "mug")}
    exec(lines, given)
    assert "mug" in capsys.readouterr().out


def test_inputs_are_checked(seen: Rendered, tmp_path: Path) -> None:
    depth, given = seen.scene.depth, boxes(seen, "mug")
    with pytest.raises(Refused, match=r"rgb is float64 .*; H x W x 3 of uint8 is expected"):
        estimate_scene(RGB / 255, depth, K, CATALOGUE_FILE, boxes=given)  # type: ignore[arg-type]
    with pytest.raises(Refused, match=r"depth is uint16 .* of floats, metres, is expected"):
        estimate_scene(RGB, (1000 * depth).astype(np.uint16), K, CATALOGUE_FILE, boxes=given)  # type: ignore[arg-type]
    with pytest.raises(Refused, match=r"median depth is 7\d\d\..* m; metres are expected, 0\.05 to 20"):
        estimate_scene(RGB, 1000 * depth, K, CATALOGUE_FILE, boxes=given)
    with pytest.raises(Refused, match=r"K is \(4,\); 3 x 3 is expected"):
        estimate_scene(RGB, depth, np.zeros(4), CATALOGUE_FILE, boxes=given)
    with pytest.raises(Refused, match=r"K = .*: must be fx 0 cx, .* without skew"):
        estimate_scene(RGB, depth, K + np.diag([2.0, 0], 1), CATALOGUE_FILE, boxes=given)
    with pytest.raises(Refused, match="'teapot' is not in the catalogue"):
        estimate_scene(RGB, depth, K, CATALOGUE_FILE, boxes=[("teapot", (0, 0, 9, 9))])
    with pytest.raises(Refused, match=r"box of mug: .* is not x0, y0, x1, y1 with x0 < x1"):
        estimate_scene(RGB, depth, K, CATALOGUE_FILE, boxes=[("mug", (9, 9, 0, 0))])
    with pytest.raises(Refused, match="image: no support plane; the depth image has 0 readings"):
        estimate_scene(RGB, np.zeros_like(depth), K, CATALOGUE_FILE, boxes=given)
    with pytest.raises(Refused, match="no such catalogue"):
        estimate_scene(RGB, depth, K, tmp_path / "none.yaml", boxes=given)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (np.eye(4)[:3], r"\[\[.* is no pose; 4 x 4, a rotation and metres above 0 0 0 1, is"),
        (np.diag([2.0, 2, 2, 1]), r"\[\[2\.0, .* is no pose; 4 x 4"),
        (np.diag([1.0, 1, np.nan, 1]), r".* nan, .* is no pose; 4 x 4"),
        (pose(np.eye(3), np.array([0.0, 0, 1200])), "the camera is 1200 m away; metres are expected, 100 at most"),
    ],
)
def test_where_the_camera_is_is_checked(seen: Rendered, wrong: np.ndarray, says: str) -> None:
    with pytest.raises(Refused, match="^T_base_camera: " + says):
        estimate_scene(RGB, seen.scene.depth, K, CATALOGUE_FILE, boxes=boxes(seen, "mug"), T_base_camera=wrong)


def test_boxes_and_confidences_are_finite_numbers_and_images_have_pixels(seen: Rendered) -> None:
    depth = seen.scene.depth
    for box in ((0, 0, np.nan, 9), (0, 0, np.inf, 9), (0, 0, 9)):
        with pytest.raises(Refused, match=r"box of mug: .* is not x0, y0, x1, y1 with x0 < x1"):
            estimate_scene(RGB, depth, K, CATALOGUE_FILE, boxes=[("mug", box)])
    for confidence in (np.nan, 7.0, -0.1):
        with pytest.raises(Refused, match=rf"box of mug: confidence {confidence:g} must lie from 0 to 1"):
            estimate_scene(RGB, depth, K, CATALOGUE_FILE, boxes=[("mug", (0, 0, 9, 9), confidence)])
    with pytest.raises(Refused, match=r"rgb is uint8 \(0, 320, 3\); H x W x 3 .*, of a pixel or more"):
        estimate_scene(RGB[:0], depth[:0], K, CATALOGUE_FILE, boxes=boxes(seen, "mug"))


def test_a_catalogue_that_the_network_does_not_know_needs_boxes(seen: Rendered, tmp_path: Path) -> None:
    mesh = CATALOGUE_FILE.parent / "meshes" / "cup.ply"
    ours = tmp_path / "ours.yaml"
    ours.write_text(f"objects:\n  beaker:\n    mesh: {{file: {mesh}, unit: m}}\n")
    with pytest.raises(Refused, match=r"does not know beaker .*; give boxes, or a detector that knows"):
        estimate_scene(RGB, seen.scene.depth, K, ours)
