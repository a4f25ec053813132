"""The support plane, rendered and real."""

import json

import cv2
import numpy as np
import pytest

from stages.messages import Candidate, Frame
from stages.perception.plane import find_plane, height_above
from stages.perception.poses import inverse
from stages.perception.preprocessing import preprocess
from tests.stages.perception.scenes import DATA, VIEW, camera, render, upright

PLACED = {"mug": upright("mug", 0.0, 0.0, 0.6), "tray": upright("tray", 0.1, 0.1, 0.2)}


def tilt(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.rad2deg(np.arccos(min(1.0, found[:3, 2] @ true[:3, 2]))))


@pytest.mark.parametrize("seed", range(3))
def test_the_table_is_found_under_objects(seed: int) -> None:
    seen = render(PLACED, noise=0.002, seed=seed)
    objects = np.stack([np.append(seen.poses[label][:3, 3], r) for label, r in (("mug", 0.05), ("tray", 0.2))])
    T = find_plane(seen.scene.depth, VIEW, np.random.default_rng(seed), objects=objects, up=None)
    assert T is not None
    assert tilt(T, camera()) < 0.3
    assert abs((inverse(camera()) @ T)[2, 3]) < 0.001
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_gravity_excludes_a_wall() -> None:
    rays = VIEW.rays()
    floor = 0.3 / np.maximum(rays[..., 1], 1e-3)
    depth = np.minimum(floor, 1.0).astype(np.float32)  # a near wall fills most of the image
    up = np.array([0.0, -1.0, 0.0])
    rng = np.random.default_rng(0)
    wall = find_plane(depth, VIEW, rng, objects=np.zeros((0, 4)), up=None)
    level = find_plane(depth, VIEW, rng, objects=np.zeros((0, 4)), up=up)
    assert wall is not None and abs(wall[1, 2]) < 0.01
    assert level is not None and level[:3, 2] == pytest.approx(up, abs=0.01)


def test_heights_are_above_the_plane() -> None:
    seen = render({"mug": PLACED["mug"]}, noise=0.0)
    height = height_above(seen.scene.depth, VIEW, camera())
    assert height[seen.scene.foreground].max() == pytest.approx(0.09, abs=0.03)
    table = (seen.scene.depth > 0) & ~seen.scene.foreground
    assert np.abs(height[table]).max() < 1e-3


def test_too_few_readings_give_no_plane() -> None:
    depth = np.zeros((VIEW.height, VIEW.width), np.float32)
    assert find_plane(depth, VIEW, np.random.default_rng(0), objects=np.zeros((0, 4)), up=None) is None


@pytest.mark.parametrize("scene", [1, 2, 3])
def test_real_tables(scene: int) -> None:
    folder = DATA / "ycb-real" / "test" / f"{scene:06d}"
    if not folder.exists():
        pytest.skip("the data sets are not beside the repository (../shared/data)")
    detections = json.loads((DATA / "ycb-real" / "detections_exact.json").read_text())
    cameras = json.loads((folder / "scene_camera.json").read_text())["0"]
    depth = cv2.imread(str(folder / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED) * np.float32(1e-4)
    boxes = [np.array(d["bbox"]) for d in detections if d["scene_id"] == scene]
    candidates = [Candidate(box=np.append(b[:2], b[:2] + b[2:]), label="", confidence=1.0) for b in boxes]
    frame = Frame(
        rgb=np.zeros((*depth.shape, 3), np.uint8), depth=depth.astype(np.float32),
        K=np.array(cameras["cam_K"]).reshape(3, 3), T_base_camera=None, robot_mask=None, name="", index=0, total=1,
    )  # fmt: skip
    seen = preprocess(frame, candidates, np.random.default_rng(0), max_height=0.6)
    for truth in json.loads((folder / "scene_gt.json").read_text())["0"]:
        height = (inverse(seen.T_camera_table) @ np.append(np.array(truth["cam_t_m2c"]) / 1000, 1))[2]
        # Object origins lie in the middle of the object: above the plane and below its greatest half extent.
        assert -0.005 < height < 0.15


def test_the_robot_is_not_evidence() -> None:
    seen = render(PLACED)
    mask = np.zeros(seen.scene.depth.shape, bool)
    mask[:, :60] = True
    frame = Frame(
        rgb=np.zeros((*mask.shape, 3), np.uint8), depth=seen.scene.depth, K=np.array([[260, 0, 159.5], [0, 260, 119.5],
        [0, 0, 1.0]]), T_base_camera=None, robot_mask=mask, name="", index=0, total=1,
    )  # fmt: skip
    observed = preprocess(frame, [], np.random.default_rng(0), max_height=0.6)
    assert not observed.depth[mask].any() and not observed.foreground[mask].any()
