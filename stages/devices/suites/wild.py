"""The suite ``wild``: random goals, random dense starts, and strangers that come with the start and must stay."""

from __future__ import annotations

import numpy as np

from stages.devices.suites.draft import Draft
from stages.devices.suites.suite import Drawn, Kind, graspable, put, put_somewhere

FIXED = ("tray", "plate", "")
"""What the robot cannot move; at most one of them, for how two stand to each other nobody could restore."""


class Wild(Drawn):
    """6 to 10 objects, up to two of them in no goal."""

    needed = FIXED[:2]

    def choose(self, rng: np.random.Generator) -> None:
        """What there is, and what of it is in no goal."""
        fixed = FIXED[rng.choice(3, p=(0.6, 0.2, 0.2))]
        count = int(rng.integers(6, 11))
        others = rng.permutation(graspable(self.catalogue)).tolist()[: count - bool(fixed)]
        self.names = tuple([fixed, *others] if fixed else others)
        self._strangers = self.names[count - int(rng.integers(0, 3)) :]

    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """Goals are tidied up, on and in each other; starts are strewn about."""
        for name in self.names:
            if name in self._strangers:
                if kind == "start":
                    put(draft, name)
            else:
                carried = 0.0 if name in FIXED else 0.6 if kind == "goal" else 0.35
                put_somewhere(draft, name, rng, carried=carried, beside=0.25)
