"""What every suite is: objects on a table, of which a goal and a start scene are drawn until one is possible."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np

from runner.contract import Refused
from stages.devices.simulation import Factors, Simulation
from stages.devices.suites.draft import Draft, shapes
from stages.devices.tabletop import HIDDEN, Layout, least_shown
from stages.geometry.arrays import Floats
from stages.robots import Robot, Table
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.stance import Standing

Kind = Literal["goal", "start"]


_MIDDLE = (0.80, 0.0, 0.70)
"""Where the numbers of the suites have the middle of the table, in the base frame, metres."""


_STUBBORN = 60
"""Draws of a start after which what the hand cannot take stays where the goal has it, which is within reach there."""


class Rejected(Exception):
    """A draw that physics, reach or sight make impossible; the text says which, in a few words."""


class Suite(ABC):
    """A world of one suite: its objects, and scenes of them."""

    names: tuple[str, ...]
    """All objects that any scene has; a scene may do without some."""
    table: Table
    joints = 0.0
    """Radians by which encoders are off at most."""

    factors: Mapping[str, Factors] = MappingProxyType({})
    """Objects that are not as the catalogue has them."""

    @abstractmethod
    def sample(self, kind: Kind, rng: np.random.Generator) -> Layout:
        """One draw of a scene.

        Raises:
            Rejected: it is impossible.
        """

    def meddle(self, simulation: Simulation, seconds: float) -> str:
        """Called after every ``seconds`` in which the robot moves or looks; says in words what has happened, if it has.

        Begins with the start scene.
        """
        return ""


_SHOWN = 0.05
"""Share of its silhouette that an object of a goal shows at least: what nobody sees is not shown."""


class Drawn(Suite):
    """A suite whose scenes are put together object by object, as a draft; nothing in them is written by hand."""

    needed: ClassVar[tuple[str, ...]] = ("tray",)
    """Labels that the catalogue must have."""
    hidden: ClassVar[dict[Kind, float]] = {"goal": HIDDEN, "start": 0.8}
    """Largest share of an object that others in front of it hide from the camera."""

    def __init__(self, catalogue: Catalogue, robot: Robot, seed: int) -> None:
        need(type(self).__name__.lower(), self.needed, catalogue)
        self.catalogue, self.robot, self.table, self._shapes = catalogue, robot, robot.table, shapes(catalogue)
        self._goal: Draft | None = None
        """The newest: what a start must leave room for."""
        self._drawn = 0
        """Starts drawn for it."""
        self.choose(np.random.default_rng([seed, 2]))

    @abstractmethod
    def choose(self, rng: np.random.Generator) -> None:
        """Sets the names, and what else goal and start have in common."""

    @abstractmethod
    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """Puts the objects of a scene down; raises :class:`Rejected` where there is no room."""

    def stubborn(self, kind: Kind) -> set[str]:
        """Objects for which there need be no grasp."""
        return set()

    def sample(self, kind: Kind, rng: np.random.Generator) -> Layout:
        """Puts a draft together and tests whether the robot could take it apart."""
        # Motion planning takes half a second to load; whoever only reads a graph does without.
        from stages.devices.suites.reach import stuck

        self._drawn = self._drawn + 1 if kind == "start" else 0
        draft = Draft(
            self.catalogue,
            self._shapes,
            rng,
            robot=self.robot,
            table=self.table,
            hidden=self.hidden[kind],
            stay=self._fixed() if self._drawn > _STUBBORN else {},
        )
        self.draw(kind, draft, rng)
        if stuck(self.robot, draft.placed, draft.supports, self.table) - self.stubborn(kind):
            raise Rejected("out of reach")
        if kind == "goal":
            items = draft.placed.values()
            if least_shown(self.robot, [(i.stance.item, i.T_table_object) for i in items]) < _SHOWN:
                raise Rejected("of an object next to nothing is in sight")
            self._goal = draft
        elif self._goal is not None and all(
            stuck(self.robot, there.placed, there.supports, self.table) for there in self._goal.moved_with(draft)
        ):
            raise Rejected("the goal is out of reach or sight around what cannot be moved")
        return draft.layout

    def _fixed(self) -> dict[str, Standing]:
        """What the hand cannot take, where the goal has it."""
        placed = self._goal.placed if self._goal is not None else {}
        return {name: item for name, item in placed.items() if not item.stance.item.grasps}


def need(suite: str, labels: Iterable[str], catalogue: Catalogue) -> None:
    """Raises Refused where the catalogue lacks labels of which a suite makes its scenes, or all that can be moved."""
    missing = [label for label in labels if label not in catalogue.objects]
    if missing or not graspable(catalogue):
        lacks = ", ".join(missing) or "anything with grasps"
        raise Refused(
            f"world.catalogue: suite {suite} needs {lacks} as well; valid: a copy of {BUILT_IN} with your objects added"
        )


def shift(robot: Robot) -> Floats:
    """How far the middle of the robot's table is from there, x y z, metres."""
    return np.subtract((*robot.table.center, robot.table.height), _MIDDLE)


def graspable(catalogue: Catalogue) -> list[str]:
    """Labels of what the robot can move."""
    return [name for name, item in catalogue.objects.items() if item.grasps]


def put(draft: Draft, name: str, support: str = "table", *, near: str = "", resting: int = 0) -> None:
    """Puts an object down.

    Raises:
        Rejected: it fits nowhere there.
    """
    if not draft.put(name, support, near=near, resting=resting):
        raise Rejected("no room in sight")


def put_somewhere(draft: Draft, name: str, rng: np.random.Generator, *, carried: float, beside: float) -> None:
    """Puts an object on or in another one (a share ``carried`` of them), beside one, or anywhere on the table.

    Raises:
        Rejected: there is no room for it on the table either.
    """
    way = rng.random()
    if way < carried and _put_on_any(draft, name, draft.carriers(), rng):
        return
    on_table = [other for other, support in draft.supports.items() if support == "table"]
    if carried <= way < carried + beside and on_table and draft.put(name, near=on_table[rng.integers(len(on_table))]):
        return
    put(draft, name)


def _put_on_any(draft: Draft, name: str, carriers: list[str], rng: np.random.Generator) -> bool:
    return any(draft.put(name, carriers[k]) for k in rng.permutation(len(carriers))[:2])
