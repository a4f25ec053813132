"""A plan gone through without an arm that moves: every motion of every transfer, for whoever looks on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages import RobotCommand, Transfer
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.motion import free_motion, robot_command
from stages.planning.motion.pick_place import PickPlace, PickPlacePlanner, planners
from stages.robots import Robot, Table
from stages.scene.catalogue import CatalogueObject


@dataclass
class Rehearsal:
    """Transfers one after the other, each in the scene that those before it leave."""

    robot: Robot
    table: Table
    objects: Mapping[str, tuple[CatalogueObject, Floats]]
    """By name, with T_base_object."""
    rng: np.random.Generator
    unreached: str = ""
    """The transfer that no motions were found for, if there was one, and why."""

    def commands(self, transfers: Sequence[Transfer]) -> Iterator[RobotCommand]:
        """The arm's motions from home to home, as many transfers as there are motions for; the hand stays as it is."""
        objects = dict(self.objects)
        for transfer in transfers:
            found = self._found(transfer, objects)
            if isinstance(found, str):
                self.unreached = f"{transfer.object} to {transfer.destination}: {found}"
                return
            plan = found[-1]
            yield from self._motions(*found)
            objects[transfer.object] = (
                objects[transfer.object][0],
                plan.place.hand.T_base_hand @ inverse(plan.place.hand.T_object_hand),
            )

    def _found(
        self, transfer: Transfer, objects: Mapping[str, tuple[CatalogueObject, Floats]]
    ) -> tuple[CollisionWorld, PickPlacePlanner, PickPlace] | str:
        """A way to do it with the widest margins that there is one with; else why there is none."""
        why = ""
        for world, planner in planners(self.robot, self.table, objects, transfer, self.rng):
            plan = next(planner.plans(self.robot.home), None)
            if plan is not None:
                return world, planner, plan
            why = planner.obstacle[1]
        return why

    def _motions(self, world: CollisionWorld, planner: PickPlacePlanner, plan: PickPlace) -> Iterator[RobotCommand]:
        name, pick, place = world.carried, plan.pick, plan.place
        for label, path in (
            (f"reach for {name}", plan.reach),
            (f"close on {name}", pick.approach),
            (f"lift {name}", pick.lift),
            (f"carry {name}", plan.carry),
            (f"lower {name}", place.lower),
        ):
            yield robot_command(self.robot, label, path)
        retreat = planner.retreat(place.hand, place.lower[-1])
        assert retreat is not None  # The place was chosen for it.
        yield robot_command(self.robot, "retreat", retreat)
        world.move(place.hand.T_base_hand @ inverse(place.hand.T_object_hand))
        world.set_width(self.robot.gripper.open_width)
        home = free_motion(world, retreat[-1], self.robot.home, self.rng)
        if home is not None:
            yield robot_command(self.robot, "go home", home)
