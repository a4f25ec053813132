"""The suite ``tray``: five goals written by hand, five objects on and around a tray, upright and apart; strangers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np

from runner.contract import Refused
from stages.devices.suites.draft import SEEN_BESIDE
from stages.devices.suites.placing import support_height, upright
from stages.devices.suites.suite import Kind, Rejected, Suite, graspable, need, shift
from stages.devices.tabletop import Layout, image_rectangle, is_inside_image, is_seen
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, pose
from stages.robots import Robot
from stages.scene.catalogue import Catalogue, CatalogueObject

TRAY = "tray"

_NEAR, _FAR = 0.52, 0.80
"""Metres ahead between which objects stand."""
_APART = 0.04
"""Metres between objects that are not placed together: room for a finger."""
_REGION = 0.03
"""Metres beside the place that was shown where an object may stand as well."""
_EDGE = 0.08
"""Metres from the table's edge that the middle of a stranger keeps."""
_STACKED_SHARE = 0.3
"""Share of start scenes that contain a stack, which is not the goal's."""
_ATTEMPTS = 2000


@dataclass(frozen=True)
class Spot:
    """Where an object stands upright: on ``support``, at (x, y, yaw) in the frame of ``beside``; metres, degrees.

    ``beside`` is the support unless named. On the table, without ``beside``, the place is drawn at random.
    """

    name: str
    support: str
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    beside: str = ""


GOALS: dict[str, tuple[Spot, ...]] = {
    "tea": (
        Spot("tea_box", TRAY, x=-0.080, yaw=90),
        Spot("soup_can", "tea_box"),
        Spot("cup", TRAY, x=0.050),
        Spot("sugar_box", "table"),
        Spot("water_bottle", "table", y=0.105, beside="sugar_box"),
    ),
    "breakfast": (
        Spot("sugar_box", TRAY, x=-0.100),
        Spot("tea_box", TRAY, x=0.050, yaw=90),
        Spot("tuna_can", "tea_box"),
        Spot("milk_carton", "table"),
        Spot("cup", "table", y=0.105, beside="milk_carton"),
    ),
    "lunch": (
        Spot("tuna_can", TRAY, x=-0.090),
        Spot("soup_can", "tuna_can"),
        Spot("salt_shaker", TRAY, x=0.005),
        Spot("cereal_box", TRAY, x=0.125),
        Spot("water_bottle", "table"),
    ),
    "snack": (
        Spot("cup", TRAY, x=-0.120),
        Spot("milk_carton", TRAY, x=-0.015),
        Spot("tea_box", "table"),
        Spot("salt_shaker", "tea_box"),
        Spot("tuna_can", TRAY, x=0.120),
    ),
    "supper": (
        Spot("cup", TRAY, x=-0.120),
        Spot("salt_shaker", TRAY, x=0.0),
        Spot("tuna_can", TRAY, x=0.110),
        Spot("sugar_box", "table"),
        Spot("water_bottle", "table", y=0.105, beside="sugar_box"),
    ),
}
"""Goal scenes by name. Neighbours stand 3 cm apart, in line with neither's fingers."""
_BY_SEED = ("tea", "breakfast", "lunch", "snack")
"""Those that ``auto`` chooses from: a seed keeps its world."""


def goal_name(goal: str, seed: int) -> str:
    """The goal template that ``goal`` names; ``auto`` chooses by ``seed``.

    Raises:
        Refused: no such template.
    """
    if goal == "auto":
        return _BY_SEED[seed % len(_BY_SEED)]
    if goal not in GOALS:
        raise Refused(f"world.goal: no goal scene {goal!r}; choose auto or one of {', '.join(GOALS)}")
    return goal


def object_names(goal: str) -> tuple[str, ...]:
    """The tray and the objects of a goal template."""
    return (TRAY, *(spot.name for spot in GOALS[goal]))


class Tray(Suite):
    """One of the goals, chosen by name or by the seed; as start the objects apart on the table, among strangers."""

    def __init__(self, catalogue: Catalogue, robot: Robot, seed: int, goal: str = "auto", strangers: int = 0) -> None:
        self._catalogue, self._robot, self._goal = catalogue, robot, goal_name(goal, seed)
        need(TRAY, object_names(self._goal), catalogue)
        self.table = robot.table
        self._strangers = look_alikes(self._goal, catalogue, np.random.default_rng([seed, 2]))[:strangers]
        self.names = (*object_names(self._goal), *self._strangers)
        self._shown: Layout = {}
        """The newest goal: what a start must leave room for."""

    def sample(self, kind: Kind, rng: np.random.Generator) -> Layout:
        """A scene of the goal; the strangers come with the start."""
        if kind == "goal":
            self._shown = sample_goal(self._goal, self._catalogue, self._robot, rng)
            return self._shown
        layout = sample_start(self._goal, self._catalogue, self._robot, rng)
        if self._shown and not _leaves_room(layout[TRAY], self._shown, self._goal, self._catalogue, self._robot):
            raise Rejected("what the goal has beside the tray is out of reach there")
        for name in self._strangers:
            _add_stranger(name, layout, self._catalogue, self._robot, rng)
        return layout


def look_alikes(goal: str, catalogue: Catalogue, rng: np.random.Generator) -> list[str]:
    """For each object of the goal, in any order, the nearest in size that is not in the goal and the hand can move."""
    left = {
        name: np.sort(catalogue[name].dimensions) for name in graspable(catalogue) if name not in object_names(goal)
    }
    alike = []
    for spot in rng.permutation([spot.name for spot in GOALS[goal]])[: len(left)]:
        size = np.sort(catalogue[spot].dimensions)
        alike.append(min(left, key=lambda name: float(np.linalg.norm(left[name] - size))))
        del left[alike[-1]]
    return alike


def _add_stranger(name: str, layout: Layout, catalogue: Catalogue, robot: Robot, rng: np.random.Generator) -> None:
    """Puts it where it keeps its distance and hides nothing too much; nobody has to reach it.

    Raises:
        Rejected: there is no such place.
    """
    entry, size = catalogue[name], np.array(robot.table.size) / 2 - _EDGE
    for _ in range(_ATTEMPTS):
        x, y = robot.table.center + rng.uniform(-size, size)
        layout[name] = upright(entry, x, y, rng.uniform(-np.pi, np.pi), robot.table.height)
        if _is_apart(name, layout, catalogue) and _is_seen(layout, catalogue, robot):
            return
    raise Rejected(f"no room for {name}")


def sample_goal(goal: str, catalogue: Catalogue, robot: Robot, rng: np.random.Generator) -> Layout:
    """Draws the tray's place and the free places of a goal template until everything is reachable and seen."""
    together = {frozenset((spot.name, spot.beside)) for spot in GOALS[goal] if spot.beside}
    for _ in range(_ATTEMPTS):
        layout = {TRAY: _tray_pose(catalogue, robot, rng)}
        for spot in GOALS[goal]:
            layout[spot.name] = _spot_pose(spot, layout, catalogue, robot, rng)
        standing = [TRAY, *(spot.name for spot in GOALS[goal] if spot.support == "table")]
        if _is_good(layout, standing, together, catalogue, robot):
            return layout
    raise RuntimeError(f"no room for the goal scene {goal}")


def sample_start(goal: str, catalogue: Catalogue, robot: Robot, rng: np.random.Generator) -> Layout:
    """Draws a start scene for the objects of a goal template: the tray elsewhere, the others apart on the table.

    Some scenes contain a stack that the goal does not have.
    """
    stack = _wrong_stack(goal, catalogue, rng)
    names = [name for name in object_names(goal) if stack is None or name != stack[0]]
    for _ in range(_ATTEMPTS):
        layout = _scatter(names, goal, catalogue, robot, rng)
        if layout is None:
            continue
        if stack is not None:
            upper, lower = stack
            layout[upper] = _spot_pose(Spot(upper, lower, yaw=rng.uniform(0, 360)), layout, catalogue, robot, rng)
        if _is_good(layout, names, set(), catalogue, robot):
            return layout
    raise RuntimeError(f"no room for a start scene of {', '.join(names)}")


def _scatter(
    names: list[str], goal: str, catalogue: Catalogue, robot: Robot, rng: np.random.Generator
) -> Layout | None:
    """Places one object after the other where it keeps its distance; None where the table is too full."""
    layout: Layout = {}
    for name in names:
        for _ in range(60):
            T = _tray_pose(catalogue, robot, rng) if name == TRAY else _free_pose(catalogue[name], robot, rng)
            layout[name] = T
            if _fits(name, layout, goal, catalogue, robot):
                break
        else:
            return None
    return layout


def _fits(name: str, layout: Layout, goal: str, catalogue: Catalogue, robot: Robot) -> bool:
    """The object is in reach (of the tray: what the goal puts into it), in view and apart from all others."""
    T, entry = layout[name], catalogue[name]
    if name == TRAY:
        fits = _can_be_filled(T, goal, robot)
    else:
        fits = _reachable(T, robot) and is_inside_image(robot, image_rectangle(robot, entry, T))
    return fits and _is_apart(name, layout, catalogue)


def _is_apart(name: str, layout: Layout, catalogue: Catalogue) -> bool:
    """The object keeps its distance from all others."""
    return all(_gap(name, other, layout, catalogue) >= _APART for other in layout if other != name)


def _can_be_filled(T_base_tray: Floats, goal: str, robot: Robot) -> bool:
    """Every place in the tray that the goal uses is in reach."""
    spots = [spot for spot in GOALS[goal] if spot.support == TRAY]
    return all(_reachable(T_base_tray @ pose(np.eye(3), np.array([spot.x, spot.y, 0.0])), robot) for spot in spots)


def _leaves_room(T_base_tray: Floats, shown: Layout, goal: str, catalogue: Catalogue, robot: Robot) -> bool:
    """Whether what stood beside the tray when the goal was shown is in reach beside the tray as it is now."""
    standing = {spot.name for spot in GOALS[goal] if spot.support == "table"}
    beside, pending = set[str](), [TRAY]
    while pending:
        one = pending.pop()
        near = {name for name in standing - beside if _gap(one, name, shown, catalogue) < SEEN_BESIDE}
        beside |= near
        pending += near
    return any(
        all(_reachable(T_base_tray @ turn @ inverse(shown[TRAY]) @ shown[name], robot, _REGION) for name in beside)
        for turn in catalogue[TRAY].symmetries.transforms()
    )


def _wrong_stack(goal: str, catalogue: Catalogue, rng: np.random.Generator) -> tuple[str, str] | None:
    """An (upper, lower) pair that stands safely and is not in the goal, or None."""
    wanted = {(spot.name, spot.support) for spot in GOALS[goal]}
    names = [spot.name for spot in GOALS[goal]]
    pairs = [pair for pair in permutations(names, 2) if pair not in wanted and _stands_on(*pair, catalogue)]
    if not pairs or rng.random() > _STACKED_SHARE:
        return None
    return pairs[rng.integers(len(pairs))]


def _stands_on(upper: str, lower: str, catalogue: Catalogue) -> bool:
    above, below = catalogue[upper], catalogue[lower]
    flat = len(below.collision) == 1 and not below.concave
    low = above.dimensions[2] + below.dimensions[2] < 0.2
    return bool(flat and low and above.dimensions[:2].max() <= 1.1 * below.dimensions[:2].min())


def _tray_pose(catalogue: Catalogue, robot: Robot, rng: np.random.Generator) -> Floats:
    """The tray to the left or right of the middle, its long side roughly along the table's edge."""
    y = rng.choice([-1, 1]) * rng.uniform(0.14, 0.25)
    x, yaw = rng.uniform(0.63, 0.68), np.deg2rad(90 + rng.uniform(-12, 12))
    return _on_table(catalogue[TRAY], x, y, yaw, robot)


def _free_pose(entry: CatalogueObject, robot: Robot, rng: np.random.Generator) -> Floats:
    x, y = rng.uniform(_NEAR, _FAR), rng.uniform(-0.45, 0.45)
    return _on_table(entry, x, y, rng.uniform(-np.pi, np.pi), robot)


def _on_table(entry: CatalogueObject, x: float, y: float, yaw: float, robot: Robot) -> Floats:
    dx, dy, _ = shift(robot)
    return upright(entry, x + dx, y + dy, yaw, robot.table.height)


def _spot_pose(spot: Spot, layout: Layout, catalogue: Catalogue, robot: Robot, rng: np.random.Generator) -> Floats:
    entry = catalogue[spot.name]
    reference = spot.beside or spot.support
    if reference == "table":
        return _free_pose(entry, robot, rng)
    T = layout[reference]
    x, y = (T @ [spot.x, spot.y, 0, 1])[:2]
    yaw = np.arctan2(T[1, 0], T[0, 0]) + np.deg2rad(spot.yaw)
    return upright(entry, x, y, yaw, _height_at(spot.support, np.array([x, y]), layout, catalogue, robot))


def _height_at(support: str, place: Floats, layout: Layout, catalogue: Catalogue, robot: Robot) -> float:
    """Height of the upper surface of ``support`` at a place (x, y) of the base frame, metres."""
    if support == "table":
        return robot.table.height
    T = layout[support]
    local = inverse(T) @ [*place, 0, 1]
    return float(T[2, 3] + support_height(catalogue[support], local[0], local[1]))


def _is_good(
    layout: Layout, standing: Iterable[str], together: set[frozenset[str]], catalogue: Catalogue, robot: Robot
) -> bool:
    """Everything but the tray in reach, all of it in view, and what stands on the table apart."""
    reach = all(_reachable(T, robot) for name, T in layout.items() if name != TRAY)
    apart = all(
        frozenset(pair) in together or _gap(*pair, layout, catalogue) >= _APART for pair in combinations(standing, 2)
    )
    return reach and apart and _is_seen(layout, catalogue, robot)


def _is_seen(layout: Layout, catalogue: Catalogue, robot: Robot) -> bool:
    """Everything but the tray in view."""
    return is_seen(robot, [(catalogue[name], T) for name, T in layout.items() if name != TRAY])


def _reachable(T: Floats, robot: Robot, slack: float = 0.0) -> bool:
    x = T[0, 3] - shift(robot)[0]
    return bool(robot.beyond_reach(T) <= slack and _NEAR - slack <= x <= _FAR + slack)


def _gap(a: str, b: str, layout: Layout, catalogue: Catalogue) -> float:
    """Metres between the upright enclosing boxes of two objects; 0 or less where they overlap."""
    outlines = {name: (layout[name], catalogue[name]) for name in (a, b)}
    return min(_distance(*outlines[a], *outlines[b]), _distance(*outlines[b], *outlines[a]))


def _distance(T_base_a: Floats, a: CatalogueObject, T_base_b: Floats, b: CatalogueObject) -> float:
    """Smallest signed distance of the outline of ``a`` from the rectangle of ``b``."""
    sides = np.linspace(-1, 1, 9)
    unit = np.concatenate([np.stack([sides, np.full(9, s)], 1) for s in (-1, 1)])
    outline = np.concatenate([unit, unit[:, ::-1]]) * a.dimensions[:2] / 2 + a.bounds.mean(0)[:2]
    T = inverse(T_base_b) @ T_base_a
    points = outline @ T[:2, :2].T + T[:2, 3]
    outside = np.abs(points - b.bounds.mean(0)[:2]) - b.dimensions[:2] / 2
    return float((np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(1), 0)).min())
