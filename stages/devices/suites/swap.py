"""The suite ``swap``: what must go where something else stands, which must go where that stood."""

from __future__ import annotations

import numpy as np

from stages.devices.suites.draft import Draft
from stages.devices.suites.suite import Drawn, Kind, Rejected, graspable, put

_FLAT = ("tea_box", "sugar_box", "cereal_box", "soup_can", "tuna_can", "sponge")
"""What carries others wherever it stands."""
_SLOTS = [(x, y) for x in (-0.127, 0.0, 0.127) for y in (-0.065, 0.065)]
"""Metres in the tray's frame: with all of them taken the tray is full."""
_ORDERED = 20
"""Draws of a full tray after which its objects change places: whether all are in sight is a matter of their order."""
_IN_CIRCLE = 500
"""Draws of a start after which the tray's objects have changed places in any way, not each to that of the next."""


class Swap(Drawn):
    """A circle of objects on each other's places, a tower upside down, or a full tray in another order."""

    needed = ("tray", *_FLAT)

    def choose(self, rng: np.random.Generator) -> None:
        """The kind of exchange, and one or two objects beside it."""
        self._exchange = (self._circle, self._tower, self._tray)[rng.integers(3)]
        self._draws: dict[Kind, int] = {"goal": 0, "start": 0}
        flat = rng.permutation(_FLAT).tolist()
        small = rng.permutation([name for name in graspable(self.catalogue) if name != "bowl"]).tolist()
        if self._exchange == self._tray:
            self._parts = small[: len(_SLOTS)]
            self.names = ("tray", *self._parts)
        elif self._exchange == self._tower:
            self._parts = flat[:3]
            self.names = tuple(self._parts)
        else:
            self._carriers = flat[: int(rng.integers(2, 4))]
            self._parts = [name for name in small if name not in self._carriers][: len(self._carriers)]
            self.names = (*self._carriers, *self._parts)
        others = [name for name in graspable(self.catalogue) if name not in self.names]
        self._beside = rng.permutation(others).tolist()[: int(rng.integers(1, 3))]
        self.names += tuple(self._beside)

    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """The exchange, one way round as goal and the other way round as start."""
        self._draws[kind] += 1
        if kind == "goal" and self._exchange == self._tray and self._draws[kind] > _ORDERED:
            self._parts = rng.permutation(self._parts).tolist()
        self._exchange(kind, draft, rng)
        for name in self._beside:
            put(draft, name)

    def _circle(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """Each on the carrier of the next one."""
        for name in self._carriers:
            put(draft, name)
        for k, name in enumerate(self._parts):
            put(draft, name, self._carriers[(k + (kind == "start")) % len(self._carriers)])

    def _tower(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        support = "table"
        for name in self._parts if kind == "goal" else self._parts[::-1]:
            put(draft, name, support)
            support = name

    def _tray(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """Every slot taken, at the start by the next object, by one farther on, or by any other."""
        put(draft, "tray")
        T = draft.placed["tray"].T_table_stance
        yaw = float(np.arctan2(T[1, 0], T[0, 0]))
        shown = slots = np.arange(len(_SLOTS))
        if kind == "start":
            slots = np.roll(shown, -1 - self._draws[kind] // _ORDERED % (len(_SLOTS) - 1))
            if self._draws[kind] > _IN_CIRCLE:
                slots = rng.permutation(shown)
                if (slots == shown).any():
                    raise Rejected("an object where the goal has it")
        for name, k in zip(self._parts, slots, strict=True):
            if not draft.put_at(name, "tray", (T @ [*_SLOTS[k], 0, 1])[:2], yaw):
                raise Rejected("no room in sight")
