"""Choosing a grasp by pick and place together: complete pick-and-place plans before anything moves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from itertools import chain, islice, product

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, raised
from stages.messages.task import FailedStage, Transfer
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.grasps import HandPose, approaches, distinct_grasps, hand_poses
from stages.planning.motion.motion import free_motion, is_motion_free, restarts, solve_ik, straight_motion
from stages.robots import Robot, Table
from stages.scene.catalogue import CatalogueObject, Grasp

LIFT = 0.12
"""Metres that an object is lifted before it is carried, or half of it where the arm cannot."""
ABOVE = 0.10
"""Metres above its target from which an object is lowered."""
HOVER = 0.008
"""Metres above its target where lowering becomes guarded: below, the support's estimated height is not trusted."""
SLID = 0.06
"""Metres that an object may slide down in the hand."""
RELEASE = 0.010
"""Metres that each finger opens to let go, where there is room."""

_LIFTED = (0.01, LIFT / 2)
"""Metres above where it stands at which is looked for what an object would touch as it is lifted."""
_RESTARTS = 12
"""Random postures from which inverse kinematics starts: near the robot, few of them lead to a free one."""
_KEPT = 3
"""Feasible picks and places per grasp that are paired, and postures at which is looked for what is in the way."""
_TRIED = 64
"""Hand poses per grasp that are tried for the place."""
_TURNS = 8
"""Hand poses per grasp that are examined at each target before anything moves."""
_SUSPECTED = 12
"""Hand poses at which is looked for what is in the way."""


@dataclass(frozen=True)
class Margins:
    """Metres that the hand keeps for errors of what is estimated."""

    clearance: float
    """From everything but what it holds."""
    room: float
    """Between an object and the finger on either side of it, before they close and after they have let go."""


MARGINS = (Margins(0.015, 0.012), Margins(0.006, 0.012), Margins(0.002, 0.006))
"""As much as an uncalibrated camera is off is looked for first; the last is the least with which anything is done."""


@dataclass(frozen=True)
class Pick:
    """Joint motions (W x J) from the pre-grasp to the grasp and from there up, with the object."""

    hand: HandPose
    width: float
    """Metres between the fingers on the way to the grasp."""
    approach: Floats
    lift: Floats


@dataclass(frozen=True)
class Place:
    """Joint motion (W x J) from above the target down to :data:`HOVER` above it."""

    hand: HandPose
    lower: Floats


@dataclass(frozen=True)
class PickPlace:
    """A collision-free way to take an object from where it is to a target."""

    pick: Pick
    place: Place
    reach: Floats
    """W x J, from the start posture to the pre-grasp."""
    carry: Floats
    """W x J, from the end of the lift to above the target."""


@dataclass(frozen=True)
class Errand:
    """What is to be moved: ``entry`` from ``T_base_object`` on ``source`` to one of ``targets`` on ``destination``."""

    entry: CatalogueObject
    T_base_object: Floats
    targets: Floats
    """N x 4 x 4, best first."""
    source: str
    destination: str
    faces: bool = False
    """Whether the targets also say which side is shown; symmetries of the shape do not count then."""


def opening(world: CollisionWorld, grasp: Grasp, room: float) -> float:
    """Metres between the fingers that leave ``room`` on either side of the object."""
    return min(grasp.width + 2 * room, world.robot.gripper.open_width)


class PickPlacePlanner:
    """Searches the grasps that the gripper takes, in the user's order; ``obstacle`` tells how far the search came."""

    def __init__(self, world: CollisionWorld, errand: Errand, rng: np.random.Generator, *, room: float) -> None:
        """``room``: see :class:`Margins`."""
        self._world, self._errand, self._rng, self._room = world, errand, rng, room
        self._entry = errand.entry.without_symmetries() if errand.faces else errand.entry
        self._grasps = [one for one in distinct_grasps(self._entry) if one.width <= world.robot.gripper.widest]
        self.obstacle: tuple[FailedStage, str] = (
            "ik",
            "it is out of reach" if self._grasps else "the catalogue has no grasp for it",
        )
        self._first_picks: dict[str, Pick | None] = {}

    def plans(self, start: Floats) -> Iterator[PickPlace]:
        """Complete plans from joint positions ``start`` (J), most preferred grasp first."""
        for grasp in self._grasps:
            picks = list(islice(self._picks(grasp, start), _KEPT))
            places = list(islice(self._places(grasp, picks[0].lift[-1]), _KEPT)) if picks else []
            yield from self._connected(product(picks, places), start)

    def can_pick(self, start: Floats) -> bool:
        """Whether any grasp takes the object where it is and lifts it; the arm begins at joint positions ``start``."""
        return any(next(self._picks(grasp, start), None) for grasp in self._grasps)

    def reaches(self, number: int, start: Floats) -> bool:
        """Whether a grasp leads from where the object is to a target.

        Motions from ``start`` to the pick and from there to the place are not looked for: the cheap part of
        :meth:`plans`, which all but decides.
        """
        for grasp in self._grasps:
            if grasp.name not in self._first_picks:
                self._first_picks[grasp.name] = next(self._picks(grasp, start), None)
            pick = self._first_picks[grasp.name]
            hands = self._hands(grasp, self._errand.targets[number])[:_TURNS] if pick else []
            if pick and any(self._place(hand, pick.lift[-1]) is not None for hand in hands):
                return True
        return False

    def in_the_way(self, start: Floats) -> list[tuple[str, ...]]:
        """The fewest objects that keep the hand from the pick, or from the place if there is a pick; others in other
        ways, if they are as few.

        Empty where it is not objects that keep it from there. To be asked once :meth:`reaches` has said no.
        """
        poses = self._errand.targets if self.is_picked else [self._errand.T_base_object]
        hands = (hand for T in poses for grasp in self._grasps for hand in self._hands(grasp, T))
        found = (self._touched(hand, start) for hand in islice(hands, _SUSPECTED))
        ways = list(dict.fromkeys(names for names in found if names))
        least = min(map(self._effort, ways), default=None)
        return [names for names in ways if self._effort(names) == least]

    @property
    def is_picked(self) -> bool:
        """Whether :meth:`reaches` has found a grasp that takes the object where it is."""
        return any(self._first_picks.values())

    def _effort(self, names: Sequence[str]) -> tuple[int, int]:
        """How hard it is to clear a place: objects that nobody can move, then objects."""
        return sum(not self._world.objects[name].grasps for name in names), len(names)

    def _touched(self, hand: HandPose, start: Floats) -> tuple[str, ...]:
        """Objects too near the hand or what it holds, also as that is lifted but for what gives way then; none where a
        posture is not reached or something else is too near."""
        world = self._world
        world.set_width(opening(world, hand.grasp, self._room))
        placing = [self.holding(hand), world.resting(self._errand.destination)]
        before = raised(hand.T_base_hand, ABOVE) if self.is_picked else hand.T_base_prehand
        with ExitStack() as stack:
            for context in placing if self.is_picked else [world.touching(world.carried)]:
                stack.enter_context(context)
            found = [self._near(T, start) for T in (hand.T_base_hand, before)]
        if not self.is_picked:
            with self.holding(hand), world.resting(self._errand.source):
                q = next(self._postures(hand.T_base_hand, start), None)
                with world.resting(*(() if q is None else self._leaning(q))):
                    found += [self._near(raised(hand.T_base_hand, height), start) for height in _LIFTED]
        return () if None in found else tuple(sorted(set[str]().union(*filter(None, found))))

    def _near(self, T_base_hand: Floats, start: Floats) -> set[str] | None:
        """Objects too near in the first posture in which nothing else is."""
        for q in islice(self._postures(T_base_hand, start), _KEPT):
            near = [self._world.objects.keys() & set(pair) for pair in self._world.contacts(q)]
            if all(near):
                return set[str]().union(*near)
        return None

    def _hands(self, grasp: Grasp, T_base_object: Floats) -> list[HandPose]:
        return hand_poses(self._entry, grasp, T_base_object)

    def _connected(self, pairs: Iterable[tuple[Pick, Place]], start: Floats) -> Iterator[PickPlace]:
        """Joins picks and places by motions in joint space."""
        for pick, place in pairs:
            self._world.set_width(pick.width)
            reach = free_motion(self._world, start, pick.approach[0], self._rng)
            if reach is None:
                self._note("pick motion", "no free motion to the pre-grasp")
                continue
            carry = self._carry(pick, place)
            if carry is None:
                self._note("place motion", "no free motion that carries it to the target")
                continue
            yield PickPlace(pick, place, reach, carry)

    def _carry(self, pick: Pick, place: Place) -> Floats | None:
        """At best with room below for what slides down in the hand, and free for what does not in any case."""
        hand = pick.hand
        T_base_object = hand.T_base_hand @ inverse(hand.T_object_hand)
        for slid in (SLID, 0.0):
            T_hand_object = inverse(hand.T_base_hand) @ raised(T_base_object, -slid)
            with self._world.holding(T_hand_object, hand.grasp.width):
                carry = free_motion(self._world, pick.lift[-1], place.lower[0], self._rng)
            with self.holding(hand):
                if carry is not None and is_motion_free(self._world, carry):
                    return carry
        return None

    def _picks(self, grasp: Grasp, start: Floats) -> Iterator[Pick]:
        for hand in self._hands(grasp, self._errand.T_base_object):
            pick = self._pick(hand, start)
            if pick is not None:
                yield pick

    def _pick(self, hand: HandPose, start: Floats) -> Pick | None:
        """The first posture before the grasp from which straight motions lead to it, and up from there."""
        world, width = self._world, opening(self._world, hand.grasp, self._room)
        for pregrasp in chain.from_iterable(self._postures(before, start) for before in approaches(hand)):
            world.set_width(width)
            is_free = world.is_free(pregrasp)
            with world.touching(world.carried):
                approach = straight_motion(world, pregrasp, hand.T_base_hand) if is_free else None
            if approach is None:
                reached = solve_ik(world, hand.T_base_hand, seeds=iter([pregrasp]), free=False) is not None
                if reached and is_free:
                    self._note("pick motion", "no straight approach to a grasp")
                elif reached:
                    self._note("ik", "no grasp of it is reachable without a collision")
                continue
            lift = self._lift(hand, approach[-1])
            if lift is not None:
                return Pick(hand, width, approach, lift)
            self._note("pick motion", "no way to lift it")
        return None

    def _lift(self, hand: HandPose, q: Floats) -> Floats | None:
        """Straight up from joint positions ``q``; what leans on the object, or it on that, gives way if need be."""
        world, heights = self._world, (LIFT, LIFT / 2)
        with self.holding(hand), world.resting(self._errand.source), world.resting(*self._leaning(q)):
            lifts = (straight_motion(world, q, raised(hand.T_base_hand, height)) for height in heights)
            return next((found for found in lifts if found is not None), None)

    def _leaning(self, q: Floats) -> set[str]:
        """What leans on the held object, or that on it, at joint positions ``q`` (J) of the grasp; with the least
        margins alone it gives way as the object is lifted."""
        return self._world.touched(q) if self._world.clearance == MARGINS[-1].clearance else set()

    def _postures(self, T_base_hand: Floats, *first: Floats) -> Iterator[Floats]:
        """Joint positions (J) with the hand at a pose, collisions or not."""
        for seed in restarts(self._world, self._rng, *first, extra=_RESTARTS):
            q = solve_ik(self._world, T_base_hand, seeds=iter([seed]), free=False)
            if q is not None:
                yield q

    def _places(self, grasp: Grasp, seed: Floats) -> Iterator[Place]:
        hands = (hand for target in self._errand.targets for hand in self._hands(grasp, target))
        for hand in islice(hands, _TRIED):
            place = self._place(hand, seed)
            if place is not None:
                yield place

    def _place(self, hand: HandPose, seed: Floats) -> Place | None:
        """The first posture above the target from which straight motions lead down, and back once the hand is open."""
        world = self._world
        if self.obstacle[0] != "place motion":
            self._note("place motion", "no reachable posture above the target")
        for q in self._postures(raised(hand.T_base_hand, ABOVE), seed, world.robot.home):
            with self.holding(hand):
                if not world.is_free(q):
                    continue
                with world.resting(self._errand.destination):
                    lower = straight_motion(world, q, raised(hand.T_base_hand, HOVER))
            if lower is None:
                self._note("place motion", "no free way down to the target")
            elif self.retreat(hand, lower[-1]) is None:
                self._note("place motion", "no free way out after letting go")
            else:
                return Place(hand, lower)
        return None

    def retreat(self, hand: HandPose, q: Floats) -> Floats | None:
        """Motion (W x J) of the open hand from joint positions ``q`` out of a place at ``hand``."""
        self._world.set_width(opening(self._world, hand.grasp, self.release))
        off = self._world.hand(q) @ inverse(hand.T_base_hand)
        with self._world.touching(self._world.carried):
            ways = (straight_motion(self._world, q, off @ before) for before in approaches(hand))
            return next((way for way in ways if way is not None), None)

    @property
    def release(self) -> float:
        """Metres that each finger opens to let go."""
        return min(RELEASE, self._room)

    def holding(self, hand: HandPose) -> AbstractContextManager[None]:
        """While it lasts, the object is in the hand as at ``hand``."""
        return self._world.holding(inverse(hand.T_object_hand), hand.grasp.width)

    def _note(self, stage: FailedStage, reason: str) -> None:
        """Remembers the latest stage that a plan failed in."""
        order = ("ik", "pick motion", "place motion")
        if order.index(stage) >= order.index(self.obstacle[0]):
            self.obstacle = (stage, reason)


def planners(
    robot: Robot,
    table: Table,
    objects: Mapping[str, tuple[CatalogueObject, Floats]],
    transfer: Transfer,
    rng: np.random.Generator,
) -> Iterator[tuple[CollisionWorld, PickPlacePlanner]]:
    """Planners for one transfer, and the scene that each plans in; those with the widest margins come first.

    ``objects``: by name, with T_base_object.
    """
    entry, T_base_object = objects[transfer.object]
    errand = Errand(
        entry, T_base_object, transfer.T_base_targets, transfer.source, transfer.destination, transfer.faces
    )
    for margins in MARGINS:
        world = CollisionWorld(robot, table, objects, carried=transfer.object, clearance=margins.clearance)
        yield world, PickPlacePlanner(world, errand, rng, room=margins.room)
