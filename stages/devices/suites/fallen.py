"""The suite ``fallen``: starts with objects that lie or stand upside down."""

from __future__ import annotations

import numpy as np

from stages.devices.suites.draft import Draft
from stages.devices.suites.suite import Drawn, Kind, graspable, put, put_somewhere
from stages.devices.suites.wild import FIXED


class Fallen(Drawn):
    """4 to 6 objects, of which one or two have fallen over."""

    def choose(self, rng: np.random.Generator) -> None:
        """What has fallen, and how it lies."""
        labels = graspable(self.catalogue)
        fallen = [name for name in rng.permutation(labels).tolist() if len(self.catalogue[name].resting) > 1]
        fallen = fallen[: int(rng.integers(1, 3))]
        self._lying = {name: int(rng.integers(1, len(self.catalogue[name].resting))) for name in fallen}
        others = [name for name in rng.permutation(labels).tolist() if name not in fallen]
        fixed = [FIXED[0]] if rng.random() < 0.5 else []
        self.names = (*fixed, *fallen, *others[: int(rng.integers(3, 5))])

    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """All upright in the goal."""
        for name in self.names:
            if kind == "start" and name in self._lying:
                put(draft, name, resting=self._lying[name])
            else:
                put_somewhere(draft, name, rng, carried=0.0 if name in FIXED else 0.4, beside=0.25)

    def stubborn(self, kind: Kind) -> set[str]:
        """What lies so that no hand can take it is to be refused before anything moves."""
        return set(self._lying) if kind == "start" else set()
