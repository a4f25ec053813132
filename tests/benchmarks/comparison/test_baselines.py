"""Every baseline on a small rendered table: plausible, repeatable, and plain about what it cannot do."""

import importlib.util
import sys
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.common.datasets import Image
from benchmarks.comparison.baselines import METHODS, fpfh
from benchmarks.comparison.baselines.observed import Crop, Observed
from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.messages import Candidate, Candidates, Frame
from stages.perception.rendering.rasteriser import Soup, inverse_depth
from stages.scene.metrics import pose_errors
from tests.stages.perception.scenes import CATALOGUE, DATA, VIEW, K, Rendered, render, upright

LABELS = tuple(list(CATALOGUE.objects)[:2])
SCENE = render({LABELS[0]: upright(LABELS[0], -0.12, 0.0, 0.4), LABELS[1]: upright(LABELS[1], 0.13, 0.05, 1.1)})


def image_of(scene: Rendered, labels: tuple[str, ...] = LABELS, n_objects: int | None = None) -> Image:
    rgb = np.zeros((VIEW.height, VIEW.width, 3), np.uint8)
    frame = Frame(
        rgb=rgb, depth=scene.scene.depth, K=K, T_base_camera=None, robot_mask=None, name="test", index=0, total=1,
        n_objects=len(labels) if n_objects is None else n_objects,
    )  # fmt: skip
    boxes = tuple(Candidate(box=scene.boxes[label], label=label, confidence=1.0) for label in labels)
    return Image(frame, Candidates(candidates=boxes, labels=labels, confidences=np.eye(len(labels))), ())


def errors(found: list[tuple[str, Floats, float]]) -> dict[str, tuple[float, float]]:
    return {
        label: pose_errors(T, SCENE.poses[label], CATALOGUE[label].symmetries.transforms()) for label, T, _ in found
    }


def test_icp_is_exact_on_clean_boxes() -> None:
    found = errors(METHODS["icp"](image_of(SCENE), CATALOGUE, dof=3, seed=0))
    assert set(found) == set(LABELS)
    assert all(metres < 0.01 and radians < np.deg2rad(10) for metres, radians in found.values())


@pytest.mark.parametrize("method", ["fpfh", "ppf", "perch", "random"])
def test_every_method_stays_near_its_box_and_repeats(method: str) -> None:
    if method == "fpfh" and importlib.util.find_spec("open3d") is None:
        pytest.skip("Open3D is not installed (pip install '.[benchmarks]')")
    first, second = (METHODS[method](image_of(SCENE), CATALOGUE, dof=3, seed=0) for _ in range(2))
    assert [T.tobytes() for _, T, _ in first] == [T.tobytes() for _, T, _ in second]
    found = errors(first)
    assert set(found) == set(LABELS)
    assert all(metres < (0.05 if method in ("ppf", "perch") else 0.3) for metres, _ in found.values())


def test_with_four_degrees_of_freedom_what_stands_on_another_stays_there_upright() -> None:
    below, above = "tea_box", "tuna_can"
    stacked = upright(above, 0.0, 0.0, 0.0)
    stacked[2, 3] += CATALOGUE[below].dimensions[2]
    scene = render({below: upright(below, 0.0, 0.0, 0.4), above: stacked})
    found = METHODS["ppf"](image_of(scene, (below, above)), CATALOGUE, dof=4, seed=0)
    assert [label for label, _, _ in found] == [below, above]
    for label, T, _ in found:
        metres, _ = pose_errors(T, scene.poses[label], CATALOGUE[label].symmetries.transforms())
        assert metres < 0.01 and T[:3, 2] @ scene.scene.T_camera_table[:3, 2] > np.cos(np.deg2rad(1))


def test_the_same_seed_gives_the_same_bytes_with_six_degrees_of_freedom() -> None:
    first, second = (METHODS["icp"](image_of(SCENE), CATALOGUE, dof=6, seed=3) for _ in range(2))
    assert [T.tobytes() for _, T, _ in first] == [T.tobytes() for _, T, _ in second]


def test_wrong_boxes_are_left_out() -> None:
    image = image_of(SCENE)
    wrong = Candidate(box=np.array([5.0, 5.0, 60.0, 60.0]), label=LABELS[0], confidence=1.0)
    more = replace(image, candidates=Candidates(candidates=(wrong, *image.boxes), labels=LABELS, confidences=np.eye(2)))
    found = METHODS["icp"](more, CATALOGUE, dof=3, seed=0)
    assert sorted(label for label, _, _ in found) == sorted(LABELS)
    assert all(metres < 0.01 for metres, _ in errors(found).values())


def test_no_boxes_give_no_objects() -> None:
    assert METHODS["icp"](image_of(SCENE, ()), CATALOGUE, dof=6, seed=0) == []


@pytest.mark.parametrize("shift", [(0.03, 0.0, 0.0), (0.0, 0.0, -0.03), (0.0, 0.0, 0.03)])
def test_agreement_is_highest_at_the_truth(shift: tuple[float, float, float]) -> None:
    right, wrong = (agreement(T) for T in (SCENE.poses[LABELS[0]], shifted(*shift)))
    assert right > wrong


def test_below_the_table_is_worse_than_nowhere() -> None:
    # Nothing but the table lies in front of a tray that is put 3 cm below it.
    below = SCENE.poses[LABELS[0]].copy()
    below[:3, 3] -= 0.03 * SCENE.scene.T_camera_table[:3, 2]
    assert agreement(below) < 0


def agreement(T_camera_object: Floats) -> float:
    image = image_of(SCENE)
    crop = Crop.around(Observed.of(image, 0), image.boxes[0], 2)
    return crop.agreement(inverse_depth(Soup.of(CATALOGUE[LABELS[0]].mesh), T_camera_object, crop.view))


def shifted(x: float, y: float, z: float) -> Floats:
    moved = SCENE.poses[LABELS[0]].copy()
    moved[:3, 3] += (x, y, z)
    return moved


def test_without_open3d_the_command_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(Refused, match="pip install"):
        fpfh.Described.of_points(np.zeros((10, 3)), np.zeros((10, 3)), 0.005)


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is absent")
def test_icp_finds_every_object_of_a_layout() -> None:
    from benchmarks.common.datasets import detections_file, images
    from stages.scene.catalogue import Catalogue

    dataset = DATA / "household-layout"
    catalogue = Catalogue.load(dataset / "models")
    (image,) = images(dataset, detections_file(dataset, "exact"), 1)
    labels = {item.label: item.name for item in catalogue.objects.values()}
    found = {label: T for label, T, _ in METHODS["icp"](image, catalogue, dof=3, seed=0)}
    for truth in image.truths:
        name = labels[truth.label]
        metres, radians = pose_errors(found[name], truth.T_camera_object, catalogue[name].symmetries.transforms())
        assert metres < 0.01 and radians < np.deg2rad(10)
