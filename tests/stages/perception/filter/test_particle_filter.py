"""The filter recovers what was rendered, and gives the same bytes in every process."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from runner.contract import Refused
from stages.geometry.poses import exp_so3, pose
from stages.perception.filter.likelihood import CostForm
from stages.perception.filter.settings import IMPROVEMENTS, FilterSettings
from stages.perception.hypotheses.scene_filter import SceneFilter, Suspect
from stages.scene.metrics import pose_errors
from tests.stages.perception.scenes import CATALOGUE, Rendered, render, upright

PLACED = {"mug": upright("mug", -0.05, 0.0, 0.6), "tea_box": upright("tea_box", 0.1, 0.06, 0.2)}
ROOT = Path(__file__).parents[4]


def suspects(seen: Rendered, *labels: str) -> list[Suspect]:
    return [Suspect(label, seen.boxes[label]) for label in labels]


def errors(seen: Rendered, label: str, T: np.ndarray) -> tuple[float, float]:
    metres, radians = pose_errors(
        np.vstack([T, [0, 0, 0, 1]]), seen.poses[label], CATALOGUE[label].symmetries.transforms()
    )
    return metres, np.rad2deg(radians)


@pytest.mark.parametrize("dof", [3, 6])
def test_rendered_poses_are_recovered(dof: int) -> None:
    seen = render(PLACED)
    result = SceneFilter(CATALOGUE, FilterSettings(dof=dof)).estimate(seen.scene, suspects(seen, "mug", "tea_box"))
    for label, found in zip(("mug", "tea_box"), result.objects, strict=True):
        metres, degrees = errors(seen, label, found.track.T_camera_object)
        assert metres < 0.004 and degrees < 4
        assert found.cost < 0.004 and found.visible > 0.85


def test_a_lying_bottle_is_recovered() -> None:
    lying = pose(exp_so3(np.array([np.pi / 2, 0, 0])), np.array([0.02, 0.05, -CATALOGUE["sauce_bottle"].bounds[0, 1]]))
    seen = render({"sauce_bottle": lying})
    result = SceneFilter(CATALOGUE, FilterSettings()).estimate(seen.scene, suspects(seen, "sauce_bottle"))
    metres, degrees = errors(seen, "sauce_bottle", result.objects[0].track.T_camera_object)
    assert metres < 0.005 and degrees < 5


def test_the_papers_plain_form_converges_upright() -> None:
    seen = render({"tea_box": PLACED["tea_box"]})
    settings = FilterSettings.paper(iterations=40, dof=3)
    result = SceneFilter(CATALOGUE, settings).estimate(seen.scene, suspects(seen, "tea_box"))
    metres, _ = errors(seen, "tea_box", result.objects[0].track.T_camera_object)
    assert metres < 0.02


def test_the_papers_plain_form_has_no_improvement() -> None:
    paper = FilterSettings.paper()
    assert paper.cost == CostForm.paper()
    assert (paper.particles, paper.iterations, paper.lambda_r, paper.overdraw, paper.sweeps) == (625, 400, 1.0, 0, 0)
    assert not (paper.elitism or paper.flips or paper.renewed or paper.polished or paper.joint or paper.colour)
    assert paper.metres[0] == paper.metres[1] and paper.radians[0] == paper.radians[1]


@pytest.mark.parametrize("name", IMPROVEMENTS)
def test_every_improvement_can_be_switched_off_alone(name: str) -> None:
    without = FilterSettings().without(name)
    assert without != FilterSettings()
    others = [other for other in IMPROVEMENTS if other != name]
    assert FilterSettings().without(*others).without(name) == FilterSettings.paper()


def test_an_unknown_improvement_is_refused() -> None:
    with pytest.raises(Refused, match=r"'anealing'.*annealing"):
        FilterSettings().without("anealing")


def test_the_wrong_object_costs_more() -> None:
    seen = render(PLACED)
    scenes = SceneFilter(CATALOGUE, FilterSettings(iterations=40))
    right = scenes.estimate(seen.scene, suspects(seen, "mug", "tea_box"))
    wrong = scenes.estimate(seen.scene, [suspects(seen, "mug")[0], Suspect("tuna_can", seen.boxes["tea_box"])])
    assert right.cost < 0.7 * wrong.cost


def test_shared_beginnings_change_nothing() -> None:
    seen = render(PLACED)
    settings = FilterSettings(iterations=24)
    fresh = SceneFilter(CATALOGUE, settings).estimate(seen.scene, suspects(seen, "mug", "tea_box"))
    used = SceneFilter(CATALOGUE, settings)
    used.estimate(seen.scene, [suspects(seen, "mug")[0], Suspect("sponge", seen.boxes["tea_box"])])
    again = used.estimate(seen.scene, suspects(seen, "mug", "tea_box"))
    assert again.cost == fresh.cost
    for a, b in zip(again.objects, fresh.objects, strict=True):
        assert np.array_equal(a.track.T_camera_object, b.track.T_camera_object)


def test_a_box_without_readings_does_not_break_the_filter() -> None:
    seen = render(PLACED)
    empty = Suspect("mug", np.array([2.0, 2.0, 30.0, 20.0]))
    result = SceneFilter(CATALOGUE, FilterSettings(iterations=8)).estimate(seen.scene, [empty])
    assert np.isfinite(result.objects[0].track.T_camera_object).all()


def test_no_objects_cost_the_unexplained_foreground() -> None:
    seen = render(PLACED)
    assert SceneFilter(CATALOGUE, FilterSettings()).estimate(seen.scene, []).cost > 10


SCRIPT = """
import hashlib
from tests.stages.perception.filter.test_particle_filter import PLACED, suspects
from tests.stages.perception.scenes import CATALOGUE, render
from stages.perception.filter.settings import FilterSettings
from stages.perception.hypotheses.scene_filter import SceneFilter
seen = render(PLACED)
result = SceneFilter(CATALOGUE, FilterSettings(iterations=16)).estimate(seen.scene, suspects(seen, "mug", "tea_box"))
digest = hashlib.sha256(b"".join(found.track.T_camera_object.tobytes() for found in result.objects))
print(digest.hexdigest(), result.cost)
"""


@pytest.mark.slow
def test_processes_agree_to_the_byte_whatever_compiled_the_kernels(tmp_path: Path) -> None:
    # The first process compiles, the others load what it cached; threads and load differ. All run at once after it.
    def start(threads: int) -> subprocess.Popen[str]:
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "OMP_NUM_THREADS": str(threads)}
        return subprocess.Popen([sys.executable, "-c", SCRIPT], cwd=ROOT, env=environment, text=True,
                                stdout=subprocess.PIPE)  # fmt: skip

    first, _ = start(1).communicate(timeout=200)
    others = [start(threads) for threads in (1, 2, 4)]
    assert len(first) > 64
    assert [process.communicate(timeout=200)[0] for process in others] == [first] * 3
