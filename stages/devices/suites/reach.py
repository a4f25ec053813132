"""Whether the robot could take a scene apart: the test that a drawn scene is possible at all."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.pick_place import MARGINS, Errand, PickPlacePlanner
from stages.robots import Robot, Table
from stages.scene.stance import Standing


def stuck(robot: Robot, placed: Mapping[str, Standing], supports: Mapping[str, str], table: Table) -> set[str]:
    """The objects that can be grasped in no order, after all others that can be.

    What is put down can be taken up again where it stands, the other way round, so a scene that comes apart can also
    be built. Objects without a grasp in the catalogue stay where they are.
    """
    left = dict(placed)
    wanted = {name for name, item in placed.items() if item.stance.item.grasps}
    while True:
        clear = [name for name in left if name in wanted and name not in {supports[other] for other in left}]
        taken = next((name for name in clear if _can_be_taken(robot, name, left, supports, table)), None)
        if taken is None:
            return wanted & set(left)
        del left[taken]


def _can_be_taken(
    robot: Robot, name: str, left: Mapping[str, Standing], supports: Mapping[str, str], table: Table
) -> bool:
    """Whether the hand takes and lifts the object, as the planner has it."""
    objects = {other: (item.stance.item, item.T_table_object) for other, item in left.items()}
    entry, T_base_object = objects[name]
    world = CollisionWorld(robot, table, objects, carried=name, clearance=MARGINS[-1].clearance)
    errand = Errand(entry, T_base_object, T_base_object[None], supports[name], supports[name])
    planner = PickPlacePlanner(world, errand, np.random.default_rng(0), room=MARGINS[-1].room)
    return planner.can_pick(robot.home)
