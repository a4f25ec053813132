"""False boxes are false, grow from count to count, and every method is given the same."""

import sys
from pathlib import Path

import pytest

from benchmarks.common.datasets import Image, detections_file, images
from benchmarks.comparison import false_boxes
from benchmarks.comparison.false_boxes import boxes
from stages.devices.bop_results import HEADER, Result
from stages.devices.clutter import write_clutter
from stages.scene.catalogue import Catalogue
from tests.stages.perception.scenes import CATALOGUE


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clutter")
    write_clutter(folder, CATALOGUE, scenes=1, seed=7)
    return folder


@pytest.fixture(scope="module")
def image(dataset: Path) -> Image:
    (found,) = images(dataset, detections_file(dataset, "exact"))
    return found


def test_false_boxes_have_labels_that_are_not_there_and_stay_as_more_come(dataset: Path, image: Image) -> None:
    catalogue = Catalogue.load(dataset / "models")
    there = {truth.label for truth in image.truths}
    few, many = (boxes(image, catalogue, count, 0) for count in (3, 8))
    true = len(image.boxes)
    assert [box.entry() for box in many[: true + 3]] == [box.entry() for box in few]
    assert {box.label for box in many[:true]} == there
    assert len(many) == true + 8 and not there & {box.label for box in many[true:]}
    height, width = image.depth.shape
    for box in many:
        assert (box.box[2:] > box.box[:2]).all() and (box.box <= (width, height, width, height)).all()


def test_the_table_has_a_column_for_each_count_from_results_that_are_kept(
    dataset: Path, image: Image, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib comes with the extra `benchmarks`")
    lines = [Result(*t.image, t.label, 0.9, t.T_camera_object, 0.5).line() for t in image.truths]
    for count, found in ((0, lines), (4, lines[:-1])):
        (tmp_path / f"icp-{count}.csv").write_text("\n".join([HEADER, *found]) + "\n")
    options = ["--counts", "0,4", "--methods", "icp", "--out", str(tmp_path), "--keep"]
    monkeypatch.setattr(sys, "argv", ["false_boxes", str(dataset), *options])
    assert false_boxes.main() == 0
    head, _, row = capsys.readouterr().out.strip().splitlines()
    assert head == "| false boxes an image | 0 | 4 |"
    share = 100 * (1 - 1 / len(lines))
    assert row == f"| multi-start ICP | 100.0 | {share:.1f} |"
    assert (tmp_path / "accuracy.png").stat().st_size > 5000


def test_a_count_that_is_none_is_refused(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["false_boxes", str(dataset), "--counts", "2,nine"])
    assert false_boxes.main() != 0
    assert "'nine' is no whole number from 0 to 8" in capsys.readouterr().err
