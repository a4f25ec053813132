"""The suites by name."""

from __future__ import annotations

from runner.contract import Refused
from stages.devices.suites import tray
from stages.devices.suites.biased import Biased
from stages.devices.suites.disturbed import Disturbed
from stages.devices.suites.fallen import Fallen
from stages.devices.suites.hidden import Hidden
from stages.devices.suites.slippery import Slippery
from stages.devices.suites.suite import Drawn, Suite
from stages.devices.suites.swap import Swap
from stages.devices.suites.twins import Twins
from stages.devices.suites.wild import Wild
from stages.robots import Robot
from stages.scene.catalogue import Catalogue

TRAY = "tray"
DRAWN: dict[str, type[Drawn]] = {
    "wild": Wild,
    "swap": Swap,
    "twins": Twins,
    "biased": Biased,
    "hidden": Hidden,
    "fallen": Fallen,
    "slippery": Slippery,
    "disturbed": Disturbed,
}
"""Those whose goals are drawn."""
NAMES = (TRAY, *DRAWN)


def check(name: str, goal: str, seed: int, strangers: int) -> None:
    """Raises :class:`Refused` for suites that do not exist and what the suite does not have."""
    if name not in NAMES:
        raise Refused(f"world.suite: no suite {name!r}; choose one of {', '.join(NAMES)}")
    if name == TRAY:
        most = len(tray.GOALS[tray.goal_name(goal, seed)])
        if not 0 <= strangers <= most:
            raise Refused(f"world.strangers: {strangers} is not one of 0 to {most}")
    elif goal != "auto":
        raise Refused(f"world.goal: suite {name} draws its goals; {goal!r} is a goal of suite {TRAY}")


def suite(name: str, catalogue: Catalogue, robot: Robot, seed: int, *, goal: str = "auto", strangers: int = 0) -> Suite:
    """The world of a suite that a seed draws; ``goal`` and ``strangers`` are those of the suite ``tray``."""
    if name == TRAY:
        return tray.Tray(catalogue, robot, seed, goal, strangers)
    return DRAWN[name](catalogue, robot, seed)
