"""Which grasps there are, and how an object is carried."""

from itertools import islice

import numpy as np
import pytest

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, raised
from stages.messages import Transfer
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.motion import is_motion_free
from stages.planning.motion.pick_place import SLID, Errand, PickPlacePlanner, planners
from stages.robots import BUILT_IN, read_robot
from tests.stages.planning.scenes import ROBOT, TABLE, catalogue, standing


def ways(
    name: str, poses: dict[str, Floats], target: Floats, *, faces: bool = False
) -> list[tuple[CollisionWorld, PickPlacePlanner]]:
    """Planners that move one of the objects on the table to another place on it, the widest margins first."""
    transfer = Transfer(
        object=name, source="table", destination="table", T_base_targets=target[None], pick="", place="", faces=faces
    )
    objects = {one: (catalogue()[one], T) for one, T in poses.items()}
    return list(planners(ROBOT, TABLE, objects, transfer, np.random.default_rng(0)))


@pytest.mark.parametrize("faces", [False, True])
@pytest.mark.parametrize("name", ["tea_box", "tuna_can"])
def test_an_object_shows_the_side_that_its_target_says_where_that_matters(name: str, faces: bool) -> None:
    entry, T = catalogue()[name], standing(name, 0.65, 0.1)
    target = standing(name, 0.65, -0.1, yaw=np.pi)
    (_, planner), *_ = ways(name, {name: T}, target, faces=faces)
    ends = [
        plan.place.hand.T_base_hand @ inverse(plan.pick.hand.T_object_hand)
        for plan in islice(planner.plans(ROBOT.home), 6)
    ]
    alike = target @ entry.symmetries.transforms(np.deg2rad(22.5))
    assert ends and all(min(np.abs(end - T).max() for T in alike) < 1e-6 for end in ends)
    assert all(np.allclose(end, target, atol=1e-6) for end in ends) == faces


@pytest.mark.parametrize("gap", [0.001, 0.02])
def test_an_object_that_something_leans_on_is_lifted_with_the_least_margins(gap: float) -> None:
    """A box with a sponge at its foot."""
    entries = catalogue()
    beside = (entries["tea_box"].dimensions[1] + entries["sponge"].dimensions[1]) / 2 + gap
    poses = {"tea_box": standing("tea_box", 0.65, 0.1), "sponge": standing("sponge", 0.65, 0.1 + beside)}
    found = [planner.can_pick(ROBOT.home) for _, planner in ways("tea_box", poses, standing("tea_box", 0.65, -0.2))]
    assert found == ([False, False, True] if gap < 0.002 else [True, True, True])


def test_what_only_leans_on_an_object_is_not_in_the_way_of_what_lifts_it() -> None:
    """A box with a sponge at its foot, under a tray."""
    entries = catalogue()
    beside = (entries["tea_box"].dimensions[1] + entries["sponge"].dimensions[1]) / 2 + 0.001
    above = TABLE.height + entries["tea_box"].dimensions[2] + 0.03
    poses = {
        "tea_box": standing("tea_box", 0.65, 0.1),
        "sponge": standing("sponge", 0.65, 0.1 + beside),
        "tray": standing("tray", 0.65, 0.1, height=above),
    }
    *_, (_, planner) = ways("tea_box", poses, standing("tea_box", 0.65, -0.2))
    assert not planner.reaches(0, ROBOT.home)
    assert planner.in_the_way(ROBOT.home) == [("tray",)]


def test_it_is_carried_with_room_below_for_what_slides_down_in_the_hand() -> None:
    """A carton around a box that it would pass 4 cm above."""
    poses = {"milk_carton": standing("milk_carton", 0.6, 0.25), "tea_box": standing("tea_box", 0.6, 0.0)}
    (_, planner), *_, (world, _) = ways("milk_carton", poses, standing("milk_carton", 0.6, -0.25))
    plan = next(planner.plans(ROBOT.home))
    hand = plan.pick.hand
    hanging = raised(hand.T_base_hand @ inverse(hand.T_object_hand), -SLID)
    with world.holding(inverse(hand.T_base_hand) @ hanging, hand.grasp.width):
        assert is_motion_free(world, plan.carry)


@pytest.mark.parametrize("y", [0.02, 0.03, 0.04])
def test_what_does_not_slide_in_the_hand_is_carried_past_others_too(y: float) -> None:
    """A cup past a mug on a can: 6 cm lower it would pass below the mug, beside the can, which is slimmer."""
    poses = {"cup": standing("cup", 0.745, -0.059), "soup_can": standing("soup_can", 0.702, y)}
    poses["mug"] = standing("mug", 0.705, y, yaw=1.6, height=TABLE.height + catalogue()["soup_can"].dimensions[2])
    for world, planner in ways("cup", poses, standing("cup", 0.595, 0.009)):
        for plan in islice(planner.plans(ROBOT.home), 6):
            with planner.holding(plan.pick.hand):
                assert is_motion_free(world, plan.carry)


def test_what_the_gripper_does_not_take_is_no_grasp() -> None:
    box = catalogue()["sugar_box"]
    robot = read_robot(BUILT_IN.with_name("ur5e.yaml"))
    assert any(grasp.width > robot.gripper.widest for grasp in box.grasps)
    T = standing("sugar_box", 0.5, 0.1, height=robot.table.height)
    world = CollisionWorld(robot, robot.table, {"sugar_box": (box, T)}, carried="sugar_box")
    errand = Errand(box, T, T[None], "table", "table")
    planner = PickPlacePlanner(world, errand, np.random.default_rng(0), room=0.006)
    widths = [grasp.width for grasp in planner._grasps]  # pyright: ignore[reportPrivateUsage]
    assert widths and max(widths) <= robot.gripper.widest
