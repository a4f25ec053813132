"""Which poses would do for each transfer: supported, free of others, within reach, with room for the gripper."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count, islice, takewhile
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from runner.contract import Refused
from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.planning.places.placements import Placement, Placements, Ranked, Scene
from stages.planning.places.sight import hidden_share
from stages.planning.symbolic.problem import TABLE
from stages.planning.symbolic.search import Step
from stages.robots import Robot
from stages.scene.stance import Standing

if TYPE_CHECKING:  # Motion planning takes half a second to load.
    from stages.planning.handling import Handled, Handling

TOUCHING = 0.002
"""Objects whose heights overlap by less than this are above each other, metres."""
MIDDLE = 0.01
"""Metres from the edge of a surface, half of the way on small ones, where the middle of what overhangs it must stay."""
SLOPE = 0.004
"""Metres by which the side of a bottom that lies on the wall of a hollow may be higher than its floor."""
HIDDEN = 0.1
"""Cost of a place that other objects hide wholly from the camera, in metres of shift: nobody has seen it free, and
nobody will see what stands there."""
SIGHT = 0.04
"""Metres within which one look at how hidden a place is does for all places."""
CROWDED = 0.08
"""Gap in metres below which an object stands in the way of the hand that picks its neighbour."""
FAR = 0.1
"""Metres beyond which it does not matter how large a gap is exactly."""
FARTHER = 0.07
"""Metres beyond the robot's reach within which something may be placed if the hand gets there."""
FEWEST = 4
"""Poses offered for a transfer of which only late ones are within reach."""
BRANCHES, TRIES = 4, 80
"""Places of one step from which is gone on, and how many in all before each step has but one."""

TOLD = 10
"""Steps that are looked at before it is said again how far the plan is."""
FOLLOWED = 6
"""Places of what something goes beside for which is asked whether that can follow."""

BEYOND = 1.0
"""Cost of a place outside the area in which the robot places: the hand may get there, as it does not everywhere."""
ALIKE = (0.015, 1 + 2 * float(np.cos(np.deg2rad(30))))
"""Shift in metres, and trace of the rotation between them, within which two poses are as good as one: the arm reaches
both or none."""
SPREAD = 0.5
"""The same for what may be anywhere on the table, as a share of how far it is from where it was shown: so that a few
places reach far."""

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
    spacing: float = CROWDED
    """Gap that objects put aside should keep."""
    targets: int = 12
    """Poses offered for each transfer."""
    considered: int = 2000
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
    why: str = ""
    """What the hand fails at where there is room for the object."""
    crowding: frozenset[str] = frozenset()
    """Objects that take up other places of the step, or of steps before it whose other places did not help it."""
    otherwise: tuple[str, ...] = ()
    """Objects in the hand's way, as few, where those in ``obstacles`` are not."""

    @property
    def involved(self) -> frozenset[str]:
        """Whatever might let the step succeed if it stood elsewhere."""
        return self.crowding.union({self.step.item, self.step.destination, self.step.parent}, self.obstacles)


@dataclass(frozen=True)
class Crowded:
    """A step whose object would stand in the way of a later pick: it is better placed after that."""

    step: Step


@dataclass(frozen=True)
class Next:
    """A step that can be done."""

    T_base_targets: Floats
    """N x 4 x 4, best first."""
    scene: Scene
    """As it is after the step, at the first of the targets."""


Found = tuple[list[Placement], Sequence[tuple[str, ...]]]
"""Places that are free, best first, and the objects that take up each of the others."""


@dataclass(frozen=True)
class Options:
    """Places for a step's object, best first, and those among them that the hand reaches."""

    places: list[Standing]
    handled: Handled
    blocked: Blocked
    """What the step would be without these places."""


class Targets:
    """Chooses poses for the steps of a plan, each in the scene that the steps before it leave behind.

    Depth first: a place counts only if the hand can take the object there, and where a later step finds no place
    because of an object that was placed before, that object's place is tried that differs most from those before.
    """

    def __init__(
        self,
        placements: Placements,
        workspace: Workspace,
        robot: Robot,
        handling: Handling,
        goal: dict[str, str],
        *,
        turned: Collection[str] = (),
        log: Callable[[str], None] = lambda text: None,
    ) -> None:
        """``goal`` maps the objects of the goal to what carries them; those ``turned`` must be put on another side.

        ``log`` is told now and then how far it is.
        """
        self._placements, self._workspace, self._handling, self._goal = placements, workspace, handling, goal
        self._turned = turned
        self._robot, self._area = robot, workspace.of(robot)
        self._known: dict[Hashable, Options | Blocked] = {}
        self._tries = TRIES
        self._log, self._told = log, count(1)
        self._what, self._steps = "", 0
        """Which plan it is, and its length."""

    def of(
        self,
        steps: Sequence[Step],
        scene: Scene,
        *,
        again: Collection[Step] = (),
        late: Collection[str] = (),
        what: str = "a plan",
    ) -> list[Floats] | Blocked | Crowded:
        """T_base_targets of every step, best first, N x 4 x 4 each; or the step that cannot come now.

        Steps ``again`` failed before with the best poses and get those that come next. Items that are ``late``
        already may crowd others. ``what`` is said of how far it is.
        """
        self._what, self._steps = what, len(steps)
        scene = self._on_its_table(scene)
        found = self._chosen(steps, scene, again, late)
        return found if isinstance(found, Blocked | Crowded) else [self._targets(places, scene) for places in found]

    def next(
        self,
        step: Step,
        rest: Sequence[Step],
        scene: Scene,
        *,
        again: bool,
        late: bool,
        awaits: Step | None = None,
    ) -> Next | Blocked | Crowded:
        """One step's targets and the scene after it, whatever becomes of the ``rest``; ``awaits`` is the step to which
        its object makes way."""
        self._tell(f"one transfer after the other: {len({one.item for one in (step, *rest)})} objects to move", step)
        scene = self._on_its_table(scene)
        options = self._options(step, rest, scene, again)
        if isinstance(options, Blocked):
            return options
        number = next(self._tried(step, options, rest, scene, awaits=awaits), None)
        if number is None:
            return _trouble(step, options, None)
        chosen = options.places[number]
        if not late and self._crowds(chosen, rest, scene):
            return Crowded(step)
        targets = self._targets(_alike_from(number, options.places[: number + self._workspace.targets]), scene)
        return Next(targets, scene.after(step.item, chosen, step.destination))

    @property
    def looked(self) -> int:
        """How often places were looked for, each time for another step or in another scene."""
        return len(self._known)

    def _on_its_table(self, scene: Scene) -> Scene:
        """A scene whose table was not seen has the one that the robot is said to stand at."""
        if scene.surface is not None:
            return scene
        middle, half = np.array(self._robot.table.center), np.array(self._robot.table.size) / 2
        declared = regions.rectangle((middle - half).tolist(), (middle + half).tolist())
        return replace(scene, surface=regions.moved(declared, inverse(scene.T_base_table)))

    def _tell(self, how_far: str, step: Step) -> None:
        """Now and then, by what was looked at and not by the clock: a plan that is made again says the same."""
        if next(self._told) % TOLD == 0:
            self._log(f"{how_far}; looks for a place for {step.item}")

    def _targets(self, places: Sequence[Standing], scene: Scene) -> Floats:
        return np.stack([scene.T_base_table @ item.T_table_object for item in places])

    def _chosen(
        self, steps: Sequence[Step], scene: Scene, again: Collection[Step], late: Collection[str]
    ) -> list[list[Standing]] | Blocked | Crowded:
        """Places of every step, best first: one that leads on, and others that leave room for what comes after it."""
        if not steps:
            return []
        step, *rest = steps
        self._tell(f"{self._what}: {self._steps - len(steps)} of {self._steps} transfers placed", step)
        options = self._options(step, rest, scene, step in again)
        if isinstance(options, Blocked):
            return options
        places, is_late = options.places, step.item in late
        failed: Blocked | None = None
        stays = step.item not in self._turned and all(later.item != step.item for later in rest)
        tried = self._tried(step, options, rest, scene, clear=is_late and stays)
        for number in islice(tried, BRANCHES if self._tries > 0 else 1):
            self._tries -= 1
            if not is_late and self._crowds(places[number], rest, scene):
                return Crowded(step)
            onward = self._chosen(rest, scene.after(step.item, places[number], step.destination), again, late)
            if isinstance(onward, list):
                offered = _alike_from(number, places[: max(self._workspace.targets, number + FEWEST)])
                return [self._harmless(offered, step, rest, scene, [one[0] for one in onward]), *onward]
            if isinstance(onward, Crowded) or step.item not in onward.involved:
                return onward
            failed = replace(failed, crowding=failed.crowding | onward.involved) if failed else onward
        return _trouble(step, options, failed)

    def _harmless(
        self, places: Sequence[Standing], step: Step, rest: Sequence[Step], scene: Scene, later: Sequence[Standing]
    ) -> list[Standing]:
        """The first place, and those others from which the plan goes on as well.

        They are in the way of nothing that comes while the object is there, and leave room for what goes on, in or
        beside it.
        """
        first, *others = places
        meanwhile = len(list(takewhile(lambda other: other.item != step.item, rest)))
        crowds = self._crowds(first, rest, scene)
        children = [other for other in rest[:meanwhile] if step.item in (other.parent, other.destination)]

        def leads_on(place: Standing) -> bool:
            if any(_is_near(place, item, self._workspace.clearance) for item in later[:meanwhile]):
                return False
            after = scene.after(step.item, place, step.destination)
            room = all(self._goal_poses(child, after, enough=1)[0] for child in children)
            return room and (crowds or not self._crowds(place, rest, scene))

        return [first, *filter(leads_on, others)]

    def _options(self, step: Step, rest: Sequence[Step], scene: Scene, again: bool) -> Options | Blocked:
        """What the same step in the same scene had before, or what is found now."""
        final = step.destination == self._goal.get(step.item) and all(later.item != step.item for later in rest)
        pending = () if final else tuple(rest)
        poses = tuple((item.name, item.T_table_stance.tobytes()) for item in scene.standing.values())
        key = (step, pending, frozenset(poses), again)
        if key not in self._known:
            enough = 2 * self._workspace.targets
            found, taken = self._goal_poses(step, scene, enough) if final else self._free_spots(step, rest, scene)
            obstacles = min(taken, key=lambda names: _effort(names, scene), default=())
            blocked = Blocked(step, obstacles, crowding=frozenset().union(*taken))
            places = [placement.standing for placement in sorted(found, key=lambda placement: placement.cost)]
            places = (places[self._workspace.targets :] or places[len(places) // 2 :]) if again else places
            handled = self._handling.of(step, scene, places) if places else None
            self._known[key] = Options(places, handled, blocked) if handled else blocked
        return self._known[key]

    def _tried(
        self,
        step: Step,
        options: Options,
        rest: Sequence[Step],
        scene: Scene,
        *,
        clear: bool = False,
        awaits: Step | None = None,
    ) -> Iterator[int]:
        """Numbers of places that the hand reaches, first those where what goes beside the object follows, from which an
        object that must be turned can be taken to where it belongs, where the hand then takes what ``awaits`` this step
        and, if it is to be ``clear``, that leave the hand room for what is still to be picked."""
        children = [other for other in rest if other.parent == step.item]
        children += [other for other in rest if other.item == step.item and step.item in self._turned]
        hindered: list[int] = []
        for number in islice(options.handled.places(), FOLLOWED if children or awaits else None):
            place = options.places[number]
            after = scene.after(step.item, place, step.destination)
            crowds = clear and self._crowds(place, rest, scene)
            follows = not crowds and all(self._follows(child, step.item, after) for child in children)
            if follows and (awaits is None or self._takes(awaits, after)):
                yield number
            else:
                hindered.append(number)
        yield from hindered

    def _takes(self, step: Step, scene: Scene) -> bool:
        """Whether the hand takes a step's object as things stand."""
        options = self._options(step, (), scene, again=False)
        if isinstance(options, Blocked):
            return False
        next(options.handled.places(), None)
        return options.handled.is_picked

    def _follows(self, child: Step, parent: str, scene: Scene) -> bool:
        """Whether a step can be done once its parent is where it is, at least after others have moved; the next step of
        the same object at once."""
        options = self._options(child, (), scene, again=False)
        if isinstance(options, Options):
            if next(options.handled.places(), None) is not None:
                return True
            obstacles = next(iter(options.handled.why_not()[1]), ())
        else:
            obstacles = options.obstacles
        own = child.item == parent or parent in obstacles
        return bool(obstacles) and not own and _effort(obstacles, scene)[0] == 0

    def _crowds(self, item: Standing, rest: Sequence[Step], scene: Scene) -> bool:
        pending = {after.item for after in rest} - {item.name}
        return any(_is_near(item, scene.standing[name], CROWDED) for name in pending)

    def _goal_poses(self, step: Step, scene: Scene, enough: int) -> Found:
        """Where the object stands wholly on what carries it, with a margin or at least without; else by its middle.

        As many places as are ``enough``, or all that there are.
        """
        placements = self._placements.of(step, scene)
        if step.region:
            placements = self._seen_first(placements, scene.others(step.item, step.destination), scene)
        margins = (None,) if step.destination == TABLE else (self._workspace.clearance, 0.0, None)
        if step.destination != TABLE and scene.standing[step.destination].fits(scene.standing[step.item].bottom):
            margins = margins[:2]
        found: Found = [], ()
        for margin in margins:
            found = self._free(step, scene, placements, margin=margin, enough=enough)
            if found[0]:
                break
        return found

    def _seen_first(self, placements: Ranked, others: Sequence[Standing], scene: Scene) -> Ranked:
        """Placements sorted again: of places around a symmetric parent that look alike the hidden ones come later."""
        cells = np.round(placements.places / SIGHT) + 0.0  # -0 is 0
        _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        hidden = np.array([_hidden(placements[number].standing, others, scene) for number in first])
        return replace(placements, costs=placements.costs + hidden[cell.ravel()]).sorted()

    def _free(self, step: Step, scene: Scene, placements: Ranked, *, margin: float | None, enough: int) -> Found:
        """The first placements that are supported, touch nothing and differ enough to be worth a try each."""
        others = scene.others(step.item, step.destination)
        if step.destination != TABLE:
            placements = placements.over(_surface(scene.standing[step.destination]), margin)
        valid: list[Placement] = []
        beyond: list[Placement] = []
        blocking: list[tuple[str, ...]] = []
        anywhere, considered = step.destination == TABLE and not step.region, 0
        for placement in placements:
            apart = max(ALIKE[0], SPREAD * placement.cost) if anywhere else ALIKE[0]
            if any(_alike(placement.standing, other.standing, apart) for other in (*valid, *beyond)):
                continue
            if not self._supported(placement.standing, step.destination, scene, margin):
                continue
            considered += 1
            if considered > self._workspace.considered:
                break
            item = scene.rested(placement.standing, step.destination)
            hit = tuple(other.name for other in others if _is_near(item, other, self._workspace.clearance))
            if hit:
                blocking.append(hit)
                continue
            outside = self._area.outside(scene.T_base_table @ item.T_table_object)
            if outside > 0:
                beyond.append(Placement(item, placement.cost + BEYOND + outside))
                continue
            valid.append(Placement(item, placement.cost))
            if len(valid) == enough:
                break
        return valid + beyond[: self._workspace.targets], blocking

    def _supported(self, item: Standing, destination: str, scene: Scene, margin: float | None) -> bool:
        """Whether the surface that is below the object carries it: all of it, or (``margin`` None) its middle. What
        would lie on a rim lies there on both sides: on one it would tip into the hollow, as on the slope of its wall.

        The table always carries all of it, not far beyond where the arm is known to reach.
        """
        if destination == TABLE:
            T_base_object = scene.T_base_table @ item.T_table_object
            within_reach = (
                self._workspace.outside(T_base_object) == 0 and self._robot.beyond_reach(T_base_object) < FARTHER
            )
            return within_reach and self._on_table(item, scene)
        carrier = scene.standing[destination]
        if margin is not None:
            held = _is_level(carrier, item.bottom)
        else:
            held = _bears(carrier, regions.centroid(item.bottom)) and (
                carrier.lies_on_rim(item.bottom) or not carrier.lies_on_rim(carrier.centred(item.bottom))
            )
        return held and _is_balanced(item, destination, scene)

    def _on_table(self, item: Standing, scene: Scene) -> bool:
        """Whether all of an object, seen from above, lies over the table and away from its edge."""
        assert scene.surface is not None
        inward, offset = scene.surface_edges
        # The circle around the outline mostly tells, much faster.
        if float((inward @ item.T_table_stance[:2, 3] - offset).min()) > self._workspace.edge + item.stance.radius:
            return True
        return regions.inside(item.outline, scene.surface, margin=self._workspace.edge)

    def _free_spots(self, step: Step, pending: Sequence[Step], scene: Scene) -> Found:
        """Places on the table, near, well within reach, with space around, where nothing of the goal will stand; what
        leans rests on one of its sides there."""
        leans = not scene.standing[step.item].stance.aligned
        item = self._placements.settled(scene.standing[step.item])
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
            free = min((spot.separation(other) for other in reserved), default=np.inf)
            if room < self._workspace.clearance:
                continue
            distance = float(np.linalg.norm(spot.T_table_stance[:2, 3] - item.T_table_stance[:2, 3]))
            crowded = max(0.0, self._workspace.spacing - min(room, free))
            far = self._robot.beyond_reach(scene.T_base_table @ spot.T_table_object)
            spots.append(Placement(spot, 0.2 * distance + 2 * (crowded + far) + _hidden(spot, others, scene)))
        spots = sorted(spots, key=lambda placement: placement.cost)[: 2 * self._workspace.targets]
        if leans or step.item in self._turned:
            spots += self._on_other_sides(item, spots, others, scene)
        return spots, ()

    def _on_other_sides(
        self, item: Standing, spots: Sequence[Placement], others: Sequence[Standing], scene: Scene
    ) -> Iterator[Placement]:
        """The object on each side on which it rests, at the first of the spots that has room for it: the hand that
        cannot turn it at once takes it anew from there."""
        for resting in self._placements.resting(item):
            for spot in spots:
                T = resting.T_table_stance.copy()
                T[:2, 3] = spot.standing.T_table_stance[:2, 3]
                place = scene.rested(replace(resting, T_table_stance=T), TABLE)
                room = min((_clearance(place, other) for other in others), default=np.inf)
                if room >= self._workspace.clearance and self._on_table(place, scene):
                    yield Placement(place, spot.cost)
                    break

    def _grid(self, item: Standing, scene: Scene) -> list[Standing]:
        """The object as it is, on the table, at every 3 cm of the robot's area."""
        (x0, x1), (y0, y1) = self._area.x, self._area.y
        T_table_base = inverse(scene.T_base_table)
        spots: list[Standing] = []
        for x in np.arange(x0, x1, 0.03):
            for y in np.arange(y0, y1, 0.03):
                T = item.T_table_stance.copy()
                T[:2, 3] = (T_table_base @ [x, y, scene.T_base_table[2, 3], 1.0])[:2]
                spots.append(scene.rested(Standing(item.name, item.stance, T), TABLE))
        return spots


def _surface(carrier: Standing) -> regions.Region:
    """On which others stand."""
    return carrier.floor if carrier.stance.cavity else carrier.top


def _is_level(carrier: Standing, bottom: regions.Region) -> bool:
    """Whether a bottom lies on the floor of a hollow, if there is one, and not partly on the slope of its wall."""
    height = carrier.rest_height(bottom)
    return height - carrier.z_floor < SLOPE or height - carrier.rest_height(carrier.centred(bottom)) < SLOPE


def _bears(carrier: Standing, middle: Floats) -> bool:
    """Whether what weighs on an object at a place, x and y, does so far enough from the edge of its surface."""
    surface = _surface(carrier)
    depth, deepest = regions.depth(surface, np.stack([middle, regions.centroid(surface)]))
    return bool(depth >= min(MIDDLE, 0.5 * deepest))


def _is_balanced(item: Standing, destination: str, scene: Scene) -> bool:
    """Whether a pile stands with one more object on it: each of those below bears the weight of all above it."""
    above, below = [item], destination
    while (support := scene.supports[below]) != TABLE:
        above.append(scene.standing[below])
        weights, middles = zip(*((one.stance.item.mass, regions.centroid(one.bottom)) for one in above), strict=True)
        if not _bears(scene.standing[support], np.average(middles, axis=0, weights=weights)):
            return False
        below = support
    return True


def _trouble(step: Step, options: Options, failed: Blocked | None) -> Blocked:
    """Why a step leads nowhere: none of its places is reached, or what the first one led to ``failed``.

    Where that is without any room, the step itself is blocked by what takes up other places of it.
    """
    blocked = options.blocked
    if failed is None:
        why, ways = options.handled.why_not()
        obstacles, *others = ways or [()]
        otherwise = tuple(dict.fromkeys(chain.from_iterable(others)))
        if not options.handled.is_picked:
            return Blocked(step, obstacles, why, otherwise=otherwise)
        return replace(blocked, obstacles=obstacles or blocked.obstacles, why=why, otherwise=otherwise)
    if not failed.obstacles and blocked.obstacles:
        return blocked
    return replace(failed, crowding=failed.crowding | blocked.crowding)


def _alike_from(number: int, places: Sequence[Standing]) -> list[Standing]:
    """One of the places, and those after it where the object stands on the same side."""
    return [place for place in places[number:] if place.stance is places[number].stance]


def neighbours(name: str, scene: Scene) -> list[str]:
    """The objects that stand in the way of a hand that picks one, nearest first."""
    item = scene.standing[name]
    gaps = {other.name: _clearance(item, other) for other in scene.others(name, scene.supports[name])}
    return sorted((other for other in gaps if gaps[other] < CROWDED), key=lambda other: gaps[other])


def _alike(a: Standing, b: Standing, metres: float) -> bool:
    """Whether two poses of an object differ so little that one of them is enough."""
    if _distance(a, b) >= metres:
        return False
    return bool(a.T_table_object[:3, :3].ravel() @ b.T_table_object[:3, :3].ravel() > ALIKE[1])


def _effort(obstacles: tuple[str, ...], scene: Scene) -> tuple[int, int]:
    """How hard it is to clear a place: obstacles that nobody can move, then obstacles."""
    fixed = sum(not scene.standing[name].stance.item.grasps for name in obstacles)
    return fixed, len(obstacles)


def _clearance(a: Standing, b: Standing) -> float:
    """Gap between footprints, metres, negative where they overlap; infinite where one is above the other.

    Of what is far apart the gap between the circles around the footprints, which is less.
    """
    if a.z_bottom > b.z_top - TOUCHING or b.z_bottom > a.z_top - TOUCHING:
        return np.inf
    between = _distance(a, b) - a.stance.radius - b.stance.radius
    return between if between > FAR else a.separation(b)


def _is_near(a: Standing, b: Standing, metres: float) -> bool:
    """Whether the gap between footprints is less than that; asked often, and answered by the circles where these do."""
    return _distance(a, b) - a.stance.radius - b.stance.radius < metres and _clearance(a, b) < metres


def _distance(a: Standing, b: Standing) -> float:
    """Between the origins, seen from above, metres."""
    A, B = a.T_table_stance, b.T_table_stance
    return hypot(A[0, 3] - B[0, 3], A[1, 3] - B[1, 3])


def _hidden(item: Standing, others: Sequence[Standing], scene: Scene) -> float:
    """What it costs that the camera does not see an object at a place, metres."""
    return 0.0 if scene.eye is None else HIDDEN * hidden_share(item, others, scene.eye)
