"""A scene in the making: objects are put down one after the other, where they fit, drawn at random."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import copy
from types import MappingProxyType

import numpy as np

from stages.devices import tabletop
from stages.devices.tabletop import Layout
from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.geometry.regions import Region
from stages.robots import Robot, Table
from stages.scene.catalogue import Catalogue
from stages.scene.relations import TABLE
from stages.scene.scoring import label_of
from stages.scene.stance import Stances, Standing, yawed

BESIDE = 0.06
"""Metres between the footprints of objects that stand beside each other, at most."""
SEEN_BESIDE = BESIDE + 0.01
"""The same of objects that may be seen as standing so: perception may find them nearer to each other than they are."""
APART = 0.008
"""Metres between footprints, at least: less and objects touch while they settle."""
_MARGIN = 0.02
"""Metres from the table's edge that the robot keeps too."""
_MIDDLE = 0.01
"""Metres from the edge of what carries it at which the middle of an object stands, at least."""
_BEYOND = 0.03
"""Metres beyond the robot's reach within which things are drawn; what lies there may be out of reach."""
_TRIES = 30
_HIGHEST = 3
"""Objects in a stack."""
_TURN = np.deg2rad(22.5)
"""Between the turns of what is round at which is tried whether there is room beside it."""

Shapes = Mapping[str, Stances]
"""How every object of a catalogue stands, by label."""


def shapes(catalogue: Catalogue) -> Shapes:
    """Of all objects, computed as they are asked for."""
    return {label: Stances(item) for label, item in catalogue.objects.items()}


class Draft:
    """Objects that stand where they were put, in the base frame, and what carries each of them."""

    def __init__(
        self,
        catalogue: Catalogue,
        shapes: Shapes,
        rng: np.random.Generator,
        *,
        robot: Robot,
        table: Table,
        hidden: float,
        stay: Mapping[str, Standing] = MappingProxyType({}),
    ) -> None:
        """``hidden``: the largest share of an object that others may hide from the camera.

        What is to ``stay`` is put down where it is there, if it is put on the table.
        """
        self._catalogue, self._shapes, self._rng, self._robot = catalogue, shapes, rng, robot
        self._table, self._hidden, self._stay = table, hidden, stay
        low, high = (np.array(table.center) + side * np.array(table.size) / 2 for side in (-1, 1))
        self._surface = regions.rectangle(low.tolist(), high.tolist())
        self.placed: dict[str, Standing] = {}
        self.supports: dict[str, str] = {}

    @property
    def layout(self) -> Layout:
        """T_base_object by name, supporters first."""
        return {name: item.T_table_object for name, item in self.placed.items()}

    def put(
        self, name: str, support: str = TABLE, *, near: str = "", apart: float = APART, resting: int = 0
    ) -> bool:  # fmt: skip
        """Puts an object on or in ``support`` (beside ``near``) in one of its resting poses; False where none fits."""
        if name in self._stay and support == TABLE:
            T = self._stay[name].T_table_stance
            return self.put_at(name, support, T[:2, 3], float(np.arctan2(T[1, 0], T[0, 0])), apart=apart)
        for _ in range(_TRIES):
            place = self._place(support, near)
            if self.put_at(name, support, place, self._rng.uniform(-np.pi, np.pi), apart=apart, resting=resting) and (
                not near or regions.gap(self.placed[name].outline, self.placed[near].outline) < BESIDE
            ):
                return True
            self._take_away(name)
        return False

    def put_at(
        self, name: str, support: str, place: Floats, yaw: float, *, apart: float = APART, resting: int = 0
    ) -> bool:
        """Puts an object on or in ``support`` at a place (x, y) of the base frame; False where it does not fit."""
        label = label_of(name, self._catalogue)
        R = yawed(yaw, np.zeros(3))[:3, :3] @ self._catalogue[label].resting[resting]
        T = np.eye(4)
        T[:3, :3], T[:2, 3] = R, place
        item = self._at(name, T)
        if not self._is_carried(item, support):
            return False
        T[2, 3] = self._height(support, item.bottom) - item.stance.low
        item = self._at(name, T)
        if not self._is_apart(item, support, apart):
            return False
        self.placed[name], self.supports[name] = item, support
        if not self._is_seen():
            self._take_away(name)
            return False
        return True

    def carriers(self) -> list[str]:
        """What may carry one thing more: hollows, and flat tops on which nothing stands and that are not too high."""
        return [name for name, item in self.placed.items() if item.stance.cavity or self._is_free_top(item)]

    def moved_with(self, start: Draft) -> Iterator[Draft]:
        """What stands in, on and beside an object that the hand cannot take, where that object is at the ``start``.

        Once for each of its symmetries with which all of that is on the table and in sight; once, and empty, where
        there is nothing of the kind.
        """
        fixed = next((name for name, item in self.placed.items() if not item.stance.item.grasps), "")
        if fixed not in start.placed:
            yield self._with({}, start)
            return
        names = self._around(fixed)
        there, here = start.placed[fixed], inverse(self.placed[fixed].T_table_object)
        for turn in there.stance.item.symmetries.transforms(_TURN):
            T = there.T_table_object @ turn @ here
            placed = {
                name: self._at(name, T @ item.T_table_object) for name, item in self.placed.items() if name in names
            }
            moved = self._with(placed, start)
            on_table = (item for item in placed.values() if self.supports[item.name] == TABLE)
            if all(self._is_carried(item, TABLE) for item in on_table) and moved._is_seen():
                yield moved

    def _with(self, placed: dict[str, Standing], start: Draft) -> Draft:
        """The same with other objects, on the table of ``start``."""
        draft = copy(start)
        draft.placed, draft.supports = placed, {name: self.supports[name] for name in placed}
        return draft

    def _around(self, name: str) -> set[str]:
        """An object, what it carries, what stands beside it, and so on."""
        found, pending = {name}, [name]
        while pending:
            one = pending.pop()
            new = {
                other.name
                for other in self.placed.values()
                if self.supports[other.name] == one
                or (
                    self.supports[other.name] == self.supports[one]
                    and regions.gap(other.outline, self.placed[one].outline) < SEEN_BESIDE
                )
            } - found
            found |= new
            pending += sorted(new)
        return found

    def _at(self, name: str, T_base_object: Floats) -> Standing:
        return Standing.at(name, self._shapes[label_of(name, self._catalogue)], T_base_object)

    def _take_away(self, name: str) -> None:
        self.placed.pop(name, None)
        self.supports.pop(name, None)

    def _is_free_top(self, item: Standing) -> bool:
        flat = len(item.stance.item.collision) == 1 and item.stance.aligned
        return flat and item.name not in self.supports.values() and self._level(item.name) < _HIGHEST

    def _level(self, name: str) -> int:
        """1 for what stands on the table or in something, 2 for what stands on that."""
        support = self.supports[name]
        return 1 if support == TABLE or self.placed[support].stance.cavity else 1 + self._level(support)

    def _place(self, support: str, near: str) -> Floats:
        """x, y in the base frame."""
        if near:
            other = self.placed[near]
            reach = float(np.ptp(other.outline, axis=0).max()) / 2 + 0.15
            return other.T_table_stance[:2, 3] + self._rng.uniform(-reach, reach, 2)
        surface = self._surface_of(support)
        if support != TABLE and not self.placed[support].stance.cavity:
            return regions.centroid(surface) + self._rng.normal(0, 0.005, 2)
        return self._rng.uniform(surface.min(0), surface.max(0))

    def _surface_of(self, support: str) -> Region:
        if support == TABLE:
            return self._surface
        carrier = self.placed[support]
        return carrier.floor if carrier.stance.cavity else carrier.top

    def _height(self, support: str, bottom: Region) -> float:
        return self._table.height if support == TABLE else self.placed[support].rest_height(bottom)

    def _is_carried(self, item: Standing, support: str) -> bool:
        """Wholly over the table or a hollow's floor, by its middle on a top; and not far beyond the robot's reach."""
        if self._robot.beyond_reach(item.T_table_stance) > _BEYOND:
            return False
        surface = self._surface_of(support)
        if support == TABLE:
            return regions.inside(item.outline, surface, margin=_MARGIN)
        if self.placed[support].stance.cavity:
            return regions.inside(item.bottom, surface)
        return bool(regions.depth(surface, regions.centroid(item.bottom)[None])[0] >= _MIDDLE)

    def _is_apart(self, item: Standing, support: str, apart: float) -> bool:
        others = (other for name, other in self.placed.items() if name not in self._below(support))
        return all(
            other.z_bottom >= item.z_top or item.z_bottom >= other.z_top or item.separation(other) >= apart
            for other in others
        )

    def _below(self, support: str) -> set[str]:
        """What carries an object on ``support``, directly or not."""
        return set() if support == TABLE else {support, *self._below(self.supports[support])}

    def _is_seen(self) -> bool:
        """Whether all of it lies in the camera's image and nothing hides too much of another thing.

        What cannot be moved carries others, and is seen between them.
        """
        loose = [item for item in self.placed.values() if item.stance.item.grasps]
        return not loose or tabletop.is_seen(
            self._robot, [(i.stance.item, i.T_table_object) for i in loose], self._hidden
        )
