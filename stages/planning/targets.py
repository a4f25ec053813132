"""Which poses would do for each transfer: supported, free of others, within reach, with room for the gripper."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from runner.contract import Refused
from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.planning.placements import Placement, Placements, Scene
from stages.planning.problem import TABLE
from stages.planning.search import Step
from stages.planning.sight import hidden_share
from stages.robots import Gripper, Robot
from stages.scene.catalogue import Grasp
from stages.scene.stance import Standing

TOUCHING = 0.002
"""Objects whose heights overlap by less than this are above each other, metres."""
MIDDLE = 0.01
"""Metres from the edge of a surface, half of the way on small ones, where the middle of what overhangs it must stay."""
HIDDEN = 0.1
"""Cost of a place that other objects hide wholly from the camera, in metres of shift: nobody has seen it free, and
nobody will see what stands there."""
CROWDED = 0.08
"""Gap in metres below which an object stands in the way of the hand that picks its neighbour."""

ALIKE = (0.015, 1 + 2 * float(np.cos(np.deg2rad(30))))
"""Shift in metres, and trace of the rotation between them, within which two poses are as good as one."""

ANYWHERE = (-10.0, 10.0)
"""Metres: no limit beside the robot's own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """Where to place, in the base frame, and how much room objects need; metres."""

    x: tuple[float, float] = ANYWHERE
    y: tuple[float, float] = ANYWHERE
    """Narrower than the area in which the robot places, where they are."""
    clearance: float = 0.005
    """Least gap between footprints."""
    edge: float = 0.02
    """Least distance of a footprint from the edge of the table, as far as that was seen."""
    spacing: float = 0.06
    """Gap that objects put aside should keep."""
    targets: int = 12
    """Poses offered for each transfer."""
    considered: int = 500
    """Poses considered for each transfer."""

    def __post_init__(self) -> None:
        """Refuses empty areas and limits."""
        for name in ("x", "y"):
            low, high = getattr(self, name)
            if not low < high:
                raise Refused(f"planner.workspace.{name}={[low, high]}: must be [lowest, highest] in metres")
        for name in ("targets", "considered"):
            if getattr(self, name) < 1:
                raise Refused(f"planner.workspace.{name}={getattr(self, name)}: must be 1 or more")

    def of(self, robot: Robot) -> Workspace:
        """The part of it in which the robot places."""
        (x0, x1), (y0, y1) = robot.x, robot.y
        x, y = (max(x0, self.x[0]), min(x1, self.x[1])), (max(y0, self.y[0]), min(y1, self.y[1]))
        return replace(self, x=x, y=y)

    def outside(self, T_base_object: Floats) -> float:
        """How far a pose lies outside the area, metres; 0 inside."""
        (x0, x1), (y0, y1) = self.x, self.y
        x, y = T_base_object[:2, 3]
        return float(np.hypot(max(x0 - x, x - x1, 0.0), max(y0 - y, y - y1, 0.0)))


@dataclass(frozen=True)
class Blocked:
    """A step for which there is no pose, and the objects that take up the room (none: there is no room at all)."""

    step: Step
    obstacles: tuple[str, ...]


@dataclass(frozen=True)
class Crowded:
    """A step whose object would stand in the way of a later pick: it is better placed after that."""

    step: Step


class Targets:
    """Chooses poses for the steps of a plan, each in the scene that the steps before it leave behind."""

    def __init__(self, placements: Placements, workspace: Workspace, robot: Robot) -> None:
        self._placements = placements
        self._workspace, self._gripper = workspace.of(robot), robot.gripper

    def of(
        self,
        steps: Sequence[Step],
        scene: Scene,
        goal: dict[str, str],
        *,
        again: Iterable[Step] = (),
        late: Collection[str] = (),
    ) -> list[Floats] | Blocked | Crowded:
        """T_base_targets of every step, best first, N x 4 x 4 each; or the first step that should not come now.

        ``goal`` maps the objects of the goal to what carries them. Steps ``again`` failed before with the best poses
        and get those that come next. Items that are ``late`` already may crowd others.
        """
        chosen: list[Floats] = []
        repeated = set(again)
        for k, step in enumerate(steps):
            final = step.destination == goal.get(step.item) and not any(s.item == step.item for s in steps[k + 1 :])
            tried = self._goal_poses(step, scene) if final else self._free_spots(step, steps[k + 1 :], scene)
            if isinstance(tried, Blocked):
                return tried
            best = self._with_room(tried, step, scene)
            best = best[self._workspace.targets :] or best if step in repeated else best
            best = best[: self._workspace.targets]
            pending = {after.item for after in steps[k + 1 :]} - {step.item}
            if step.item not in late and any(_clearance(best[0], scene.standing[name]) < CROWDED for name in pending):
                return Crowded(step)
            chosen.append(np.stack([scene.T_base_table @ item.T_table_object for item in best]))
            scene = scene.after(step.item, best[0], step.destination)
        return chosen

    def _goal_poses(self, step: Step, scene: Scene) -> list[Placement] | Blocked:
        """Where the object stands wholly on what carries it, with a margin or at least without; else by its middle."""
        placements = self._placements.of(step, scene)
        placements = self._seen_first(placements, step, scene) if step.region else placements
        for margin in () if step.destination == TABLE else (self._workspace.clearance, 0.0):
            found = self._free(step, scene, placements, margin=margin)
            if isinstance(found, list):
                return found
        return self._free(step, scene, placements, margin=None)

    def _seen_first(self, placements: Sequence[Placement], step: Step, scene: Scene) -> list[Placement]:
        """Sorted again: of the places that look alike around a symmetric parent those come later that are hidden."""
        others = scene.others(step.item, step.destination)
        hidden: dict[tuple[float, ...], float] = {}
        sorted_again: list[Placement] = []
        for one in placements:
            place = tuple(np.round(one.standing.T_table_stance[:2, 3] / ALIKE[0]))
            if place not in hidden:
                hidden[place] = _hidden(one.standing, others, scene)
            sorted_again.append(Placement(one.standing, one.cost + hidden[place]))
        return sorted(sorted_again, key=lambda placement: placement.cost)

    def _free(
        self, step: Step, scene: Scene, placements: Sequence[Placement], *, margin: float | None
    ) -> list[Placement] | Blocked:
        """The first placements that are supported, touch nothing and differ enough to be worth a try each."""
        others = scene.others(step.item, step.destination)
        valid: list[Placement] = []
        blocking: list[tuple[str, ...]] = []
        supported = (p for p in placements if self._supported(p.standing, step.destination, scene, margin))
        for placement in islice(supported, self._workspace.considered):
            if any(_alike(placement.standing, other.standing) for other in valid):
                continue
            item = scene.rested(placement.standing, step.destination)
            hit = tuple(other.name for other in others if _clearance(item, other) < self._workspace.clearance)
            if hit:
                blocking.append(hit)
                continue
            outside = self._workspace.outside(scene.T_base_table @ item.T_table_object)
            valid.append(Placement(item, placement.cost + 0.5 * outside))
            if len(valid) == 2 * self._workspace.targets:
                break
        return valid or Blocked(step, min(blocking, key=lambda hit: _effort(hit, scene), default=()))

    def _supported(self, item: Standing, destination: str, scene: Scene, margin: float | None) -> bool:
        """Whether the surface carries the object: all of it, ``margin`` from the edge, or (None) its middle.

        The table always carries all of it, within reach of the arm.
        """
        if destination == TABLE:
            within_reach = self._workspace.outside(scene.T_base_table @ item.T_table_object) == 0
            return within_reach and self._on_table(item, scene)
        carrier = scene.standing[destination]
        surface = carrier.floor if carrier.stance.cavity else carrier.top
        if margin is not None:
            return regions.inside(item.bottom, surface, margin=margin)
        middles = np.stack([regions.centroid(item.bottom), regions.centroid(surface)])
        depth, deepest = regions.depth(surface, middles)
        return bool(depth >= min(MIDDLE, 0.5 * deepest))

    def _on_table(self, item: Standing, scene: Scene) -> bool:
        """Whether all of an object, seen from above, lies over the table and away from its edge."""
        surface = scene.surface
        return surface is None or regions.inside(item.outline, surface, margin=self._workspace.edge)

    def _free_spots(self, step: Step, pending: Sequence[Step], scene: Scene) -> list[Placement] | Blocked:
        """Places on the table, near and with space around them, where nothing of the goal will stand."""
        item = scene.standing[step.item]
        others = scene.others(step.item, TABLE)
        reserved = [
            next((place for place in places if self._supported(place, TABLE, scene, None)), places[0])
            for places in self._placements.reserved(pending, scene)
        ]
        spots: list[Placement] = []
        for spot in self._grid(item, scene):
            if not self._on_table(spot, scene):
                continue
            room = min((_clearance(spot, other) for other in others), default=np.inf)
            free = min((regions.separation(spot.outline, other.outline) for other in reserved), default=np.inf)
            if room < self._workspace.clearance:
                continue
            distance = float(np.linalg.norm(spot.T_table_stance[:2, 3] - item.T_table_stance[:2, 3]))
            crowded = max(0.0, self._workspace.spacing - min(room, free))
            spots.append(Placement(spot, 0.2 * distance + 2 * crowded + _hidden(spot, others, scene)))
        spots.sort(key=lambda placement: placement.cost)
        return spots[: 2 * self._workspace.targets] or Blocked(step, ())

    def _grid(self, item: Standing, scene: Scene) -> list[Standing]:
        """The object as it is, on the table, at every 3 cm of the robot's area."""
        (x0, x1), (y0, y1) = self._workspace.x, self._workspace.y
        T_table_base = inverse(scene.T_base_table)
        spots: list[Standing] = []
        for x in np.arange(x0, x1, 0.03):
            for y in np.arange(y0, y1, 0.03):
                T = item.T_table_stance.copy()
                T[:2, 3] = (T_table_base @ [x, y, scene.T_base_table[2, 3], 1.0])[:2]
                spots.append(scene.rested(Standing(item.name, item.stance, T), TABLE))
        return spots

    def _with_room(self, placements: Sequence[Placement], step: Step, scene: Scene) -> list[Standing]:
        """Sorted again: a pose at which few grasps have room for the gripper comes later."""
        others = scene.others(step.item, step.destination)
        costs = [p.cost + 0.05 * (1 - _share_of_grasps(p.standing, others, self._gripper)) for p in placements]
        return [placements[k].standing for k in np.argsort(costs, kind="stable")]


def neighbours(name: str, scene: Scene) -> list[str]:
    """The objects that stand in the way of a hand that picks one, nearest first."""
    item = scene.standing[name]
    gaps = {other.name: _clearance(item, other) for other in scene.others(name, scene.supports[name])}
    return sorted((other for other in gaps if gaps[other] < CROWDED), key=lambda other: gaps[other])


def _alike(a: Standing, b: Standing) -> bool:
    """Whether two poses of an object differ so little that the arm reaches both or none."""
    turn = a.T_table_object[:3, :3].ravel() @ b.T_table_object[:3, :3].ravel()
    return bool(np.linalg.norm((a.T_table_stance - b.T_table_stance)[:2, 3]) < ALIKE[0] and turn > ALIKE[1])


def _effort(obstacles: tuple[str, ...], scene: Scene) -> tuple[int, int]:
    """How hard it is to clear a place: obstacles that nobody can move, then obstacles."""
    fixed = sum(not scene.standing[name].stance.item.grasps for name in obstacles)
    return fixed, len(obstacles)


def _clearance(a: Standing, b: Standing) -> float:
    """Gap between footprints, metres, negative where they overlap; infinite where one is above the other."""
    apart = a.z_bottom > b.z_top - TOUCHING or b.z_bottom > a.z_top - TOUCHING
    return np.inf if apart else regions.separation(a.outline, b.outline)


def _hidden(item: Standing, others: Sequence[Standing], scene: Scene) -> float:
    """What it costs that the camera does not see an object at a place, metres."""
    return 0.0 if scene.eye is None else HIDDEN * hidden_share(item, others, scene.eye)


def _share_of_grasps(item: Standing, others: Sequence[Standing], gripper: Gripper) -> float:
    """Share of the object's grasps at which the open gripper touches nothing else."""
    grasps = item.stance.item.grasps
    room = gripper.length + gripper.finger
    near = [other for other in others if regions.separation(item.outline, other.outline) < room]
    return sum(_hand_fits(grasp, item, near, gripper) for grasp in grasps) / max(1, len(grasps))


def _hand_fits(grasp: Grasp, item: Standing, others: Sequence[Standing], gripper: Gripper) -> bool:
    half, length, thickness = grasp.width / 2 + gripper.finger, gripper.length, gripper.thickness
    corners = [[x, y, z, 1.0] for x in (-length, 0.0) for y in (-half, half) for z in (-thickness / 2, thickness / 2)]
    points = np.array(corners) @ (item.T_table_object @ grasp.T_object_grasp).T
    outline = regions.hull(points[:, :2])
    low, high = points[:, 2].min(), points[:, 2].max()
    level = [other for other in others if other.z_bottom < high and other.z_top > low]
    return all(regions.separation(outline, other.outline) > 0 for other in level)
