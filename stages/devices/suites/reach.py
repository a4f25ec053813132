"""Whether the robot could take a scene apart: the test that a drawn scene is possible at all."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stages.planning.collision import CollisionWorld
from stages.planning.grasps import HandPose, distinct_grasps, hand_poses
from stages.planning.motion import restarts, solve_ik
from stages.planning.pick_place import LIFT, opening, raised
from stages.robots import Robot, Table
from stages.scene.stance import Standing

_ROOM = 0.006
"""Metres between object and finger: half of what the executor likes to have."""
_CLEARANCE = 0.001
_POSTURES = 1
"""Random postures beside the one at home from which inverse kinematics starts."""


def stuck(robot: Robot, placed: Mapping[str, Standing], supports: Mapping[str, str], table: Table) -> set[str]:
    """The objects that can be grasped in no order, after all others that can be.

    What is put down can be taken up again where it stands, the other way round, so a scene that comes apart can also
    be built. Objects without a grasp in the catalogue stay where they are.
    """
    left = dict(placed)
    wanted = {name for name, item in placed.items() if item.stance.item.grasps}
    while True:
        clear = [name for name in left if name in wanted and name not in {supports[other] for other in left}]
        taken = next((name for name in clear if _can_be_taken(robot, name, left, table)), None)
        if taken is None:
            return wanted & set(left)
        del left[taken]


def _can_be_taken(robot: Robot, name: str, left: Mapping[str, Standing], table: Table) -> bool:
    """Whether there is a grasp, free of collisions, from which the object can be lifted."""
    objects = {other: (item.stance.item, item.T_table_object) for other, item in left.items()}
    entry, T_base_object = objects[name]
    world = CollisionWorld(robot, table, objects, carried=name, clearance=_CLEARANCE)
    with world.touching(name):
        return any(
            _reaches(world, hand) for g in distinct_grasps(entry) for hand in hand_poses(entry, g, T_base_object)
        )


def _reaches(world: CollisionWorld, hand: HandPose) -> bool:
    world.set_width(opening(world, hand.grasp, _ROOM))
    home = world.robot.home
    q = solve_ik(
        world, hand.T_base_hand, seeds=restarts(world, np.random.default_rng(0), home, extra=_POSTURES), free=True
    )
    return q is not None and solve_ik(world, raised(hand.T_base_hand, LIFT), seeds=iter([q])) is not None
