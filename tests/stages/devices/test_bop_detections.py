"""Reading detections files: order, boxes, and a clear refusal of each kind of mistake."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runner.contract import Refused
from stages.devices.bop_detections import read_detections

NAMES = {1: "tray", 4: "cup"}
GOOD: dict[str, Any] = {
    "scene_id": 3,
    "image_id": 7,
    "category_id": 4,
    "score": 0.5,
    "bbox": [10, 20.5, 30, 40],
    "time": -1,
}


def written(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "detections.json"
    path.write_text(json.dumps(content))
    return path


def test_boxes_keep_the_order_of_the_file(tmp_path: Path) -> None:
    path = written(tmp_path, [GOOD, GOOD | {"category_id": 1, "score": 0.9}])
    first, second = read_detections(path, NAMES)
    assert (first.scene_id, first.image_id, first.label, first.score) == (3, 7, "cup", 0.5)
    np.testing.assert_array_equal(first.box, [10, 20.5, 40, 60.5])
    assert second.label == "tray"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([GOOD, GOOD | {"category_id": 9}], "entry 1: category_id 9 is none of 1, 4"),
        ([{key: GOOD[key] for key in GOOD if key != "score"}], "missing required field `score`"),
        ([GOOD | {"bbox": [1, 2, 3]}], r"bbox"),
        ([GOOD | {"bbox": [1, 2, 0, 4]}], r"bbox"),
        ([GOOD, GOOD | {"score": 1.5}], "entry 1: score 1.5 must lie from 0 to 1"),
        ([GOOD | {"score": -0.1}], "entry 0: score -0.1 must lie from 0 to 1"),
        ({"detections": []}, "Expected `array`"),
    ],
)
def test_mistakes_are_refused_with_their_place(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(Refused, match=r"detections\.json") as refusal:
        list(read_detections(written(tmp_path, content), NAMES))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_missing_and_damaged_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"absent\.json: cannot be read"):
        list(read_detections(tmp_path / "absent.json", NAMES))
    (tmp_path / "cut.json").write_text('[{"scene_id": 1,')
    with pytest.raises(Refused, match=r"cut\.json: not BOP detections"):
        list(read_detections(tmp_path / "cut.json", NAMES))
