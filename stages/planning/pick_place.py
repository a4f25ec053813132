"""Choosing a grasp by pick and place together: complete pick-and-place plans before anything moves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import islice, product

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages.task import FailedStage
from stages.planning.collision import CollisionWorld
from stages.planning.grasps import HandPose, distinct_grasps, hand_poses
from stages.planning.motion import free_motion, restarts, solve_ik, straight_motion
from stages.scene.catalogue import CatalogueObject, Grasp

LIFT = 0.12
"""Metres that an object is lifted before it is carried."""
ABOVE = 0.10
"""Metres above its target from which an object is lowered."""
HOVER = 0.008
"""Metres above its target where lowering becomes guarded: below, the support's estimated height is not trusted."""
ROOM = 0.012
"""Metres between object and finger on each side before closing: room for errors of the estimated pose."""
RELEASE = 0.010
"""Metres that each finger opens to let go."""

_RESTARTS = 6
_KEPT = 3
"""Feasible picks and places per grasp that are paired."""
_TRIED = 64
"""Hand poses per grasp that are tried for the place."""


@dataclass(frozen=True)
class Pick:
    """Joint motions (W x J) from the pre-grasp to the grasp and from there up, with the object."""

    hand: HandPose
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


def opening(world: CollisionWorld, grasp: Grasp, room: float) -> float:
    """Metres between the fingers that leave ``room`` on either side of the object."""
    return min(grasp.width + 2 * room, world.robot.gripper.open_width)


def raised(T_base_hand: Floats, height: float) -> Floats:
    """The same pose ``height`` metres higher."""
    result = T_base_hand.copy()
    result[2, 3] += height
    return result


class PickPlacePlanner:
    """Searches grasps in the user's order; ``obstacle`` tells how far the search came."""

    def __init__(self, world: CollisionWorld, errand: Errand, rng: np.random.Generator) -> None:
        self._world, self._errand, self._rng = world, errand, rng
        self.obstacle: tuple[FailedStage, str] = ("ik", "the catalogue has no grasp for it")

    def plans(self, start: Floats) -> Iterator[PickPlace]:
        """Complete plans from joint positions ``start`` (J), most preferred grasp first."""
        for grasp in distinct_grasps(self._errand.entry):
            picks = list(islice(self._picks(grasp, start), _KEPT))
            places = list(islice(self._places(grasp, picks[0].lift[-1]), _KEPT)) if picks else []
            yield from self._connected(product(picks, places), start)

    def _connected(self, pairs: Iterable[tuple[Pick, Place]], start: Floats) -> Iterator[PickPlace]:
        """Joins picks and places by motions in joint space."""
        for pick, place in pairs:
            self._world.set_width(opening(self._world, pick.hand.grasp, ROOM))
            reach = free_motion(self._world, start, pick.approach[0], self._rng)
            if reach is None:
                self._note("pick motion", "no free motion to the pre-grasp")
                continue
            with self.holding(pick.hand):
                carry = free_motion(self._world, pick.lift[-1], place.lower[0], self._rng)
            if carry is None:
                self._note("place motion", "no free motion that carries it to the target")
                continue
            yield PickPlace(pick, place, reach, carry)

    def _picks(self, grasp: Grasp, start: Floats) -> Iterator[Pick]:
        for hand in hand_poses(self._errand.entry, grasp, self._errand.T_base_object):
            pick = self._pick(hand, start)
            if pick is not None:
                yield pick

    def _pick(self, hand: HandPose, start: Floats) -> Pick | None:
        world = self._world
        world.set_width(opening(world, hand.grasp, ROOM))
        pregrasp = solve_ik(world, hand.T_base_prehand, seeds=restarts(world, self._rng, start, extra=_RESTARTS))
        if pregrasp is None:
            return self._note("ik", "no grasp of it is reachable without a collision")
        with world.touching(world.carried):
            approach = straight_motion(world, pregrasp, hand.T_base_hand)
        if approach is None:
            return self._note("pick motion", "no straight approach to a grasp")
        with self.holding(hand), world.resting(self._errand.source):
            lift = straight_motion(world, approach[-1], raised(hand.T_base_hand, LIFT))
        return self._note("pick motion", "no way to lift it") if lift is None else Pick(hand, approach, lift)

    def _places(self, grasp: Grasp, seed: Floats) -> Iterator[Place]:
        hands = (hand for target in self._errand.targets for hand in hand_poses(self._errand.entry, grasp, target))
        for hand in islice(hands, _TRIED):
            place = self._place(hand, seed)
            if place is not None:
                yield place

    def _place(self, hand: HandPose, seed: Floats) -> Place | None:
        world = self._world
        above = raised(hand.T_base_hand, ABOVE)
        with self.holding(hand):
            q = solve_ik(world, above, seeds=restarts(world, self._rng, seed, world.robot.home, extra=_RESTARTS))
            if q is None:
                return self._note("place motion", "no reachable posture above the target")
            with world.resting(self._errand.destination):
                lower = straight_motion(world, q, raised(hand.T_base_hand, HOVER))
        if lower is None:
            return self._note("place motion", "no free way down to the target")
        if self.retreat(hand, lower[-1]) is None:
            return self._note("place motion", "no free way out after letting go")
        return Place(hand, lower)

    def retreat(self, hand: HandPose, q: Floats) -> Floats | None:
        """Motion (W x J) of the open hand from joint positions ``q`` out of a place at ``hand``."""
        self._world.set_width(opening(self._world, hand.grasp, RELEASE))
        backwards = self._world.hand(q) @ inverse(hand.T_base_hand) @ hand.T_base_prehand
        with self._world.touching(self._world.carried):
            return straight_motion(self._world, q, backwards)

    def holding(self, hand: HandPose) -> AbstractContextManager[None]:
        """While it lasts, the object is in the hand as at ``hand``."""
        return self._world.holding(inverse(hand.T_object_hand), hand.grasp.width)

    def _note(self, stage: FailedStage, reason: str) -> None:
        """Remembers the latest stage that a plan failed in."""
        order = ("ik", "pick motion", "place motion")
        if order.index(stage) >= order.index(self.obstacle[0]):
            self.obstacle = (stage, reason)
