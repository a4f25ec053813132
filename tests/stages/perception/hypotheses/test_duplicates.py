"""What shows one object twice."""

import numpy as np

from stages.geometry.poses import pose
from stages.messages.scene import ObjectPose
from stages.perception.hypotheses.duplicates import is_same_scene, unrepeated, without_doubles

BOX = np.array([100.0, 100.0, 160.0, 200.0])
PART = np.array([98.0, 100.0, 162.0, 140.0])
BESIDE = np.array([150.0, 100.0, 210.0, 200.0])
HERE, NEAR, THERE = (np.array([x, 0.0, 1.0]) for x in (0.0, 0.004, 0.08))


def item(label: str, place: np.ndarray, box: np.ndarray = BOX) -> ObjectPose:
    return ObjectPose(
        name=label, label=label, T_camera_object=pose(np.eye(3), place), confidence=0.9, cost=0.0, box=box
    )


def test_a_box_of_a_part_shows_the_same_object() -> None:
    assert unrepeated(["cup", "cup", "cup"], [BOX, PART, BESIDE]) == [0, 2]


def test_other_labels_are_other_objects() -> None:
    assert unrepeated(["cup", "mug"], [BOX, BOX]) == [0, 1]


def test_where_places_are_known_they_must_be_one() -> None:
    assert unrepeated(["cup", "cup"], [BOX, PART], [HERE, NEAR]) == [0]
    assert unrepeated(["cup", "cup"], [BOX, PART], [HERE, THERE]) == [0, 1]


def test_a_scene_has_each_object_once() -> None:
    scene = [item("cup", HERE), item("cup", NEAR, PART), item("cup", THERE, BESIDE), item("mug", HERE)]
    assert [*map(id, without_doubles(scene))] == [id(scene[k]) for k in (0, 2, 3)]


def test_two_boxes_that_do_not_touch_may_show_one_object() -> None:
    lower = BOX + np.array([0.0, 130.0, 0.0, 130.0])
    assert len(without_doubles([item("cup", HERE), item("cup", NEAR, lower)])) == 1


def test_scenes_are_the_same_whatever_their_order_and_boxes() -> None:
    one = [item("cup", HERE), item("mug", THERE)]
    assert is_same_scene(one, [item("mug", THERE), item("cup", NEAR, PART)])
    assert not is_same_scene(one, [item("cup", HERE)])
    assert not is_same_scene(one, [*one, item("cup", HERE)])
    assert not is_same_scene(one, [item("cup", THERE), item("mug", HERE)])
