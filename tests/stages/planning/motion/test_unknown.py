"""What nobody recognised as obstacles: where it stands, and what is none."""

import msgspec
import numpy as np
import pytest

from stages.geometry.arrays import Floats
from stages.messages import SceneGraph
from stages.messages.scene import UnknownRegion
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.unknown import unknown_objects
from stages.scene.stance import yawed
from tests.stages.planning.scenes import ROBOT, TABLE, catalogue, standing

T_BASE_TABLE = yawed(0.3, np.array([0.7, 0.1, TABLE.height]))


def scene(*regions: UnknownRegion) -> SceneGraph:
    empty = SceneGraph(
        objects=(), virtual_objects=(), assertions=(), T_base_table=T_BASE_TABLE, T_base_camera=None, K=np.eye(3)
    )
    return msgspec.structs.replace(empty, unknown=regions)


def region(centre: Floats, extent: tuple[float, float, float]) -> UnknownRegion:
    """With its centre in the robot's base frame."""
    centre = np.linalg.inv(T_BASE_TABLE)[:3] @ [*centre, 1.0]
    return UnknownRegion(
        box=np.array([0.0, 0.0, 9.0, 9.0]), points=80, centre_table=centre, extent_table=np.array(extent)
    )


def beside(x: float, y: float, height: float) -> Floats:
    return np.array([x, y, TABLE.height + height])


def test_a_region_is_a_box_from_its_top_down_to_the_table():
    found = unknown_objects(scene(region(beside(0.6, 0.2, 0.15), (0.06, 0.04, 0.1))), {}, ROBOT, TABLE)
    assert list(found) == ["unknown_1"]
    item, T_base_box = found["unknown_1"]
    assert item.dimensions == pytest.approx([0.07, 0.05, 0.2])
    assert (T_base_box[:3, 3] - [0.6, 0.2, TABLE.height]) == pytest.approx([0.0, 0.0, 0.1])
    assert T_base_box[:3, :3] == pytest.approx(T_BASE_TABLE[:3, :3])


def test_what_is_part_of_a_known_object_is_none_and_what_is_in_a_container_is():
    T_can, T_tray = standing("soup_can", 0.6, 0.2), standing("tray", 0.6, -0.2)
    objects = {"soup_can": (catalogue()["soup_can"], T_can), "tray": (catalogue()["tray"], T_tray)}
    rim = region(beside(0.6, 0.23, 0.05), (0.02, 0.04, 0.05))
    whole = region(beside(0.6, -0.2, 0.015), (0.36, 0.26, 0.03))
    content = region(beside(0.6, -0.2, 0.02), (0.04, 0.04, 0.03))
    assert list(unknown_objects(scene(rim, whole, content), objects, ROBOT, TABLE)) == ["unknown_3"]


def test_what_the_arm_at_home_touches_is_the_arm():
    T_base_hand = CollisionWorld(ROBOT, TABLE, {}).hand(np.asarray(ROBOT.home))
    palm = T_base_hand[:3, 3] - 0.1 * T_base_hand[:3, 0]
    arm, other = region(palm, (0.05, 0.05, 0.05)), region(beside(0.6, 0.2, 0.05), (0.05, 0.05, 0.1))
    assert list(unknown_objects(scene(arm, other), {}, ROBOT, TABLE)) == ["unknown_2"]
