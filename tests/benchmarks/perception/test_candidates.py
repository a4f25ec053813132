"""Who counts as found, and what the table says; the whole command on one small pile."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.datasets import Truth
from benchmarks.perception import candidates
from benchmarks.perception.candidates import Found, found, table
from stages.devices.clutter import Pile, write_clutter
from stages.messages import Candidate, Candidates
from tests.stages.perception.detection.scenes import OBJECTS, views

TRUTH = Truth((1, 0), 1, np.eye(4), 1.0, np.array([10.0, 10, 50, 50]))


def message(*boxes: tuple[str, list[float]]) -> Candidates:
    made = tuple(Candidate(box=np.array(box, float), label=label, confidence=0.5) for label, box in boxes)
    return Candidates(candidates=made, labels=("cup", "mug"), confidences=np.tile([0.5, 0.2], (len(made), 1)))


def test_the_first_candidate_with_label_and_box_counts() -> None:
    seen = message(
        ("mug", [10, 10, 50, 50]), ("cup", [90, 90, 99, 99]), ("cup", [10, 10, 50, 38]), ("cup", [9, 9, 51, 51])
    )
    assert found(TRUTH, seen, "cup", "L") == Found("L", 3.0, precise=True, top=True)
    assert found(TRUTH, seen, "mug", "L") == Found("L", 1.0, precise=True, top=False)
    assert found(TRUTH, message(), "cup", "L") == Found("L", np.inf, precise=False, top=False)


def test_the_table_has_a_row_for_each_sensor_and_one_for_all() -> None:
    rows = [Found("A", 1, True, True), Found("A", 8, False, True), Found("B", np.inf, False, False)]
    lines = table(rows, 20).splitlines()
    assert lines[0] == "| sensor | objects | among 5 | among 10 | among 20 | IoU > 0.75 among 20 | top label right |"
    assert lines[2] == "| A | 2 | 0.500 | 1.000 | 1.000 | 0.500 | 1.000 |"
    assert lines[3:] == [
        "| B | 1 | 0.000 | 0.000 | 0.000 | 0.000 | 0.000 |",
        "| all | 3 | 0.333 | 0.667 | 0.667 | 0.333 | 0.667 |",
    ]


def test_the_command_prints_what_it_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_clutter(tmp_path / "data", OBJECTS, scenes=1, seed=3, pile=Pile(counts=(2,), false=(1, 1)))
    views().save(tmp_path / "views.safetensors")
    options = ["--learned", str(tmp_path / "views.safetensors"), "--pictures", str(tmp_path / "pictures")]
    monkeypatch.setattr("sys.argv", ["candidates", str(tmp_path / "data"), *options])
    assert candidates.main() == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("1/0: ") and printed[1].startswith("| sensor | objects | among 5 ")
    assert printed[-1].startswith("| f = ") and len(printed) == 4
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == ["000001-000000.png"]
