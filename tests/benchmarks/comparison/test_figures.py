"""Figures, tables and failure sheets, drawn once from made-up results."""

import argparse
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.common.datasets import Truth, read_truth
from benchmarks.comparison import compare, failures, figures
from benchmarks.comparison.accuracy import Score
from runner.contract import Refused
from stages.devices.bop_results import HEADER, Result
from stages.devices.clutter import write_clutter
from stages.geometry.poses import exp_so3, pose
from tests.stages.perception.scenes import CATALOGUE

TURN = pose(exp_so3(np.array([0.0, np.deg2rad(40), 0.0])), np.array([0.0, 0.0, 0.03]))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clutter")
    write_clutter(folder, CATALOGUE, scenes=1, seed=7)
    truths = read_truth(folder)
    for name, wrong in (("good", 0), ("bad", 2)):
        T = [truth.T_camera_object @ (TURN if i < wrong else np.eye(4)) for i, truth in enumerate(truths)]
        lines = [Result(*t.image, t.label, 0.9, each, 0.5).line() for t, each in zip(truths, T, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join([HEADER, *lines]) + "\n")
    return folder


def test_the_figure_has_four_panels_and_the_table_a_row_for_each_method(
    dataset: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib comes with the extra `benchmarks`")
    out = dataset / "figure.png"
    methods = [f"good={dataset / 'good.csv'}", f"bad={dataset / 'bad.csv'}"]
    monkeypatch.setattr(sys, "argv", ["figures", str(out), str(dataset), *methods])
    assert figures.main() == 0
    with Image.open(out) as image:
        assert image.size == (1100, 836)
    head, _, good, bad, _, verdict = capsys.readouterr().out.strip().splitlines()
    assert verdict.startswith("No method is ahead of good")
    assert "| 1 cm and 10 degrees |" in head and "| VSD recall |" in head
    assert good.startswith("| good | 100.0 (") and "0.5 (at most 0.5) |" in good
    assert "60.0 (" in bad and "1 of 1" in bad


def test_curves_count_the_objects_within_both_bounds() -> None:
    truth = Truth((1, 0), 1, np.eye(4))
    scores = [Score(truth, metres=0.004, radians=np.deg2rad(8)), Score(truth, metres=0.03, radians=0.01), Score(truth)]
    assert [sum(one.within(metres, 10) for one in scores) for metres in figures.POSITION_BOUNDS] == [1, 2, 2, 2]


def test_bounds_at_which_another_method_is_ahead_are_named() -> None:
    truth = Truth((1, 0), 1, np.eye(4))
    near, nearer = (Score(truth, metres=0.004, radians=np.deg2rad(angle)) for angle in (2.5, 1.5))
    (line,) = figures.behind({"ours": [near], "theirs": [nearer]}).splitlines()
    assert line.startswith("theirs is ahead of ours within 2 degrees (objects): 1 against 0 within 1 cm, 1 against")
    assert line.endswith("within 20 cm")


def test_failures_are_drawn_with_observation_estimate_and_truth(dataset: Path) -> None:
    picture, count = failures.sheet(dataset, dataset / "bad.csv")
    assert count == 2
    pixels = np.asarray(picture)
    for color in (failures._WRONG, failures._RIGHT):
        assert (np.abs(pixels.astype(int) - color).sum(-1) < 30).sum() > 50
    assert failures.sheet(dataset, dataset / "good.csv")[1] == 0


def test_methods_become_commands_and_unknown_ones_are_refused() -> None:
    options = argparse.Namespace(dataset=Path("d"), detections="noisy", dof=3, images="2", processes=2)
    digest, icp = (compare.command(method, options, Path("o.csv"))[2:] for method in ("paper", "icp"))
    assert digest[:4] == ["benchmarks.comparison.estimate", "d", "noisy", "o.csv"] and digest[4:6] == [
        "--form",
        "paper",
    ]
    assert icp == ["benchmarks.comparison.baselines", "icp", "d", "noisy", "o.csv", "--dof", "3", "--images", "2"]
    with pytest.raises(Refused, match=r"'magic' is none of digest, depth, paper, icp"):
        compare.parse_methods("digest,magic")


def test_comparisons_are_written_from_results_that_are_kept(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib comes with the extra `benchmarks`")
    for method, name in (("digest", "good"), ("icp", "bad")):
        (tmp_path / f"{method}.csv").write_bytes((dataset / f"{name}.csv").read_bytes())
    arguments = ["--methods", "digest,icp", "--keep", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["compare", str(dataset), *arguments])
    assert compare.main() == 0
    assert (tmp_path / "accuracy.png").stat().st_size > 10_000
    assert (tmp_path / "accuracy.md").read_text() == capsys.readouterr().out
    assert "| multi-start ICP |" in (tmp_path / "accuracy.md").read_text()
