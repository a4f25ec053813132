"""Carrying out one pick and place: commands out, encoders in, an outcome at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, raised
from stages.messages import Outcome, RobotCommand, RobotState, TransferRequest
from stages.messages.robot import Guard
from stages.messages.task import FailedStage
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.motion import (
    FAST,
    RUB,
    SLOW,
    arm,
    back_along,
    densify,
    free_motion,
    onward,
    robot_command,
    straight_motion,
    way_back,
    way_out,
)
from stages.planning.motion.pick_place import (
    LIFT,
    MARGINS,
    SLID,
    Pick,
    PickPlace,
    PickPlacePlanner,
    Place,
    planners,
)
from stages.planning.motion.rehearsal import Rehearsal
from stages.planning.motion.unknown import unknown_objects
from stages.robots import Robot, Table
from stages.scene.catalogue import Catalogue, Grasp

Routine = Generator[RobotCommand, RobotState, "Outcome"]
Steps = Generator[RobotCommand, RobotState, tuple[FailedStage, str]]
"""Yields commands, receives encoders, returns the failed stage ("" for success) and the reason."""

_GENTLE, _YIELDS = 0.1, 0.004
"""The same where a touch is wanted, and radians (metres) that a joint is held back by one: 3 mm at the hand."""
_LOWEST = -0.008
"""Metres below the estimated target at which guarded lowering stops, whatever it feels."""
_EARLY = 0.025
"""Metres above the target from which on a touch, while an object is lowered, is its support, whatever is beside it."""
_TOUCH, _BUMP = 4.0, 7.0
"""Newtons at the hand that are a touch in slow motions, and in fast ones, in which servos lag behind."""
_BORNE = 0.3
"""Share of an object's weight that the hand feels, at least, once it is lifted: it may weigh half of what is known."""
_FELT = 0.2
"""Newtons up to which the hand cannot tell a weight from its own strain, where it did not close on the very middle."""
_PRESS = 12.0
"""Newtons from which on a finger does not slip past the object but stands on it."""
_ASIDE = 0.012
"""Metres by which the hand evades to either side when a finger comes down on the object: as much as there is room."""
_WIDER = 0.012
"""Metres by which the fingers may stand wider on an object than it is."""
_EMPTY = 0.003
"""Metres beyond closed up to which nothing is between the fingers."""
_G = 9.81
_WAYS_BACK = 4
"""Times that the way back is tried."""
_AWAY = 0.05
"""Radians from home beyond which the arm first goes home, and from a straight way within which it returns along it."""


@dataclass
class _Tally:
    attempts: int = 0
    planning_seconds: float = 0.0
    started: float = 0.0
    clock: float = 0.0
    grasp: str = ""
    T_base_object: Floats | None = None
    """Where the hand let go of the object."""


@dataclass(frozen=True)
class _UnderWay:
    """What is being carried out, for whoever has to find the way back from the middle of it."""

    world: CollisionWorld
    planner: PickPlacePlanner
    plan: PickPlace


class _BrokenOff(Exception):
    """A command was not carried out to its end."""

    def __init__(self, state: RobotState, label: str, waypoints: Floats | None) -> None:
        super().__init__(f"{state.reason} on the way to {label}")
        self.state, self.waypoints = state, waypoints
        """Of a free motion, whose beginning is free; None of one next to objects."""


class TransferRoutine:
    """One transfer as a generator of commands; planned wholly before the hand closes on anything.

    A grasp that closes on nothing leads to the next one. A slip or a touch breaks the transfer off: what is held goes
    back where it was taken from. Whatever happens, the arm ends at home with an open hand, unless somebody stops it.
    """

    def __init__(
        self,
        request: TransferRequest,
        *,
        robot: Robot,
        table: Table,
        catalogue: Catalogue,
        rng: np.random.Generator,
        attempts: int,
        log: Callable[[str], None],
    ) -> None:
        self._request, self._robot, self._rng, self._attempts, self._log = request, robot, rng, attempts, log
        self._table = table.seen(request.scene.T_base_table, request.scene.support)
        objects = {o.name: (catalogue[o.label], o.T_base_object) for o in request.scene.objects}
        self._objects = objects | unknown_objects(request.scene, objects, robot, self._table)
        self._tally = _Tally()
        self._under_way: _UnderWay | None = None
        self.in_hand = ""
        """What the hand holds, as far as it has felt."""

    def run(self) -> Routine:
        """Commands to execute one after the other; each is answered by the encoders after it."""
        transfer = self._request.transfer
        if transfer.object not in self._objects:
            return self._outcome("ik", f"{transfer.object} is not in the perceived scene")
        self._log(f"{transfer.object} -> {transfer.destination}: planning")
        try:
            state = yield from self._do("read the encoders")
            self._tally.started = self._tally.clock
            failure = yield from self._go_home_first(state)
            if not failure[0]:
                failure = yield from (self._rehearse(state.reason) if state.shown else self._try_plans())
        except _BrokenOff as broken:
            let_go = self._tally.T_base_object is not None
            failure = yield from self._come_back(broken)
            if not failure[0] or (failure[0] == "unknown" and not let_go):
                # Whether what was let go of before stands where it should is for the next look to say.
                failure = "unknown" if let_go else broken.state.stopped, str(broken)
        ending = f"{failure[0]}: {failure[1]}" if failure[0] else "let go of, and felt to stand"
        self._log(f"{transfer.object}: {ending}")
        return self._outcome(*failure)

    def recover(self) -> Routine:
        """Commands that bring the arm home from where it was stopped."""
        try:
            state = yield from self._do("read the encoders")
            self._tally.started = self._tally.clock
            failure = yield from self._way_back(state)
        except _BrokenOff as broken:
            failure = yield from self._come_back(broken)
        if failure[0] == "unknown":
            failure = "", ""  # The arm is at home; whether what it held stands is for the next look to say.
        return replace(self._outcome(*failure), number=0)

    def _come_back(self, broken: _BrokenOff) -> Steps:
        """After a slip or a touch; where somebody asks to stop, the robot fails or the way back is barred, the arm
        stays."""
        newest = broken
        for tries in range(_WAYS_BACK):
            if newest.state.stopped in ("stop", "fault"):
                break
            self._log(f"broken off: {newest}")
            try:
                state = newest.state if self.in_hand else (yield from self._retrace(newest))
                return (yield from self._way_back(state, rise=(tries + 1) * LIFT))
            except _BrokenOff as again:
                newest = again
        return self._stands(newest)

    def _retrace(self, broken: _BrokenOff) -> Generator[RobotCommand, RobotState, RobotState]:
        """The empty hand goes back the way that it came, which was free."""
        if broken.waypoints is None:
            return broken.state
        return (yield from self._carry_out(way_back(self._robot, broken.waypoints, broken.state)))

    def _stands(self, broken: _BrokenOff) -> tuple[FailedStage, str]:
        """The arm stays where it is."""
        stopped = broken.state.stopped
        failed: FailedStage = stopped if stopped in ("stop", "fault") else "touch"
        why = {"stop": "as asked", "fault": str(broken)}.get(stopped, f"the way back is barred: {broken}")
        return failed, f"stopped, {why}; in the hand: {self.in_hand or 'nothing'}"

    def _way_back(self, state: RobotState, *, rise: float = 0.0) -> Steps:
        """From wherever the arm stands: what is held goes back to where it was taken from, the hand goes home."""
        at, q = self._under_way, self._arm(state)
        if at is None:
            return (yield from self._home(self._world(), q, rise=rise))
        if self.in_hand:
            state = yield from self._do("feel what is in the hand", width=0.0)
            if state.gripper_width > self._robot.gripper.closed_width + _EMPTY:
                return (yield from self._put_back(at, state))
        yield from self._do("open the hand", width=self._robot.gripper.open_width)
        self.in_hand = ""
        distance, back = back_along(at.plan.pick.approach, q)
        if distance < _AWAY:
            yield from self._do("back off", back, speed=SLOW)
            q = back[-1]
        return (yield from self._home(at.world, q, rise=rise))

    def _put_back(self, at: _UnderWay, state: RobotState) -> Steps:
        """What is held, as it is held now, returns the way it came to where it was taken from: both are free and
        within reach."""
        pick, carried, q = at.plan.pick, at.world.carried, self._arm(state)
        distance, lower = back_along(pick.lift, q)
        if distance > _AWAY:
            way = densify(np.vstack([at.plan.carry, at.plan.place.lower]))
            narrowest, widest = self._held_between(state.gripper_width)
            guard = Guard(narrowest=narrowest, widest=widest, force=RUB + self._weight)
            yield from self._do(f"carry {carried} back", back_along(way, q)[1], speed=SLOW, guard=guard)
            lower = pick.lift[::-1]
        # Straight down the way it came, but for the last waypoint: from there on it is felt for. What has slid in the
        # hand hangs lower by nobody knows how much.
        place, guard = Place(pick.hand, lower[: max(1, len(lower) - 1)]), Guard(force=_TOUCH + self._weight)
        return (yield from self._put_down(at, place, guard=guard, early=LIFT))

    def _go_home_first(self, state: RobotState) -> Steps:
        q = self._arm(state)
        if np.abs(q - self._robot.home).max() < _AWAY:
            return "", ""
        return (yield from self._home(self._world(), q))

    def _try_plans(self) -> Steps:
        failure: tuple[FailedStage, str] = ("ik", "")
        request = self._request.transfer
        for world, planner in planners(self._robot, self._table, self._objects, request, self._rng):
            for plan in self._timed(planner.plans(self._robot.home)):
                self._under_way = _UnderWay(world, planner, plan)
                failure = yield from self._execute(self._under_way)
                if failure[0] != "grasp" or self._tally.attempts >= self._attempts:
                    return failure
            if self._tally.attempts == 0:
                failure = planner.obstacle
        return failure

    def _rehearse(self, why: str) -> Steps:
        """Nothing moves: the whole plan is shown."""
        rehearsal = Rehearsal(self._robot, self._table, self._objects, self._rng)
        for command in rehearsal.commands((self._request.transfer, *self._request.then)):
            state = yield command
            if state.stopped:
                raise _BrokenOff(state, command.label, None)
        return "fault", f"{why}; {rehearsal.unreached}" if rehearsal.unreached else why

    def _execute(self, at: _UnderWay) -> Steps:
        world, plan, grasp = at.world, at.plan, at.plan.pick.hand.grasp
        self._tally.attempts += 1
        self._tally.grasp = grasp.name
        yield from self._do("open the hand", width=plan.pick.width)
        yield from self._do(f"reach for {world.carried}", plan.reach, guard=Guard(force=_BUMP))
        state, lift = yield from self._take(world, plan.pick)
        if not self._is_held(state, grasp):
            return (yield from self._back_off(world, plan, state))
        self.in_hand = world.carried
        self._log(f"{world.carried}: grasped with {grasp.name!r}, {1e3 * state.gripper_width:.0f} mm wide")
        narrowest, widest = self._held_between(grasp.width)
        holding = Guard(narrowest=narrowest, widest=widest)
        load = _BORNE * self._weight
        lifting = replace(holding, load=load if load > _FELT else 0.0)
        try:
            yield from self._do(f"lift {world.carried}", lift, speed=SLOW, guard=lifting)
        except _BrokenOff as broken:
            if broken.state.stopped == "slip" and self._is_held(broken.state, grasp):
                self.in_hand = ""  # The fingers slide along what they leave behind.
            raise
        yield from self._do(f"carry {world.carried}", plan.carry, guard=replace(holding, force=_BUMP + self._weight))
        guard = replace(holding, force=_TOUCH + self._weight)
        early = SLID if self._stands_alone(at) else _EARLY
        return (yield from self._put_down(at, plan.place, guard=guard, early=early))

    def _stands_alone(self, at: _UnderWay) -> bool:
        """Whether nothing is near an object, coming down, but what will bear it.

        Then it is this that it touches early, once it has slid down in the hand.
        """
        world, place = at.world, at.plan.place
        heights = [world.hand(q)[2, 3] - place.hand.T_base_hand[2, 3] for q in place.lower]
        q = place.lower[max(k for k, height in enumerate(heights) if height > _EARLY)]
        with at.planner.holding(place.hand), world.ample():
            return world.is_free(q)

    def _take(
        self, world: CollisionWorld, pick: Pick
    ) -> Generator[RobotCommand, RobotState, tuple[RobotState, Floats]]:
        """Closes the hand on the object, and says how to lift it.

        The object is not quite where it was estimated: where a finger comes down on it, the hand tries beside that.
        """
        label, guard = f"close on {world.carried}", Guard(force=_PRESS)
        evasions = self._evasions(world, pick)
        approach, lift = pick.approach, pick.lift
        while True:
            try:
                state = yield from self._do(label, approach, speed=SLOW, width=0.0, guard=guard)
            except _BrokenOff as broken:
                evasion = next(evasions, None) if broken.state.stopped == "touch" else None
                if evasion is None:
                    raise
                self._log(f"{broken}; tries beside it")
                _, back = back_along(approach, self._arm(broken.state))
                yield from self._do("back off", back, speed=SLOW)
                approach, lift = evasion
            else:
                return state, lift

    def _evasions(self, world: CollisionWorld, pick: Pick) -> Iterator[tuple[Floats, Floats]]:
        """The same approach, and the lift that follows, with the hand moved along its closing direction."""
        hand = pick.hand
        for metres in (_ASIDE, -_ASIDE):
            shift = np.eye(4)
            shift[1, 3] = metres
            world.set_width(pick.width)
            with world.touching(world.carried):
                beside = straight_motion(world, pick.approach[0], world.hand(pick.approach[0]) @ shift)
                down = None if beside is None else straight_motion(world, beside[-1], hand.T_base_hand @ shift)
            if beside is None or down is None:
                continue
            rise = straight_motion(world, down[-1], raised(hand.T_base_hand @ shift, LIFT), free=False)
            if rise is not None:
                approach = np.vstack([pick.approach[:1], beside[1:], down[1:]])
                yield approach, np.vstack([rise, pick.lift[-1:]])

    def _back_off(self, world: CollisionWorld, plan: PickPlace, state: RobotState) -> Steps:
        """Out of a grasp that closed on nothing."""
        expected = plan.pick.hand.grasp.width
        reason = f"the fingers closed to {1e3 * state.gripper_width:.0f} mm instead of {1e3 * expected:.0f}"
        self._log(f"{world.carried}: not grasped with {self._tally.grasp!r}: {reason}")
        yield from self._do("open the hand", width=self._robot.gripper.open_width)
        yield from self._do("back off", plan.pick.approach[::-1], speed=SLOW)
        failure = yield from self._home(world, plan.pick.approach[0])
        return failure if failure[0] else ("grasp", reason)

    @property
    def _weight(self) -> float:
        """Of the object, as far as it is known, newtons."""
        return _G * self._objects[self._request.transfer.object][0].mass

    def _put_down(self, at: _UnderWay, place: Place, *, guard: Guard, early: float) -> Steps:
        """A touch less than ``early`` metres above the target is the support."""
        world, felt, slid = at.world, False, 0.0
        deeper = straight_motion(world, place.lower[-1], raised(place.hand.T_base_hand, _LOWEST), free=False)
        narrowest, _ = self._held_between(place.hand.grasp.width)
        feeling = Guard(narrowest=narrowest, force=_TOUCH, error=_YIELDS)
        try:
            state = yield from self._do(f"lower {world.carried}", place.lower, speed=SLOW, guard=guard)
            if deeper is not None:
                state = yield from self._do("feel for the support", deeper, speed=_GENTLE, guard=feeling)
            q = self._arm(state)
        except _BrokenOff as broken:
            # What is held by its rim hangs lower than it was lifted.
            state, q, felt = broken.state, self._arm(broken.state), True
            height = world.hand(q)[2, 3] - place.hand.T_base_hand[2, 3]
            if state.stopped != "touch" or height > early:
                raise
            slid = max(height, 0.0)
        held = state.gripper_width
        wanted = min(held + 2 * at.planner.release, self._robot.gripper.open_width)
        state = yield from self._do(f"let go of {world.carried}", width=wanted)
        self.in_hand = ""
        left = raised(world.hand(q) @ inverse(at.plan.pick.hand.T_object_hand), -slid)
        world.move(left)
        self._tally.T_base_object = left
        retreat = at.planner.retreat(place.hand, q)
        retreat = place.lower[::-1] if retreat is None else retreat
        yield from self._do("retreat", retreat, speed=SLOW, guard=Guard(force=RUB))
        failure = yield from self._open_and_home(world, retreat[-1], wanted)
        if state.gripper_width < (held + wanted) / 2:
            self._tally.T_base_object = None
            return "release", f"the hand opened to {1e3 * state.gripper_width:.0f} mm of {1e3 * wanted:.0f}"
        if not (felt or failure[0]):
            return "unknown", f"nothing was felt below {world.carried} where it was let go of"
        return failure

    def _open_and_home(self, world: CollisionWorld, q: Floats, width: float) -> Steps:
        """Opens the hand, from ``width`` metres, where there is room for that, else at home."""
        widest = self._robot.gripper.open_width
        world.set_width(widest)
        room = world.is_free(q)
        if room:
            yield from self._do("open the hand", width=widest)
        else:
            world.set_width(width)
        failure = yield from self._home(world, q)
        if not room and not failure[0]:
            yield from self._do("open the hand", width=widest)
        return failure

    def _home(self, world: CollisionWorld, q: Floats, *, rise: float = 0.0) -> Steps:
        """Collision-free motion home; after a touch, or where something is too close, from straight above, else from
        wherever there is room.

        ``rise``: metres that the hand goes up first.
        """
        began = time.perf_counter()
        path = self._home_from_above(world, q, rise) if rise else None
        path = free_motion(world, q, self._robot.home, self._rng) if path is None else path
        for height in (LIFT, LIFT / 2, LIFT / 4):
            path = self._home_from_above(world, q, height) if path is None else path
        path = onward(world, way_out(world, q, self._rng), self._robot.home, self._rng) if path is None else path
        touches = rise > 0 or world.depth(q) > 0
        self._tally.planning_seconds += time.perf_counter() - began
        if path is None:
            return "release", f"no free motion home; too close: {world.contacts(q) or 'nothing'}"
        # Whatever was touched may still be: away from it slowly, and it does not matter if it rubs.
        speed, force = (SLOW, RUB) if touches else (FAST, _BUMP)
        yield from self._do("go home", path, speed=speed, guard=Guard(force=force))
        self._under_way = None
        return "", ""

    def _home_from_above(self, world: CollisionWorld, q: Floats, height: float) -> Floats | None:
        rise = straight_motion(world, q, raised(world.hand(q), height), free=False)
        return onward(world, rise, self._robot.home, self._rng)

    def _world(self) -> CollisionWorld:
        """The scene, with the least margins: for ways home."""
        carried, clearance = self._request.transfer.object, MARGINS[-1].clearance
        return CollisionWorld(self._robot, self._table, self._objects, carried=carried, clearance=clearance)

    def _timed(self, plans: Iterator[PickPlace]) -> Iterator[PickPlace]:
        """The same plans; the time spent on each is counted."""
        while True:
            began = time.perf_counter()
            plan = next(plans, None)
            self._tally.planning_seconds += time.perf_counter() - began
            if plan is None:
                return
            yield plan

    def _is_held(self, state: RobotState, grasp: Grasp) -> bool:
        """The fingers stalled near the width at which they touch the object."""
        narrowest, widest = self._held_between(grasp.width)
        return narrowest < state.gripper_width < widest

    def _held_between(self, width: float) -> tuple[float, float]:
        """Metres between the fingers while they hold what is that wide, at least and at most."""
        shut = self._robot.gripper.closed_width
        return shut + 0.5 * (width - shut), width + _WIDER

    def _arm(self, state: RobotState) -> Floats:
        return arm(self._robot, state)

    def _do(
        self,
        label: str,
        waypoints: Floats | None = None,
        *,
        speed: float = FAST,
        width: float | None = None,
        guard: Guard | None = None,
    ) -> Generator[RobotCommand, RobotState, RobotState]:
        """Has a motion, or one of the fingers, carried out; free motions can be gone back along."""
        command = robot_command(self._robot, label, waypoints, speed=speed, width=width, guard=guard)
        return (yield from self._carry_out(command, waypoints if speed == FAST else None))

    def _carry_out(
        self, command: RobotCommand, free: Floats | None = None
    ) -> Generator[RobotCommand, RobotState, RobotState]:
        """Has one command carried out, along ``free`` waypoints (W x J) if they are.

        Raises:
            _BrokenOff: it was stopped on the way.
        """
        state = yield command
        self._tally.clock = state.time
        if state.stopped:
            raise _BrokenOff(state, command.label, free)
        return state

    def _outcome(self, failed_stage: FailedStage, reason: str) -> Outcome:
        tally, transfer = self._tally, self._request.transfer
        return Outcome(
            number=self._request.number,
            object=transfer.object,
            destination=transfer.destination,
            success=not failed_stage,
            failed_stage=failed_stage,
            reason=reason,
            grasp=tally.grasp,
            attempts=tally.attempts,
            robot_seconds=tally.clock - tally.started,
            planning_seconds=tally.planning_seconds,
            T_base_object=tally.T_base_object,
            held=self.in_hand,
        )
