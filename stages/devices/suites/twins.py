"""The suite ``twins``: two or three equal objects of one or two kinds."""

from __future__ import annotations

import numpy as np

from stages.devices.suites.draft import Draft
from stages.devices.suites.suite import Drawn, Kind, graspable, put_somewhere
from stages.devices.suites.wild import FIXED
from stages.scene.naming import unique_names


class Twins(Drawn):
    """4 to 7 objects, among them equal ones."""

    def choose(self, rng: np.random.Generator) -> None:
        """Which objects there are more than one of."""
        labels = rng.permutation(graspable(self.catalogue)).tolist()
        kinds = int(rng.integers(1, 3))
        equal = [label for label in labels[:kinds] for _ in range(int(rng.integers(2, 4)) if kinds == 1 else 2)]
        single = labels[kinds : kinds + int(rng.integers(1, 3))]
        fixed = [FIXED[0]] if rng.random() < 0.5 else []
        self.names = tuple(unique_names([*fixed, *equal, *single]))

    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """As in the wild."""
        for name in self.names:
            carried = 0.0 if name in FIXED else 0.6 if kind == "goal" else 0.35
            put_somewhere(draft, name, rng, carried=carried, beside=0.25)
