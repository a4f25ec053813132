"""Perception in one process, on the data sets."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.common.datasets import images, parse_ids, read_truth, truths_by_image
from benchmarks.common.pipeline import STAGES
from benchmarks.comparison.estimate import Settings, bop_graph, estimate, results
from runner.contract import Refused
from stages.devices.bop_results import Result, read_results
from stages.devices.clutter import write_clutter
from stages.scene.catalogue import Catalogue
from tests.stages.perception.scenes import CATALOGUE

ROOT = Path(__file__).parents[3]
DATA = ROOT.parent / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the data sets in ../shared/data are absent")
LAYOUT = DATA / "household-layout"


@needs_data
def test_images_come_with_boxes_and_truth() -> None:
    first, second = images(LAYOUT, LAYOUT / "detections_exact.json", 2)
    assert (first.id, second.id) == ((1, 0), (2, 0)) and first.frame.index == 0 and second.frame.index == 1
    assert len(first.boxes) == first.n_objects == len(first.truths) == 4
    assert first.rgb.shape == (480, 640, 3) and first.depth.shape == (480, 640)
    assert all(0.2 < truth.visible <= 1 for truth in first.truths)
    assert sum(len(truths) for truths in truths_by_image(LAYOUT).values()) == len(read_truth(LAYOUT)) == 40


@needs_data
def test_images_are_chosen_by_id_and_keep_their_place() -> None:
    (image,) = images(LAYOUT, LAYOUT / "detections_noisy.json", parse_ids("3/0"))
    assert image.id == (3, 0) and image.frame.index == 2 and image.frame.total == 11
    assert len(image.boxes) > image.n_objects
    with pytest.raises(Refused, match="there is no image 99/0; there are 1/0, 2/0"):
        list(images(LAYOUT, LAYOUT / "detections_noisy.json", [(99, 0)]))
    with pytest.raises(Refused, match="'some': images are a number"):
        parse_ids("some")


@needs_data
def test_settings_reach_every_stage_that_has_them() -> None:
    graph = bop_graph(LAYOUT, Settings(dof=3, form="paper", without=("flips",), set=("hypotheses.max_hypotheses=4",)))
    configs = [graph.nodes[name].config for name in STAGES]
    assert {config.dof for config in configs if hasattr(config, "dof")} == {3}
    assert {config.form for config in configs if hasattr(config, "form")} == {"paper"}
    assert graph.nodes["particle_filter"].config.without == ("flips",)
    assert graph.nodes["hypotheses"].config.max_hypotheses == 4
    assert bop_graph(LAYOUT, Settings(n_objects="auto")).nodes["hypotheses"].config.n_objects == "auto"
    with pytest.raises(Refused, match="processes = 0: must be at least 1"):
        Settings(processes=0)


@needs_data
@pytest.mark.slow
def test_processes_that_share_hypotheses_give_the_scene_that_one_process_gives() -> None:
    few = ("particle_filter.particles=50", "particle_filter.iterations=12", "hypotheses.finalists=3")
    alone, shared = (
        estimate(LAYOUT, "noisy", Settings(dof=3, set=few, processes=count, share="hypotheses"), [(2, 0)])[0]
        for count in (1, 2)
    )
    assert [item.name for item in alone.scene.objects] == [item.name for item in shared.scene.objects]
    for one, other in zip(alone.scene.objects, shared.scene.objects, strict=True):
        assert one.T_camera_object.tobytes() == other.T_camera_object.tobytes()
    assert alone.scene.log_weights.tobytes() == shared.scene.log_weights.tobytes()
    assert len(alone.scene.log_weights) == 3 and shared.seconds > 0 and shared.cpu_seconds > 0


@pytest.mark.slow
def test_the_graph_under_its_runner_gives_the_same_bytes(tmp_path: Path) -> None:
    write_clutter(tmp_path, CATALOGUE, scenes=2, seed=11)
    few = ("particle_filter.particles=50", "particle_filter.iterations=24")
    ours = estimate(tmp_path, "noisy", Settings(set=few))
    catalogue = Catalogue.load(tmp_path / "models")
    paths = (
        f"camera.dataset={tmp_path}", f"detector.detections={tmp_path}/detections_noisy.json",
        f"results.path={tmp_path}/live.csv",
    )  # fmt: skip
    command = [sys.executable, "-m", "runner.cli", "up", "graphs/bop.yaml", "--recordings", str(tmp_path)]
    for assignment in (*paths, *few):
        command += ["--set", assignment]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    theirs = read_results(tmp_path / "live.csv")
    assert [_line(one) for one in theirs] == [_line(one) for found in ours for one in results(found, catalogue)]


def _line(result: Result) -> str:
    """The line of the CSV without the time."""
    return result.line().rpartition(",")[0]
