"""The suite ``slippery``: friction and mass are not as they are known, and what is lifted may fall from the hand."""

from __future__ import annotations

import numpy as np

from stages.devices.simulation import Factors, Simulation
from stages.devices.suites.draft import Draft
from stages.devices.suites.suite import Drawn, Kind, graspable, put_somewhere
from stages.devices.suites.wild import FIXED

_OFF = 0.5
"""Share by which friction and mass are off, at most."""
_FALLS, _MOST = 0.35, 3
"""Share of the lifts after which the object falls, and how often that happens at most."""
_AFTER = (0.3, 1.5)
"""Seconds in the hand after which it does: 1 to 6 cm above what it stood on."""
_GREASY, _WHILE = 0.01, 0.4
"""Factor on the friction of the finger pads, and for how many seconds."""


class Slippery(Drawn):
    """5 to 7 objects, heavier or lighter, rougher or smoother than they are known to be."""

    def choose(self, rng: np.random.Generator) -> None:
        """The objects, and how they differ."""
        fixed = [FIXED[0]] if rng.random() < 0.5 else []
        self.names = (*fixed, *rng.permutation(graspable(self.catalogue)).tolist()[: int(rng.integers(5, 8))])
        off = rng.uniform(1 - _OFF, 1 + _OFF, (len(self.names), 2)).tolist()
        self.factors = {name: Factors(*each) for name, each in zip(self.names, off, strict=True)}
        self._rng, self._fallen = rng, 0
        self._held, self._falls_in, self._grips_in = "", np.inf, np.inf

    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """As in the wild."""
        for name in self.names:
            carried = 0.0 if name in FIXED else 0.5 if kind == "goal" else 0.3
            put_somewhere(draft, name, rng, carried=carried, beside=0.25)

    def meddle(self, simulation: Simulation, seconds: float) -> str:
        """Lets some of what is lifted fall."""
        self._falls_in, self._grips_in = self._falls_in - seconds, self._grips_in - seconds
        if self._grips_in <= 0:
            self._grips_in = np.inf
            simulation.slide(1.0)
        held = simulation.held()
        if held and not self._held:
            falls = self._rng.random() < _FALLS and self._fallen < _MOST
            self._falls_in = float(self._rng.uniform(*_AFTER)) if falls else np.inf
        self._held = held
        if not held or self._falls_in > 0:
            return ""
        self._falls_in, self._grips_in = np.inf, _WHILE
        self._fallen += 1
        simulation.slide(_GREASY)
        return f"{held} falls from the hand"
