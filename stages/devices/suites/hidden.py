"""The suite ``hidden``: starts in which objects of the goal are behind or under others, up to wholly."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from stages.devices.suites.draft import APART, Draft
from stages.devices.suites.suite import Drawn, Kind, Rejected, graspable, put, put_somewhere
from stages.devices.suites.wild import FIXED
from stages.devices.tabletop import HIDDEN
from stages.geometry.poses import inverse

_TALL = ("cereal_box", "milk_carton", "sugar_box")
_LOW = ("tuna_can", "soup_can", "salt_shaker", "cup")
_WIDE = ("sponge", "tea_box", "bowl")
"""What covers a can from above."""


class Hidden(Drawn):
    """4 to 7 objects, of which one or two are hidden when the work begins."""

    needed = (FIXED[0], *_TALL, *_LOW, *_WIDE)
    hidden: ClassVar[dict[Kind, float]] = {"goal": HIDDEN, "start": 1.0}

    def choose(self, rng: np.random.Generator) -> None:
        """Who hides behind whom."""
        tall, low = rng.permutation(_TALL).tolist(), rng.permutation(_LOW).tolist()
        count = int(rng.integers(1, 3))
        self._behind = dict(zip(low[:count], tall, strict=False))
        wide = [name for name in _WIDE if name not in self._behind]
        self._under = {"tuna_can": wide[rng.integers(len(wide))]} if "tuna_can" not in self._behind else {}
        named = list(dict.fromkeys([*self._behind.values(), *self._behind, *self._under, *self._under.values()]))
        others = [name for name in rng.permutation(graspable(self.catalogue)).tolist() if name not in named]
        fixed = [FIXED[0]] if rng.random() < 0.5 else []
        self.names = (*fixed, *named, *others[: int(rng.integers(0, 3))])

    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """The goal is in full view."""
        below = {upper: lower for lower, upper in self._under.items()}
        for name in self.names:
            if kind == "start" and name in self._behind:
                self._hide(draft, name, rng)
            elif kind == "start" and name in below:
                put(draft, name, below[name])
            else:
                carried = 0.0 if name in FIXED or kind == "start" else 0.4
                put_somewhere(draft, name, rng, carried=carried, beside=0.0 if kind == "start" else 0.25)

    def _hide(self, draft: Draft, name: str, rng: np.random.Generator) -> None:
        """Straight behind the other one, as the camera sees it, nearly touching it or a little apart."""
        hider = draft.placed[self._behind[name]].T_table_stance[:2, 3]
        away = hider - inverse(self.robot.T_camera_base)[:2, 3]
        away /= np.linalg.norm(away)
        for distance in np.arange(0.04, 0.16, 0.005):
            place = hider + (distance + rng.uniform(0, 0.02)) * away
            if draft.put_at(name, "table", place, rng.uniform(-np.pi, np.pi), apart=APART):
                return
        raise Rejected("no room in sight")
