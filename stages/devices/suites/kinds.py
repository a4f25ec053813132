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


def check(name: str, goal: str, seed: int) -> None:
    """Raises :class:`Refused` for suites that do not exist and goals that the suite does not have."""
    if name not in NAMES:
        raise Refused(f"world.suite: no suite {name!r}; choose one of {', '.join(NAMES)}")
    if name == TRAY:
        tray.goal_name(goal, seed)
    elif goal != "auto":
        raise Refused(f"world.goal: suite {name} draws its goals; {goal!r} is a goal of suite {TRAY}")


def suite(name: str, catalogue: Catalogue, robot: Robot, seed: int, *, goal: str = "auto") -> Suite:
    """The world of a suite that a seed draws."""
    return tray.Tray(catalogue, robot, seed, goal) if name == TRAY else DRAWN[name](catalogue, robot, seed)
