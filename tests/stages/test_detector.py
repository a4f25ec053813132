"""The detector stages: what they emit, that they repeat themselves exactly, and how well the network sees."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from runner.contract import Refused
from runner.testing import run_stage
from stages.detector import Detector, ModelDetector, RecordedDetections
from stages.devices.clutter import write_models
from stages.devices.detector_data import examples
from stages.messages import Candidates, Frame
from stages.perception.detection.trained.evaluation import evaluate
from stages.perception.detection.trained.network import DetectionNetwork, Detections
from stages.scene.catalogue import Catalogue
from tests.stages.perception.detection.scenes import NAMES, OBJECTS, photograph, views

ROOT = Path(__file__).parents[2]
CATALOGUE = ROOT / "stages/scene/catalogue.yaml"


def frame(rgb: np.ndarray, *, scene_id: int = 0, image_id: int = 0) -> Frame:
    return Frame(
        rgb=rgb,
        depth=np.zeros(rgb.shape[:2], np.float32),
        K=np.eye(3),
        T_base_camera=None,
        robot_mask=None,
        name="test",
        index=0,
        total=1,
        scene_id=scene_id,
        image_id=image_id,
    )


@pytest.fixture(scope="module")
def image() -> Iterator[np.ndarray]:
    made = examples(Catalogue.load(CATALOGUE), layouts=1, views=1, seed=9, like_robot=True)
    yield next(made).image
    made.close()


def candidates(image: np.ndarray, **settings: Any) -> Candidates:
    (message,) = run_stage(Detector(Detector.Config(**settings)), [frame(image)])
    return message


def test_candidates_carry_their_best_label_and_come_best_first(image: np.ndarray) -> None:
    message = candidates(image)
    assert len(message.candidates) >= 3
    assert message.labels == tuple(Catalogue.load(CATALOGUE).objects)
    assert message.confidences.shape == (len(message.candidates), len(message.labels))
    for candidate, row in zip(message.candidates, message.confidences, strict=True):
        assert candidate.label == message.labels[int(row.argmax())]
        assert candidate.confidence == row.max()
        assert row.sum() <= 1 + 1e-9
    scores = [candidate.confidence for candidate in message.candidates]
    assert scores == sorted(scores, reverse=True)


def test_settings_limit_boxes_and_labels(image: np.ndarray) -> None:
    assert len(candidates(image, threshold=0.05, max_boxes=2).candidates) == 2
    message = candidates(image, labels=("cup", "tray"))
    assert message.labels == ("cup", "tray")
    assert {candidate.label for candidate in message.candidates} <= {"cup", "tray"}


def test_nobody_knows_what_is_missing_of_an_unknown_number_of_objects(image: np.ndarray) -> None:
    doubtful = candidates(image, expected="auto", floor=0.001).candidates
    assert len(doubtful) > len(candidates(image, expected=0).candidates)


def test_a_second_box_of_an_object_is_not_one_of_those_expected() -> None:
    stage = Detector(Detector.Config(expected=2, labels=("cup", "salt_shaker")))
    boxes = np.array([[100.0, 100, 160, 200], [98, 100, 162, 140], [300, 100, 330, 160]])
    confidences = np.array([[0.9, 0.0], [0.5, 0.0], [0.0, 0.1]])
    stage._detect = lambda *_, **__: Detections(boxes, confidences)
    (message,) = run_stage(stage, [frame(np.zeros((240, 320, 3), np.uint8))])
    assert [candidate.label for candidate in message.candidates] == ["cup", "cup", "salt_shaker"]


def test_what_is_in_doubt_comes_with_other_labels_the_likeliest_first() -> None:
    stage = Detector(Detector.Config(labels=("bowl", "cup", "soup_can")))
    confidences = np.array([[0.0, 0.01, 0.95], [0.01, 0.1, 0.6]])
    boxes = np.array([[100.0, 100, 160, 200], [300, 100, 330, 160]])
    stage._detect = lambda *_, **__: Detections(boxes, confidences)
    (message,) = run_stage(stage, [frame(np.zeros((240, 320, 3), np.uint8))])
    assert [candidate.others for candidate in message.candidates] == [(), ("cup", "bowl")]


def test_labels_that_are_seen_elsewhere_are_doubted_last() -> None:
    stage = Detector(Detector.Config(labels=("bowl", "cup", "mug", "soup_can")))
    confidences = np.array([[0.0, 0.95, 0.0, 0.01], [0.6, 0.2, 0.0, 0.1]])
    boxes = np.array([[100.0, 100, 160, 200], [300, 100, 330, 160]])
    stage._detect = lambda *_, **__: Detections(boxes, confidences)
    (message,) = run_stage(stage, [frame(np.zeros((240, 320, 3), np.uint8))])
    assert message.candidates[1].label == "bowl" and message.candidates[1].others == ("soup_can", "mug", "cup")


def test_what_is_in_the_box_of_a_sure_object_may_well_be_an_equal_of_it() -> None:
    stage = Detector(Detector.Config(labels=("bowl", "cup", "mug", "soup_can")))
    confidences = np.array([[0.0, 0.95, 0.0, 0.01], [0.6, 0.1, 0.2, 0.1]])
    boxes = np.array([[100.0, 100, 160, 200], [110, 170, 150, 198]])
    stage._detect = lambda *_, **__: Detections(boxes, confidences)
    (message,) = run_stage(stage, [frame(np.zeros((240, 320, 3), np.uint8))])
    assert message.candidates[1].label == "bowl" and message.candidates[1].others == ("cup", "mug", "soup_can")


def test_objects_known_to_be_there_are_doubted_rather_than_missed(image: np.ndarray) -> None:
    sure = candidates(image, expected=0).candidates
    assert len(candidates(image, expected=len(sure)).candidates) == len(sure)
    doubtful = candidates(image, expected=len(sure) + 1, floor=0.001).candidates
    assert len(doubtful) > len(sure)
    assert [c.label for c in doubtful[: len(sure)]] == [c.label for c in sure]


def test_an_image_without_anything_has_no_candidates() -> None:
    message = candidates(np.full((480, 640, 3), 128, np.uint8))
    assert message.candidates == () and message.confidences.shape == (0, 15)


def test_another_process_detects_the_same_to_the_last_bit(image: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "image.npy", image)
    script = (
        "import sys, numpy as np; from tests.stages.test_detector import candidates;"
        "m = candidates(np.load(sys.argv[1]));"
        "print(m.confidences.tobytes().hex() + ''.join(c.box.tobytes().hex() for c in m.candidates))"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "image.npy")]
    other = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    here = candidates(image)
    boxes = "".join(candidate.box.tobytes().hex() for candidate in here.candidates)
    assert other.stdout.splitlines()[-1] == here.confidences.tobytes().hex() + boxes


def test_bad_settings_are_refused_with_the_valid_choices(tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"threshold = 1\.5: must lie between 0 and 1"):
        Detector.Config(threshold=1.5)
    with pytest.raises(Refused, match=r"floor = 0\.4: must lie above 0 and up to threshold = 0\.3"):
        Detector.Config(floor=0.4)
    with pytest.raises(Refused, match=r"max_boxes = 0"):
        Detector.Config(max_boxes=0)
    with pytest.raises(Refused, match=r"does not know fork \(it knows tray, "):
        Detector(Detector.Config(labels=("fork", "cup")))
    with pytest.raises(Refused, match=r"absent\.safetensors"):
        Detector(Detector.Config(weights=tmp_path / "absent.safetensors"))


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("learned") / "views.safetensors"
    views().save(path)
    return path


def by_models(catalogue: Path, learned: Path, **settings: Any) -> ModelDetector:
    return ModelDetector(ModelDetector.Config(catalogue=catalogue, learned=learned, **settings))


def written(folder: Path) -> Path:
    write_models(folder / "models", OBJECTS)
    return folder / "models"


def test_objects_are_found_by_their_meshes(learned: Path, tmp_path: Path) -> None:
    seen = photograph(*NAMES)
    (message,) = run_stage(by_models(written(tmp_path), learned, max_candidates=8), [seen.frame()])
    assert message.labels == NAMES and message.confidences.shape == (8, 3)
    assert {candidate.label for candidate in message.candidates} == set(NAMES)
    for candidate, row in zip(message.candidates, message.confidences, strict=True):
        assert candidate.confidence == row[NAMES.index(candidate.label)]
        assert row.sum() < 1
    scores = [candidate.confidence for candidate in message.candidates]
    assert scores == sorted(scores, reverse=True)
    kept = by_models(written(tmp_path), learned, max_candidates=8, floor=scores[2])
    (fewer,) = run_stage(kept, [seen.frame()])
    assert len(fewer.candidates) == len(fewer.confidences) == 3


def test_the_robots_own_body_is_no_object(learned: Path, tmp_path: Path) -> None:
    seen = photograph("cereal_box")
    x0, y0, x1, y1 = seen.boxes["cereal_box"].astype(int)
    mask = np.zeros(seen.depth.shape, bool)
    mask[y0 - 4 : y1 + 4, x0 - 4 : x1 + 4] = True
    hidden = msgspec.structs.replace(seen.frame(), robot_mask=mask)
    (message,) = run_stage(by_models(written(tmp_path), learned), [hidden])
    assert all(candidate.confidence < 0.3 for candidate in message.candidates)


def test_views_of_another_catalogue_are_refused(learned: Path) -> None:
    with pytest.raises(Refused, match=r"views of bowl, cereal_box, sauce_bottle, but the objects of .* are tray, "):
        by_models(CATALOGUE, learned)
    for settings, message in (({"max_candidates": 0}, "max_candidates = 0"), ({"floor": 1.0}, r"floor = 1\.0")):
        with pytest.raises(Refused, match=message):
            ModelDetector.Config(catalogue=CATALOGUE, **settings)


def recorded(tmp_path: Path, entries: list[dict[str, Any]], *, stride: int = 1) -> RecordedDetections:
    path = tmp_path / "detections.json"
    path.write_text(json.dumps(entries))
    return RecordedDetections(RecordedDetections.Config(detections=path, catalogue=CATALOGUE, stride=stride))


def entry(**changes: Any) -> dict[str, Any]:
    common = {"scene_id": 1, "image_id": 2, "category_id": 4, "score": 0.5, "bbox": [10, 20, 30, 40]}
    return common | changes


def test_recorded_detections_answer_each_image_in_file_order(tmp_path: Path) -> None:
    stage = recorded(tmp_path, [entry(), entry(image_id=3), entry(category_id=1, score=0.9)])
    (message,) = run_stage(stage, [frame(np.zeros((4, 4, 3), np.uint8), scene_id=1, image_id=2)])
    assert [(one.label, one.confidence) for one in message.candidates] == [("cup", 0.5), ("tray", 0.9)]
    np.testing.assert_array_equal(message.candidates[0].box, [10, 20, 40, 60])
    np.testing.assert_array_equal(message.confidences.max(axis=1), [0.5, 0.9])


def test_recorded_boxes_shrink_with_an_image_of_every_other_pixel(tmp_path: Path) -> None:
    stage = recorded(tmp_path, [entry()], stride=2)
    (message,) = run_stage(stage, [frame(np.zeros((4, 4, 3), np.uint8), scene_id=1, image_id=2)])
    np.testing.assert_array_equal(message.candidates[0].box, [5, 10, 20, 30])
    with pytest.raises(Refused, match=r"detector\.stride = 0: must be 1"):
        recorded(tmp_path, [], stride=0)


def test_a_recorded_label_holds_at_a_score_of_nothing(tmp_path: Path) -> None:
    stage = recorded(tmp_path, [entry(score=0)])
    (message,) = run_stage(stage, [frame(np.zeros((4, 4, 3), np.uint8), scene_id=1, image_id=2)])
    assert [(one.label, one.confidence) for one in message.candidates] == [("cup", 0.0)]


def test_an_image_that_the_file_lacks_is_empty_and_says_so(tmp_path: Path) -> None:
    lines: list[tuple[str, str]] = []
    stage = recorded(tmp_path, [entry()])
    missing = frame(np.zeros((4, 4, 3), np.uint8), scene_id=9, image_id=9)
    (message,) = run_stage(stage, [missing], log=lambda *line: lines.append(line))
    assert message.candidates == () and message.confidences.shape == (0, 15)
    assert lines == [("detections.json has no box for scene 9 image 9", "warning")]


def test_recorded_categories_must_be_in_the_catalogue(tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"entry 0: category_id 99 is none of 1, 2, 3"):
        recorded(tmp_path, [entry(category_id=99)])


def test_reading_a_graph_loads_neither_torch_nor_the_planners_of_motion_nor_windows() -> None:
    program = "import sys, stages.detector, stages.executor, stages.world;"
    program += "sys.exit(bool({'torch', 'toppra', 'glfw'} & set(sys.modules)))"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


@pytest.mark.slow
def test_the_network_finds_objects_in_images_it_never_saw() -> None:
    made = list(examples(Catalogue.load(CATALOGUE), layouts=30, views=2, seed=5000))
    network = DetectionNetwork.load(ROOT / "stages/perception/detector.safetensors")
    evaluation = evaluate(network, made)
    assert evaluation.objects > 150
    assert evaluation.mean_precision >= 0.85
