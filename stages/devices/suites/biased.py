"""The suite ``biased``: joints that are off as well as the camera, and a table that is not yesterday's."""

from __future__ import annotations

import numpy as np

from stages.devices.suites.draft import Draft
from stages.devices.suites.suite import Drawn, Kind, graspable, put_somewhere, shift
from stages.devices.suites.wild import FIXED
from stages.robots import Table


class Biased(Drawn):
    """5 to 7 objects, seen and handled by a robot that is not calibrated."""

    joints = np.deg2rad(0.3)

    def choose(self, rng: np.random.Generator) -> None:
        """The objects and the table."""
        fixed = [FIXED[0]] if rng.random() < 0.5 else []
        self.names = (*fixed, *rng.permutation(graspable(self.catalogue)).tolist()[: int(rng.integers(5, 8))])
        dx, _, dz = shift(self.robot).tolist()
        depth, front = float(rng.uniform(0.55, 0.85)), float(rng.uniform(0.40, 0.48))
        self.table = Table(
            center=(dx + front + depth / 2, float(rng.uniform(-0.05, 0.05))),
            size=(depth, float(rng.uniform(1.0, 1.4))),
            height=dz + float(rng.uniform(0.66, 0.74)),
        )

    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """As in the wild."""
        for name in self.names:
            carried = 0.0 if name in FIXED else 0.5 if kind == "goal" else 0.3
            put_somewhere(draft, name, rng, carried=carried, beside=0.25)
