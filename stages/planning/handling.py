"""Whether the hand can take an object and put it down where a plan wants it, in the scene that the plan leaves then."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from stages.planning.collision import CollisionWorld
from stages.planning.pick_place import MARGINS, Errand, PickPlacePlanner
from stages.planning.placements import Scene
from stages.planning.search import Step
from stages.robots import Robot, Table
from stages.scene.stance import Standing


class Handling:
    """Grasps, postures and straight motions of single steps, with the least margins that a transfer is done with."""

    def __init__(self, robot: Robot, table: Table, rng: np.random.Generator) -> None:
        self._robot, self._table, self._rng = robot, table, rng

    def of(self, step: Step, scene: Scene, places: Sequence[Standing]) -> Handled:
        """A step of a plan, with the places that its object may go to, best first."""
        objects = {
            name: (item.stance.item, scene.T_base_table @ item.T_table_object) for name, item in scene.standing.items()
        }
        table = replace(self._table, height=float(scene.T_base_table[2, 3]))
        world = CollisionWorld(self._robot, table, objects, carried=step.item, clearance=MARGINS[-1].clearance)
        targets = np.stack([scene.T_base_table @ place.T_table_object for place in places])
        errand = Errand(*objects[step.item], targets, step.source, step.destination)
        return Handled(PickPlacePlanner(world, errand, self._rng, room=MARGINS[-1].room), self._robot)


class Handled:
    """The places of one step that can be reached, found as they are asked for and kept."""

    def __init__(self, planner: PickPlacePlanner, robot: Robot) -> None:
        self._planner, self._robot = planner, robot
        self._pending = planner.reachable(robot.home)
        self._found: list[int] = []

    def places(self) -> Iterator[int]:
        """By number, best first."""
        yield from self._found
        for number in self._pending:
            self._found.append(number)
            yield number

    def why_not(self) -> tuple[str, tuple[str, ...]]:
        """Why no place is reached: in words, and the objects in the way."""
        return self._planner.obstacle[1], self._planner.in_the_way(self._robot.home)
