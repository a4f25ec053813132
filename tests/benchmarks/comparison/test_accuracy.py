"""Scores of results on a small generated data set."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.datasets import Truth, read_truth
from benchmarks.comparison import accuracy
from benchmarks.comparison.accuracy import interval, read_views, recalls, score
from stages.devices.bop_results import HEADER, Result
from stages.devices.clutter import write_clutter
from stages.geometry.poses import exp_so3, pose
from stages.scene.catalogue import Catalogue
from tests.stages.perception.scenes import CATALOGUE


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clutter")
    write_clutter(folder, CATALOGUE, scenes=1, seed=7)
    return folder


def results_of(dataset: Path, *, shift: float) -> list[Result]:
    moved = pose(np.eye(3), np.array([0.0, 0.0, shift]))
    return [Result(*truth.image, truth.label, 1.0, moved @ truth.T_camera_object, 0.5) for truth in read_truth(dataset)]


def test_the_truth_itself_scores_full_marks_and_a_shift_does_not(dataset: Path) -> None:
    truths, catalogue, views = read_truth(dataset), Catalogue.load(dataset / "models"), read_views(dataset)
    for shift, least, most in ((0.0, 0.999, 1.0), (0.02, 0.4, 0.95), (0.5, 0.0, 0.0)):
        scores = score(truths, results_of(dataset, shift=shift), catalogue, views)
        assert [one.metres for one in scores] == pytest.approx([shift] * len(truths))
        values = recalls(scores)
        assert set(values) == {"ADD-S AUC", "MSSD recall", "VSD recall"}
        assert all(least <= value <= most for value in values.values()), values
    assert "VSD recall" not in recalls(score(truths, [], catalogue))
    assert recalls(score(truths, [], catalogue, views))["VSD recall"] == 0


def test_the_command_prints_a_table_or_json(
    dataset: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    csv = dataset / "half.csv"
    lines = [result.line() for result in results_of(dataset, shift=0.0)]
    csv.write_text("\n".join([HEADER, *lines[1:], lines[-1]]) + "\n")
    monkeypatch.setattr(sys, "argv", ["accuracy", str(dataset), str(csv)])
    assert accuracy.main() == 0
    printed = capsys.readouterr().out
    assert "false objects          1 in 1 images" in printed and f"({len(lines) - 1} of {len(lines)})" in printed
    assert "2 cm and 15 degrees" in printed and "not found" in printed and "set of objects right   0 of 1" in printed
    monkeypatch.setattr(sys, "argv", ["accuracy", str(dataset), str(csv), "--json"])
    assert accuracy.main() == 0
    values = json.loads(capsys.readouterr().out)
    share = 1 - 1 / len(lines)
    assert values["1 cm and 10 degrees"] == pytest.approx(share) and values["right_sets"] == 0
    assert values["VSD recall"] == pytest.approx(share, abs=0.01)
    assert sum(entry["adds"] is None for entry in values["objects"]) == 1


def test_where_it_is_known_how_a_label_faces_a_symmetric_turn_is_wrong() -> None:
    can = CATALOGUE["soup_can"]
    T = pose(np.eye(3), np.array([0.0, 0.0, 0.7]))
    over = pose(exp_so3(np.array([0.0, 0.0, np.deg2rad(40)])), np.zeros(3))
    truth = Truth((1, 0), can.label, T, label_known=True)
    for turned in (False, True):
        result = Result(1, 0, can.label, 1.0, T @ over if turned else T, 0.5)
        (one,) = score([truth], [result], CATALOGUE)
        assert one.within(0.001, 1) and one.label_right != turned
        assert accuracy.failed([one]) == ([one] if turned else [])
        printed = accuracy.table([one], (1, 1))
        assert f"label faces right      {'  0.0' if turned else '100.0'} %" in printed


def test_intervals_are_those_of_wilson() -> None:
    assert interval(55, 60) == pytest.approx((0.8193, 0.9639), abs=2e-4)
    assert interval(0, 10)[0] == pytest.approx(0.0, abs=1e-12) and interval(10, 10)[1] == pytest.approx(1.0)
