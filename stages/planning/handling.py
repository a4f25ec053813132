"""Whether the hand can take an object and put it down where a plan wants it, in the scene that the plan leaves then."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from stages.geometry.arrays import Floats
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.pick_place import MARGINS, Errand, PickPlacePlanner
from stages.planning.places.placements import Scene
from stages.planning.symbolic.search import Step
from stages.robots import Robot, Table
from stages.scene.stance import Standing

_EXAMINED = 36
"""Places of one step that are examined before anything moves."""
_QUARTER = 0.1
"""Metres apart at which two places differ as much as by a quarter turn."""


class Handling:
    """Grasps, postures and straight motions of single steps, with the least margins that a transfer is done with."""

    def __init__(
        self, robot: Robot, table: Table, rng: np.random.Generator, faced: frozenset[str] = frozenset()
    ) -> None:
        """``faced``: objects that have to show the side that their targets say."""
        self._robot, self._table, self._rng, self._faced = robot, table, rng, faced

    def of(self, step: Step, scene: Scene, places: Sequence[Standing]) -> Handled:
        """A step of a plan, with the places that its object may go to, best first."""
        objects = {name: (item.stance.item, scene.T_base_table @ _pose(item)) for name, item in scene.standing.items()}
        table = self._table.seen(scene.T_base_table, scene.surface)
        world = CollisionWorld(self._robot, table, objects, carried=step.item, clearance=MARGINS[-1].clearance)
        targets = np.stack([scene.T_base_table @ place.T_table_object for place in places])
        faces = step.item in self._faced
        errand = Errand(*objects[step.item], targets, step.source, step.destination, faces)
        return Handled(PickPlacePlanner(world, errand, self._rng, room=MARGINS[-1].room), self._robot, places)


class Handled:
    """Which places of one step can be reached, found as it is asked for and kept."""

    def __init__(self, planner: PickPlacePlanner, robot: Robot, places: Sequence[Standing]) -> None:
        self._planner, self._robot, self._places = planner, robot, places[:_EXAMINED]
        self._reached: dict[int, bool] = {}

    def places(self) -> Iterator[int]:
        """By number: the best, then always the one that differs most from all before, for those led nowhere."""
        pending, found = list(range(len(self._places))), list[Standing]()
        while pending:
            number = max(pending, key=lambda k: min((_difference(self._places[k], one) for one in found), default=0.0))
            pending.remove(number)
            if self._reaches(number):
                found.append(self._places[number])
                yield number

    def _reaches(self, number: int) -> bool:
        if number not in self._reached:
            self._reached[number] = self._planner.reaches(number, self._robot.home)
        return self._reached[number]

    @property
    def is_picked(self) -> bool:
        """Whether the hand takes the object, wherever it then gets with it."""
        return self._planner.is_picked

    def why_not(self) -> tuple[str, list[tuple[str, ...]]]:
        """Why no place is reached: in words, and the fewest objects in the way; others in other ways, if as few."""
        return self._planner.obstacle[1], self._planner.in_the_way(self._robot.home)


def _pose(item: Standing) -> Floats:
    """T_table_object, as the hand will find it."""
    return item.T_table_object if item.T_table_leaning is None else item.T_table_leaning


def _difference(a: Standing, b: Standing) -> float:
    """Between two places of an object: metres, and what its turn is worth."""
    A, B = a.T_table_object, b.T_table_object
    turn = np.arccos(np.clip((np.trace(A[:3, :3].T @ B[:3, :3]) - 1) / 2, -1.0, 1.0))
    return float(np.linalg.norm(A[:3, 3] - B[:3, 3]) + _QUARTER * turn / (np.pi / 2))
