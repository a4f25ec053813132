"""Where an object could be placed so that the goal's relation holds: poses around the demonstrated one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.geometry.regions import Region
from stages.messages.scene import SceneGraph
from stages.planning.symbolic.problem import TABLE, carriers
from stages.planning.symbolic.search import Step
from stages.scene.facing import sides, turned_to
from stages.scene.stance import ALIGNED, Stances, Standing, rotation_between, standing_of, turned, yawed
from stages.scene.virtual import in_region, region_poses

QUARTERS = 4
RING = 24
"""Most places around a symmetric parent."""
TURNED = 0.03
"""Cost of a quarter turn that the demonstration did not show, in metres of shift."""
_ASKEW = 1.0
"""Cost of half of one: where nothing else fits."""
_HANGS = 0.012
"""Metres above what carries it from which on something must be under an object."""
_LEANS = np.deg2rad(3)
"""Tilt from which on an object leans: an estimate is off by less, radians."""
_ANYWHERE = 1.0
"""Metres from where it was shown within which an object may stand that only has to be on the table."""


@dataclass(frozen=True)
class Scene:
    """Objects in the table frame and what carries each: as perceived, or as they will be later in a plan."""

    standing: Mapping[str, Standing]
    supports: Mapping[str, str]
    T_base_table: Floats
    surface: Region | None = None
    """Of the table, in its frame, as far as it was seen; None where that is not known."""
    eye: Floats | None = None
    """Where the camera is, in the table's frame; None where that is not known."""

    @cached_property
    def surface_edges(self) -> tuple[Floats, Floats]:
        """Of a surface that is known: see :func:`stages.geometry.regions.sides`."""
        assert self.surface is not None
        return regions.sides(self.surface)

    @staticmethod
    def of(graph: SceneGraph, stances: Mapping[str, Stances]) -> Scene:
        """A perceived scene. Heights follow from what carries what, exact where the estimate is noisy; what leans stays
        as it is, and what hangs in the air, for it stands on something that was not seen."""
        standing = {item.name: item for item in standing_of(graph.objects, stances, graph.T_base_table)}
        T_table_base = inverse(graph.T_base_table)
        poses = {item.name: T_table_base @ item.T_base_object for item in graph.objects}
        scene = Scene({}, carriers(graph), graph.T_base_table, graph.support, _eye(graph))
        while standing:
            name = next(name for name in standing if scene.supports[name] not in standing)
            item, support = standing.pop(name), scene.supports[name]
            rested = scene.rested(item, support)
            stays = not item.stance.aligned or _hangs(item, rested)
            rested = replace(item if stays else rested, T_table_leaning=_leaning(item, poses[name]))
            scene = scene.after(name, rested, support)
        return scene

    def hangs(self, name: str) -> bool:
        """Whether an object is above what is said to carry it."""
        item = self.standing[name]
        return item.stance.aligned and _hangs(item, self.rested(item, self.supports[name]))

    def rested(self, item: Standing, support: str) -> Standing:
        """The object at the height at which its bottom meets the surface below it."""
        surface = 0.0 if support == TABLE else self.standing[support].rest_height(item.bottom)
        T = item.T_table_stance.copy()
        T[2, 3] = surface - item.stance.low
        return replace(item, T_table_stance=T)

    def after(self, name: str, item: Standing, support: str) -> Scene:
        """The scene once an object stands elsewhere."""
        return replace(self, standing={**self.standing, name: item}, supports={**self.supports, name: support})

    def others(self, name: str, support: str) -> list[Standing]:
        """Everything but the object and what carries it."""
        chain = {name}
        while support in self.supports:
            chain.add(support)
            support = self.supports[support]
        return [item for item in self.standing.values() if item.name not in chain]


def _leaning(item: Standing, T_table_object: Floats) -> Floats | None:
    """Where an object was estimated, if it leans."""
    return T_table_object if turned(item.stance.item, T_table_object, item.T_table_object) > _LEANS else None


def _hangs(item: Standing, rested: Standing) -> bool:
    return item.z_bottom - rested.z_bottom > _HANGS


def _eye(graph: SceneGraph) -> Floats | None:
    return None if graph.T_base_camera is None else (inverse(graph.T_base_table) @ graph.T_base_camera)[:3, 3]


@dataclass(frozen=True)
class Placement:
    """A pose to consider and how far it is from the demonstration, metres."""

    standing: Standing
    cost: float


@dataclass(frozen=True)
class Ranked:
    """N placements of an object, best first. Mostly the first few are enough: each is made when it is asked for."""

    bases: Sequence[Standing]
    """The object as it is turned, anywhere."""
    which: NDArray[np.intp]
    """As which of these it is turned, N."""
    places: Floats
    """Where its origin is in the table frame, metres, N x 2."""
    costs: Floats
    """N, metres."""

    def __iter__(self) -> Iterator[Placement]:
        return (self[number] for number in range(len(self.costs)))

    def __getitem__(self, number: int) -> Placement:
        base = self.bases[self.which[number]]
        T = base.T_table_stance.copy()
        T[:2, 3] = self.places[number]
        return Placement(Standing(base.name, base.stance, T), float(self.costs[number]))

    def only(self, kept: Sequence[bool] | NDArray[np.bool_] | NDArray[np.intp]) -> Ranked:
        """Some of them, or all in another order."""
        return Ranked(self.bases, self.which[kept], self.places[kept], self.costs[kept])

    def sorted(self) -> Ranked:
        """In the order of their costs."""
        return self.only(np.argsort(self.costs, kind="stable"))

    def over(self, surface: Region, margin: float | None) -> Ranked:
        """Those whose bottom lies over a surface, at least ``margin`` from its edge, or (None) the bottom's middle."""
        inward, offset = regions.sides(surface)
        bottoms = [base.bottom - base.T_table_stance[:2, 3] for base in self.bases]
        if margin is None:
            bottoms, margin = [regions.centroid(bottom)[None] for bottom in bottoms], 0.0
        nearest = np.array([(bottom @ inward.T).min(0) for bottom in bottoms])
        return self.only((self.places @ inward.T + nearest[self.which] - offset).min(1) >= margin)


class Placements:
    """Placements of one step, best first."""

    def __init__(self, goal: SceneGraph, stances: Mapping[str, Stances], taught: SceneGraph) -> None:
        """``goal`` may tell regions the other way round than they were ``taught``."""
        self._goal = Scene.of(goal, stances)
        self._taught = {(item.parent, item.child): item for item in taught.virtual_objects}
        self._labels = {item.name: item.label for item in goal.objects}
        self._poses = {item.name: item.T_base_object for item in goal.objects}
        self._anywhere = {item.name for item in goal.objects if item.anywhere}
        self._virtual = {item.name: item for item in goal.virtual_objects}
        self._stances = stances
        self._sides = sides(goal)

    def of(self, step: Step, scene: Scene) -> Ranked:
        """All placements of a step of the goal, in the table frame; their height is still to be found."""
        item = scene.standing[step.item]
        stances = self._stances[self._labels[step.item]]
        nominal = self._nominal(step, scene)
        shown = self._as_shown(step, scene) if step.region else nominal[0][:2, 3]
        nominal.sort(key=lambda T: float(np.linalg.norm(T[:2, 3] - shown)))
        shifts = np.array(list(self._shifts(step, scene)))
        lengths = np.hypot(*shifts.T)
        bases: list[Standing] = []
        places: list[Floats] = []
        costs: list[Floats] = []
        for k, T in enumerate(nominal):
            away = 0.25 * float(np.linalg.norm(T[:2, 3] - nominal[0][:2, 3])) + 1e-4 * k
            for facing, cost in self._orientations(T, item, scene, askew=bool(step.region)):
                some = slice(None if k == 0 and cost < TURNED else 13)
                bases.append(Standing.at(step.item, stances, facing))
                places.append(facing[:2, 3] + shifts[some])
                costs.append(away + cost + lengths[some])
        which = np.repeat(np.arange(len(bases)), [len(some) for some in costs])
        ranked = Ranked(bases, which, np.concatenate(places), np.concatenate(costs)).sorted()
        if not step.region or (step.parent, step.item) in self._taught:
            return ranked
        return ranked.only([self._as_taught(step, one.standing, scene) for one in ranked])

    def _orientations(self, T: Floats, item: Standing, scene: Scene, *, askew: bool) -> list[tuple[Floats, float]]:
        """Ways to turn an object at a demonstrated pose, with their cost: one, where the goal has a side for it; else
        in the end ``askew`` ones, too."""
        if item.name not in self._sides:
            ways = _any_side(T, item)
            between = yawed(np.pi / QUARTERS, np.zeros(3))[:3, :3]
            return ways + [(_turned(way, between), _ASKEW + cost) for way, cost in ways if askew]
        faced = inverse(scene.T_base_table) @ turned_to(self._poses[item.name], self._sides[item.name])
        faced[:3, 3] = T[:3, 3]
        return [(faced, 0.0)]

    def _as_taught(self, step: Step, item: Standing, scene: Scene) -> bool:
        """Whether what the goal has beside this object, told the other way round, is so."""
        taught = self._taught[step.item, step.parent]
        child = scene.standing[step.parent].T_table_object
        return in_region(taught, item.T_table_object, child, item.stance.item.symmetries)

    def settled(self, item: Standing) -> Standing:
        """An object where it is; one that leans, on the side on which it rests that it is nearest to."""
        if item.stance.aligned:
            return item
        alike = item.T_table_object @ item.stance.item.symmetries.transforms()
        ways = ((T, T[:3, :3] @ R[2]) for T in alike for R in item.stance.item.resting)
        T, up = max(ways, key=lambda way: round(float(way[1][2]), 9))
        T[:3, :3] = rotation_between(up, np.array([0.0, 0.0, 1.0])) @ T[:3, :3]
        return Standing.at(item.name, self._stances[item.stance.item.name], T)

    def resting(self, item: Standing) -> Iterator[Standing]:
        """An object where it is, on every side on which it rests, turned by quarters."""
        for R in item.stance.item.resting:
            for k in range(QUARTERS):
                T = yawed(2 * np.pi * k / QUARTERS, item.T_table_stance[:3, 3])
                T[:3, :3] = T[:3, :3] @ R
                yield Standing.at(item.name, self._stances[item.stance.item.name], T)

    def reserved(self, pending: Sequence[Step], scene: Scene) -> list[list[Standing]]:
        """Where the object of each step still to come may stand on the table, as demonstrated first."""
        steps = [step for step in pending if step.destination == TABLE and step.item in self._poses]
        return [
            [Standing.at(step.item, self._stances[self._labels[step.item]], T) for T in self._nominal(step, scene)]
            for step in steps
        ]

    def _nominal(self, step: Step, scene: Scene) -> list[Floats]:
        """Demonstrated poses in the table frame of this scene, modulo the symmetries of what they are relative to."""
        if step.region:
            virtual = self._virtual[step.region]
            parent = scene.standing[virtual.parent]
            poses = region_poses(virtual, parent.T_table_object, parent.stance.item.symmetries)
        elif step.destination == TABLE:
            anywhere = step.item in self._anywhere
            return [self._centred(step, scene) if anywhere else inverse(scene.T_base_table) @ self._poses[step.item]]
        else:
            support = scene.standing[step.destination]
            relative = inverse(self._goal.standing[step.destination].T_table_object) @ self._shown(step.item)
            poses = support.T_table_object @ support.stance.item.symmetries.transforms(np.pi / 8) @ relative
        shown = self._shown(step.item)
        upright = poses[:, 2, :3] @ shown[2, :3] > np.cos(ALIGNED)
        if step.region and not upright.any():
            # What it goes beside lies otherwise than it was shown: the place still means something, its turn does not.
            poses[:, :3, :3], upright[:] = shown[:3, :3], True
        kept = list(poses[upright])
        return kept[:: -(-len(kept) // RING)] if kept else [self._centred(step, scene)]

    def _as_shown(self, step: Step, scene: Scene) -> Floats:
        """Where (x, y) a region was shown to be beside its parent, in the frame of what carries both.

        Of places around a symmetric parent that is the one for which the others left room.
        """
        away = self._shown(step.item)[:3, 3] - self._shown(step.parent)[:3, 3]
        if step.destination != TABLE:
            now, then = (one.standing[step.destination].T_table_object[:3, :3] for one in (scene, self._goal))
            away = now @ then.T @ away
        return (scene.standing[step.parent].T_table_object[:3, 3] + away)[:2]

    def _shown(self, name: str) -> Floats:
        """The pose in the goal scene's table frame."""
        return self._goal.standing[name].T_table_object

    def _centred(self, step: Step, scene: Scene) -> Floats:
        """The middle of the support, where it now stands so that the demonstrated relative pose means nothing; on the
        table above where the object is now."""
        T = self._shown(step.item).copy()
        carrier = scene.standing.get(step.destination)
        T[:2, 3] = regions.centroid(carrier.top) if carrier else scene.standing[step.item].T_table_object[:2, 3]
        return T

    def _shifts(self, step: Step, scene: Scene) -> Iterator[tuple[float, float]]:
        """Horizontal shifts, smallest first: as far as the relation allows, in steps of a centimetre at first."""
        if step.region:
            reach, pitch = 0.6 * self._virtual[step.region].radius, 0.008
        elif step.destination == TABLE:
            reach, pitch = _ANYWHERE, 0.01
        else:
            size = np.ptp(scene.standing[step.destination].outline, axis=0)
            reach, pitch = 0.5 * float(size.max()), 0.01
        yield from spiral(pitch, min(reach, 0.04))
        yield from (shift for shift in spiral(0.03, reach) if np.hypot(*shift) > 0.04)


def spiral(pitch: float, reach: float) -> list[tuple[float, float]]:
    """Points of a square grid within a disc, from its centre outwards; the first 13 lie within two steps."""
    count = int(reach / pitch + 1e-9)
    steps = range(-count, count + 1)
    points = [(pitch * i, pitch * j) for i in steps for j in steps if pitch * np.hypot(i, j) <= reach + 1e-9]
    return sorted(points, key=lambda point: (round(float(np.hypot(*point)), 9), point))


def _any_side(T: Floats, item: Standing) -> list[tuple[Floats, float]]:
    """Ways to turn an object at a demonstrated pose, with their cost.

    First those that look the same and keep the side up that is up now, so that nobody has to turn it over; where
    there is none it has to be laid down or put upright.
    """
    up = item.T_table_object[2, :3]
    alike = T @ item.stance.item.symmetries.lookalikes(2 * np.pi / QUARTERS)
    kept = [turned for turned in alike if turned[2, :3] @ up > np.cos(ALIGNED)]
    found = [(turned, 0.002 * k) for k, turned in enumerate(kept or [T])]
    quarters = (yawed(2 * np.pi * k / QUARTERS, np.zeros(3))[:3, :3] for k in range(1, QUARTERS))
    return found + [(_turned(found[0][0], R), TURNED + 0.002 * k) for k, R in enumerate(quarters)]


def _turned(T: Floats, R: Floats) -> Floats:
    result = T.copy()
    result[:3, :3] = R @ T[:3, :3]
    return result
