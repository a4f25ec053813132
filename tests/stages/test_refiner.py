"""The refiner as a stage: the ranked scene in, the same scene out, closer to the truth."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from runner.contract import Refused
from stages.geometry.poses import exp_so3, pose
from stages.messages import ObjectPose, Observation, SceneEstimate
from stages.refiner import Refiner
from tests.stages.episodes import Recorded
from tests.stages.perception.scenes import CATALOGUE_FILE, VIEW, K, Rendered, camera, render, upright

PLACED = {"mug": upright("mug", -0.05, 0.0, 0.6), "tea_box": upright("tea_box", 0.1, 0.06, 0.2)}
OFF = pose(exp_so3(np.array([0.03, -0.02, 0.03])), np.array([0.003, -0.002, 0.004]))


@pytest.fixture(scope="module")
def seen() -> Rendered:
    return render(PLACED)


@pytest.fixture(scope="module")
def stage() -> Refiner:
    return Refiner(Refiner.Config(catalogue=CATALOGUE_FILE))


def observation(seen: Rendered) -> Observation:
    return Observation(
        depth=seen.scene.depth, rgb=np.zeros((VIEW.height, VIEW.width, 3), np.uint8),
        foreground=seen.scene.foreground, K=K, T_camera_table=camera(), T_base_camera=None,
        scene_id=3, image_id=7, name="scene",
    )  # fmt: skip


def estimate(seen: Rendered) -> SceneEstimate:
    items = tuple(
        ObjectPose(name=label, label=label, T_camera_object=T @ OFF, confidence=0.5, cost=1.0, box=seen.boxes[label])
        for label, T in seen.poses.items()
    )
    return SceneEstimate(
        objects=items, winner=1, log_weights=np.array([-2.0, -1.0]), left_out=4, T_camera_table=camera(),
        T_base_camera=None, K=K, scene_id=3, image_id=7, name="scene",
    )  # fmt: skip


def test_poses_come_closer_and_all_else_stays(seen: Rendered, stage: Refiner) -> None:
    before = estimate(seen)
    after = stage.on_scene_estimate(before, observation(seen), Recorded())
    assert [item.name for item in after.objects] == [item.name for item in before.objects]
    for item in after.objects:
        assert item.T_camera_object[:3, 3] == pytest.approx(seen.poses[item.name][:3, 3], abs=0.0015)
        assert item.cost < 0.002 and 0.5 < item.visible <= 1.0
    assert msgspec.structs.replace(after, objects=before.objects, probabilities=None, unknown=()) == before


def test_the_scene_is_judged(seen: Rendered, stage: Refiner) -> None:
    after = stage.on_scene_estimate(estimate(seen), observation(seen), Recorded())
    assert after.probabilities is not None and after.probabilities.sum() == pytest.approx(1)
    assert all(item.probability is not None and item.spread_metres > 0 for item in after.objects)
    assert after.unknown == ()
    (region,) = stage.on_scene_estimate(
        msgspec.structs.replace(estimate(seen), objects=after.objects[:1]), observation(seen), Recorded()
    ).unknown
    assert region.points > 300


def test_the_scale_of_the_weights_changes_no_probability(seen: Rendered, stage: Refiner) -> None:
    plain = msgspec.structs.replace(estimate(seen), log_weights=np.array([-2.0, -1.0]))
    scaled = msgspec.structs.replace(plain, log_weights=np.array([-50.0, -25.0]), lambda_r=25.0)
    one, other = (stage.on_scene_estimate(each, observation(seen), Recorded()) for each in (plain, scaled))
    assert one.probabilities == pytest.approx(other.probabilities)
    assert [item.probability for item in one.objects] == [item.probability for item in other.objects]


def test_a_scene_that_is_found_twice_keeps_its_probability(seen: Rendered, stage: Refiner) -> None:
    twice = msgspec.structs.replace(estimate(seen), log_weights=np.array([-1.0, -1.0]), winner=0)
    shared, whole = (
        stage.on_scene_estimate(msgspec.structs.replace(twice, repeated=repeated), observation(seen), Recorded())
        for repeated in ((), (1,))
    )
    assert shared.probabilities == pytest.approx([0.5, 0.5])
    assert whole.probabilities == pytest.approx([1.0, 0.0])


def test_the_plain_form_passes_the_scene_on(seen: Rendered) -> None:
    plain = Refiner(Refiner.Config(catalogue=CATALOGUE_FILE, form="paper"))
    before = estimate(seen)
    assert plain.on_scene_estimate(before, observation(seen), Recorded()) is before


def test_a_scene_without_objects_stays_one(seen: Rendered, stage: Refiner) -> None:
    empty = msgspec.structs.replace(estimate(seen), objects=())
    assert stage.on_scene_estimate(empty, observation(seen), Recorded()).objects == ()


def test_what_is_unknown_cannot_be_switched_off() -> None:
    with pytest.raises(Refused, match="'colours' is no improvement"):
        Refiner(Refiner.Config(catalogue=CATALOGUE_FILE, without=("colours",)))


@pytest.mark.parametrize("field", [{"dof": 4}, {"form": "best"}])
def test_settings_are_checked(field: dict) -> None:
    with pytest.raises(Refused, match=f"refiner.{next(iter(field))} is"):
        Refiner.Config(catalogue=CATALOGUE_FILE, **field)
