"""The support plane, rendered and real."""

import json
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.contract import Refused
from stages.devices.bop import read_dataset
from stages.devices.bop_detections import read_detections
from stages.geometry import regions
from stages.geometry.poses import inverse, pose
from stages.messages import Candidate, Frame
from stages.perception.observation.plane import find_plane, height_above, support_region
from stages.perception.observation.preprocessing import preprocess
from stages.scene.catalogue import Catalogue
from tests.stages.perception.scenes import DATA, VIEW, K, camera, render, upright

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


NOTHING = np.zeros((VIEW.height, VIEW.width), np.float32)
CLOUD = np.random.default_rng(1).uniform(0.4, 1.4, NOTHING.shape).astype(np.float32)
LINE = np.where(np.arange(VIEW.height)[:, None] == 120, np.float32(0.8), np.float32(0)) + NOTHING


@pytest.mark.parametrize("depth", [NOTHING, CLOUD, LINE], ids=["no readings", "no plane", "one line"])
@pytest.mark.parametrize("up", [None, np.array([0.0, -1.0, 0.0])], ids=["", "gravity known"])
def test_no_plane_is_found_where_none_is(depth: np.ndarray, up: np.ndarray | None) -> None:
    assert find_plane(depth, VIEW, np.random.default_rng(0), objects=np.zeros((0, 4)), up=up) is None


@given(pitch=st.floats(0.25, 1.5), distance=st.floats(0.5, 1.5), seed=st.integers(0, 100))
@settings(max_examples=12)
def test_an_empty_table_is_found_from_anywhere(pitch: float, distance: float, seed: int) -> None:
    truth = camera(distance=distance, pitch=pitch)
    rng = np.random.default_rng(seed)
    rays, normal = VIEW.rays(), truth[:3, 2]
    slope = (rays * normal).sum(-1)
    depth = np.where(slope < -0.05, (normal @ truth[:3, 3]) / np.minimum(slope, -0.05), 0.0)
    depth = np.where((depth > 0) & (depth < 3), depth + rng.normal(0, 0.002, depth.shape), 0).astype(np.float32)
    T = find_plane(depth, VIEW, rng, objects=np.array([[*truth[:3, 3], 0.1]]), up=None)
    assert T is not None
    assert tilt(T, truth) < 0.3
    assert abs((inverse(truth) @ T)[2, 3]) < 0.002


def frame_of(depth: np.ndarray, **known: np.ndarray | None) -> Frame:
    given = {"T_base_camera": None, "robot_mask": None} | known
    return Frame(rgb=np.zeros((*depth.shape, 3), np.uint8), depth=depth, K=K, name="scene 7 image 3", index=0, total=1,
                 **given)  # fmt: skip


@pytest.mark.parametrize("depth", [NOTHING, CLOUD, LINE, NOTHING * np.nan], ids=["none", "cloud", "line", "nan"])
def test_an_image_without_a_plane_is_refused_in_one_line(depth: np.ndarray) -> None:
    with pytest.raises(Refused, match="scene 7 image 3: no support plane; the depth image has") as refusal:
        preprocess(frame_of(depth), [], np.random.default_rng(0), max_height=0.6)
    assert "\n" not in str(refusal.value)


def truths(name: str) -> list[tuple[Path, np.ndarray]]:
    """Images with a known camera in the world, whose table is z = 0: depth file and T_camera_world."""
    found: list[tuple[Path, np.ndarray]] = []
    for file in sorted((DATA / name / "test").glob("*/scene_camera.json")):
        for number, entry in json.loads(file.read_text()).items():
            T = pose(np.reshape(entry["cam_R_w2c"], (3, 3)), np.array(entry["cam_t_w2c"]) / 1000)
            found.append((file.parent / "depth" / f"{int(number):06d}.png", T))
    return found


@pytest.mark.parametrize("name", ["household-layout", "clutter-ycb"])
def test_tables_of_the_data_sets(name: str) -> None:
    if not (DATA / name).exists():
        pytest.skip("the data sets are not beside the repository (../shared/data)")
    names = {item.label: item.name for item in Catalogue.load(DATA / name / "models").objects.values()}
    boxes = list(read_detections(DATA / name / "detections_exact.json", names))
    cameras = {(image.scene_id, image.image_id): image for image in read_dataset(DATA / name)}
    for file, T_camera_world in truths(name)[::4]:
        image = cameras[int(file.parent.parent.name), int(file.stem)]
        here = [box for box in boxes if (box.scene_id, box.image_id) == (image.scene_id, image.image_id)]
        candidates = [Candidate(box=box.box, label=box.label, confidence=1.0) for box in here]
        frame = msgspec.structs.replace(frame_of(image.read()[1]), K=image.K)
        seen = preprocess(frame, candidates, np.random.default_rng(0), max_height=0.6)
        assert tilt(seen.T_camera_table, T_camera_world) < 0.1
        assert abs((inverse(T_camera_world) @ seen.T_camera_table)[2, 3]) < 0.002


@pytest.mark.parametrize("scene", [1, 2, 3, 4, 5])
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


def seen_surface(edge: float, *, stray: int = 0, elsewhere: bool = False) -> np.ndarray:
    """The surface that is seen of a table that ends at y = ``edge`` of its frame, with objects on it, above a floor."""
    seen = render(PLACED, noise=0.002).scene
    T, rng = camera(), np.random.default_rng(0)
    rays = VIEW.rays()
    at_plane = rays / np.maximum((rays * T[:3, 2]).sum(-1) / (T[:3, 2] * T[:3, 3]).sum(), 1e-6)[..., None]
    y = ((at_plane - T[:3, 3]) @ T[:3, :3])[..., 1]
    gone = (y < edge) & ~((y < edge - 0.15) & elsewhere)
    depth = np.where(gone, seen.depth * 1.5, seen.depth)
    rows, columns = np.nonzero(gone)
    chosen = rng.choice(len(rows), stray, replace=False)
    depth[rows[chosen], columns[chosen]] = seen.depth[rows[chosen], columns[chosen]]
    region = support_region(depth.astype(np.float32), VIEW, T)
    assert region is not None
    return region


@pytest.mark.parametrize(("stray", "elsewhere"), [(0, False), (10, False), (0, True)])
def test_the_surface_ends_where_the_table_does(stray: int, elsewhere: bool) -> None:
    """Neither single readings at its height nor another table beyond a gap widen it."""
    region = seen_surface(-0.05, stray=stray, elsewhere=elsewhere)
    assert regions.area(region) > 0.1
    assert region[:, 1].min() == pytest.approx(-0.05, abs=0.008)


def test_no_surface_is_seen_where_there_is_no_reading() -> None:
    assert support_region(np.zeros((VIEW.height, VIEW.width), np.float32), VIEW, camera()) is None


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_few_pixels_show_as_much_of_a_table(stride: int) -> None:
    """A table of 0.8 m by 0.6 m in an image of down to 80 x 60 pixels."""
    T, depth = camera(), render({}, noise=0.002).scene.depth
    x, y = np.moveaxis((VIEW.rays() * depth[..., None] - T[:3, 3]) @ T[:3, :2], -1, 0)
    on_it = np.where((abs(x) < 0.4) & (abs(y) < 0.3), depth, np.float32(0))
    view = VIEW.sampled(0, 0, VIEW.width, VIEW.height, stride)
    region = support_region(np.ascontiguousarray(on_it[::stride, ::stride]), view, T)
    assert region is not None
    assert regions.area(region) == pytest.approx(0.8 * 0.6, rel=0.15)
