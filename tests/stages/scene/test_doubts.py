"""What a look leaves open and what is asked about it."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from stages.geometry.arrays import Floats
from stages.messages import ObjectPose, SceneEstimate
from stages.messages.scene import Alternative, Doubt, UnknownRegion
from stages.perception.confidence.memory import Memory
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.doubts import corrected, doubts
from tests.stages.layouts import Layout

CATALOGUE = Catalogue.shared(BUILT_IN)
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1]])
"""In the frame of a camera that looks straight down."""
TURNED = UPRIGHT @ np.diag([1.0, -1, -1, 1])
LYING = UPRIGHT @ np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def estimate(label: str, pose: Floats, *others: tuple[Floats, float], unknown: int = 0) -> SceneEstimate:
    item = ObjectPose(
        name=label, label=label, T_camera_object=pose, confidence=0.9, cost=1.0, box=np.zeros(4),
        alternatives=tuple(Alternative(T_camera_object=T, probability=p) for T, p in others),
    )  # fmt: skip
    region = UnknownRegion(box=np.zeros(4), points=9, centre_table=np.zeros(3), extent_table=np.ones(3))
    return SceneEstimate(
        objects=(item,), winner=0, log_weights=np.zeros(1), left_out=0, T_camera_table=UPRIGHT, T_base_camera=np.eye(4),
        K=np.eye(3), unknown=(region,) * unknown,
    )  # fmt: skip


def test_an_object_that_may_stand_otherwise_is_asked_about() -> None:
    for pose, other, stance in (
        (UPRIGHT, TURNED, "upright"),
        (TURNED, UPRIGHT, "upside down"),
        (LYING, TURNED, "lying"),
    ):
        (doubt,) = doubts(estimate("cup", pose, (pose, 0.4), (other, 0.3)), CATALOGUE)
        assert (doubt.key, doubt.stance, doubt.choices) == (f"stance cup {stance}", stance, ("yes", "no", "again"))
        assert doubt.T_base_other is not None and np.allclose(doubt.T_base_other, other)


def test_what_is_unlikely_or_looks_the_same_is_not() -> None:
    assert doubts(estimate("cup", UPRIGHT, (TURNED, 0.1)), CATALOGUE) == ()
    assert doubts(estimate("cup", UPRIGHT, (UPRIGHT, 0.4)), CATALOGUE) == ()
    flipped = next(name for name, item in CATALOGUE.objects.items() if (item.symmetries.near[:, 2, 2] < -0.9).any())
    assert doubts(estimate(flipped, UPRIGHT, (TURNED, 0.4)), CATALOGUE) == ()
    wrong = estimate("cup", UPRIGHT, (TURNED, 0.4))
    gone = msgspec.structs.replace(wrong.objects[0], contradicted=True)
    assert doubts(msgspec.structs.replace(wrong, objects=(gone,)), CATALOGUE) == ()


def test_what_is_unknown_is_asked_about_once() -> None:
    (doubt,) = doubts(estimate("cup", UPRIGHT, unknown=2), CATALOGUE)
    assert (doubt.key, doubt.choices) == ("unknown", ("leave", "again"))


@pytest.mark.parametrize("name", ["cup", "cereal_box"])
def test_a_region_is_told_by_the_pose_that_is_answered(name: str) -> None:
    scene = Layout().put("cereal_box", 0.0, 0.0, yaw=0.4).put("cup", 0.0, 0.1).graph()
    (other,) = (item.T_base_object @ np.diag([1.0, -1, -1, 1]) for item in scene.objects if item.name == name)
    doubt = Doubt(kind="stance", object=name, T_base_other=other)
    after = corrected(msgspec.structs.replace(scene, doubts=(doubt,)), {doubt.key: "no"}, Memory(CATALOGUE).related)
    poses = {item.name: item.T_base_object for item in after.objects}
    (region,) = after.virtual_objects
    assert np.array_equal(poses[name], other)
    assert np.allclose(poses[region.parent] @ region.T_parent_virtual, poses[region.child])


def test_what_stands_beside_the_one_that_is_meant_stays_beside_it() -> None:
    scene = Layout().put("mug", 0.0, 0.3).put("mug_2", 0.0, -0.2).put("cereal_box", 0.0, -0.3).graph()
    (before,) = scene.virtual_objects
    after = corrected(scene, {"which mug": "mug_2"}, Memory(CATALOGUE).related)
    (region,) = after.virtual_objects
    assert (before.child, region.child) == ("mug_2", "mug") and region.parent == before.parent == "cereal_box"
    assert np.array_equal(region.T_parent_virtual, before.T_parent_virtual)
