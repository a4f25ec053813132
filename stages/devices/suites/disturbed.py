"""The suite ``disturbed``: somebody moves, takes away, brings and returns objects while the robot works."""

from __future__ import annotations

import numpy as np

from stages.devices.simulation import Simulation
from stages.devices.suites.draft import Draft
from stages.devices.suites.placing import upright
from stages.devices.suites.suite import Drawn, Kind, graspable, put_somewhere
from stages.devices.suites.wild import FIXED
from stages.devices.tabletop import is_seen
from stages.scene.scoring import label_of
from stages.scene.stance import Standing

_DEEDS = (2, 4)
"""Times that somebody does something, at least and less than."""
_BETWEEN = (6.0, 25.0)
"""Seconds of the robot's work from one deed to the next."""
_BACK = (3.0, 8.0)
"""Seconds after which what was taken away is returned."""
_REACH = 0.68
"""Metres around the robot's shoulder within which objects are put."""
_NEAR, _FAR, _WIDE = 0.52, 0.78, 0.40
_ROOM, _HAND = 0.03, 0.20
"""Metres around an object that somebody puts down, and between it and the robot's hand."""
_TRIES = 60
_AGAIN = 1.0
"""Seconds after which somebody tries again who has found nothing to do."""


class Disturbed(Drawn):
    """5 to 7 objects, of which one is brought while the robot works, and stays; it is in no goal."""

    def choose(self, rng: np.random.Generator) -> None:
        """The objects, and what is done when."""
        fixed = [FIXED[0]] if rng.random() < 0.5 else []
        *loose, self._stranger = rng.permutation(graspable(self.catalogue)).tolist()[: int(rng.integers(6, 9))]
        self.names = (*fixed, *loose, self._stranger)
        self._rng, self._away, self._from = rng, "", np.eye(4)
        deeds = rng.choice(("move", "take", "bring"), int(rng.integers(*_DEEDS)), p=(0.5, 0.25, 0.25)).tolist()
        self._deeds = list(dict.fromkeys(deeds)) if "bring" in deeds else deeds
        self._next = float(rng.uniform(*_BETWEEN))

    def draw(self, kind: Kind, draft: Draft, rng: np.random.Generator) -> None:
        """As in the wild."""
        for name in self.names:
            if name != self._stranger:
                carried = 0.0 if name in FIXED else 0.5 if kind == "goal" else 0.3
                put_somewhere(draft, name, rng, carried=carried, beside=0.25)

    def meddle(self, simulation: Simulation, seconds: float) -> str:
        """Does the next thing when its time has come and there is a way to do it."""
        self._next -= seconds
        if self._next > 0:
            return ""
        self._next = _AGAIN
        if self._away:
            return self._return(simulation)
        return self._do(simulation, self._deeds[0]) if self._deeds else ""

    def _do(self, simulation: Simulation, deed: str) -> str:
        """Moves, takes or brings an object, if there is one and room for it."""
        name = self._stranger if deed == "bring" else self._loose(simulation)
        if not name:
            return ""
        carried = simulation.held()
        if deed == "take":
            self._away, self._from = name, simulation.layout()[name]
            simulation.remove(name)
        elif not self._put(name, simulation):
            return ""
        del self._deeds[0]
        self._next = float(self._rng.uniform(*(_BACK if self._away else _BETWEEN)))
        word = {"move": "moves", "take": "takes away", "bring": "brings"}[deed]
        return f"somebody {word} {name}" + (f" while the robot carries {carried}" if carried else "")

    def _return(self, simulation: Simulation) -> str:
        """Elsewhere or, where there is no room, where it was."""
        if not self._put(self._away, simulation):
            simulation.add(self._away, self._from)
            if simulation.touching(self._away):
                simulation.remove(self._away)
                return ""
        name, self._away, self._next = self._away, "", float(self._rng.uniform(*_BETWEEN))
        return f"somebody returns {name}"

    def _put(self, name: str, simulation: Simulation) -> bool:
        """Puts an object down where there is room, in sight and away from the arm; False where that is nowhere."""
        layout = {one: T for one, T in simulation.layout().items() if one != name}
        others = [Standing.at(one, self._shapes[label_of(one, self.catalogue)], T) for one, T in layout.items()]
        entry = self.catalogue[label_of(name, self.catalogue)]
        loose = [(self.catalogue[label_of(one, self.catalogue)], T) for one, T in layout.items() if one not in FIXED]
        for _ in range(_TRIES):
            x, y, yaw = self._rng.uniform((_NEAR, -_WIDE, -np.pi), (_FAR, _WIDE, np.pi)).tolist()
            T = upright(entry, x, y, yaw, self.table.height)
            item = Standing.at(name, self._shapes[label_of(name, self.catalogue)], T)
            reach = np.hypot(x - self.robot.shoulder[0], y - self.robot.shoulder[1])
            hand = np.linalg.norm(simulation.hand()[:2] - (x, y))
            if reach > _REACH or hand < _HAND or not is_seen(self.robot, [*loose, (entry, T)]):
                continue
            if all(item.separation(other) > _ROOM for other in others):
                simulation.add(name, T)
                return True
        return False

    def _loose(self, simulation: Simulation) -> str:
        """An object of the goal that stands on the table and carries nothing; empty where there is none."""
        names = [name for name in simulation.present if name not in (*FIXED, self._stranger)]
        return next((n for n in self._rng.permutation(names).tolist() if simulation.touching(n) == {"table"}), "")
