"""Carrying out one pick and place: commands out, encoders in, an outcome at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages import Outcome, RobotCommand, RobotState, TransferRequest
from stages.messages.task import FailedStage
from stages.planning.collision import CollisionWorld
from stages.planning.motion import free_motion, straight_motion, time_parameterise
from stages.planning.pick_place import HOVER, LIFT, RELEASE, ROOM, Errand, PickPlace, PickPlacePlanner, opening, raised
from stages.robots import Robot, Table
from stages.scene.catalogue import Catalogue, Grasp

Routine = Generator[RobotCommand, RobotState, "Outcome"]
Steps = Generator[RobotCommand, RobotState, tuple[FailedStage, str]]
"""Yields commands, receives encoders, returns the failed stage ("" for success) and the reason."""

_CLEARANCES = (0.006, 0.002)
"""Metres: a plan with ample clearance is looked for first."""
_FAST, _SLOW = 0.7, 0.4
"""Share of the joint limits for free motions and for motions next to objects."""
_LOWERING_STEP = 0.002
_LOWEST = -0.008
"""Metres below the estimated target at which guarded lowering stops, whatever it feels."""
_CONTACT = 0.001
"""Metres that the hand must lag behind while it is lowered to count as contact."""
_AWAY = 0.05
"""Radians from home beyond which the arm first goes home."""


@dataclass
class _Tally:
    attempts: int = 0
    planning_seconds: float = 0.0
    started: float = 0.0
    clock: float = 0.0
    grasp: str = ""
    T_base_object: Floats | None = None
    """Where the hand let go of the object."""


class TransferRoutine:
    """One transfer as a generator of commands; planned wholly before the hand closes on anything.

    A grasp that closes on nothing leads to the next one. Whatever happens, the arm ends at home with an open hand.
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
        self._table = replace(table, height=float(request.scene.T_base_table[2, 3]))
        self._objects = {o.name: (catalogue[o.label], o.T_base_object) for o in request.scene.objects}
        self._tally = _Tally()

    def run(self) -> Routine:
        """Commands to execute one after the other; each is answered by the encoders after it."""
        transfer = self._request.transfer
        if transfer.object not in self._objects:
            return self._outcome("ik", f"{transfer.object} is not in the perceived scene")
        self._log(f"{transfer.object} -> {transfer.destination}: planning")
        state = yield self._command("read the encoders")
        self._tally.started = self._tally.clock = state.time
        failure = yield from self._go_home_first(state)
        if not failure[0]:
            failure = yield from self._try_plans()
        self._log(f"{transfer.object}: {f'{failure[0]} failed: {failure[1]}' if failure[0] else 'placed'}")
        return self._outcome(*failure)

    def _go_home_first(self, state: RobotState) -> Steps:
        q = self._arm(state)
        if np.abs(q - self._robot.home).max() < _AWAY:
            return "", ""
        return (yield from self._home(self._world(_CLEARANCES[-1]), q))

    def _try_plans(self) -> Steps:
        failure: tuple[FailedStage, str] = ("ik", "")
        for clearance in _CLEARANCES:
            world = self._world(clearance)
            planner = PickPlacePlanner(world, self._errand(), self._rng)
            for plan in self._timed(planner.plans(self._robot.home)):
                failure = yield from self._execute(world, planner, plan)
                if failure[0] != "grasp" or self._tally.attempts >= self._attempts:
                    return failure
            if self._tally.attempts == 0:
                failure = planner.obstacle
        return failure

    def _execute(self, world: CollisionWorld, planner: PickPlacePlanner, plan: PickPlace) -> Steps:
        self._tally.attempts += 1
        self._tally.grasp = plan.pick.hand.grasp.name
        grasp = plan.pick.hand.grasp
        yield self._command("open the hand", width=opening(world, grasp, ROOM))
        yield self._command(f"reach for {world.carried}", plan.reach)
        state = yield self._command(f"close on {world.carried}", plan.pick.approach, speed=_SLOW, width=0.0)
        if not self._is_held(state, grasp):
            return (yield from self._back_off(world, plan, state))
        self._log(f"{world.carried}: grasped with {grasp.name!r}, {1e3 * state.gripper_width:.0f} mm wide")
        state = yield self._command(f"lift {world.carried}", plan.pick.lift, speed=_SLOW)
        if self._is_held(state, grasp):
            state = yield self._command(f"carry {world.carried}", plan.carry)
        if not self._is_held(state, grasp):
            return (yield from self._give_up(world, state))
        return (yield from self._put_down(world, planner, plan))

    def _back_off(self, world: CollisionWorld, plan: PickPlace, state: RobotState) -> Steps:
        """Out of a grasp that closed on nothing."""
        expected = plan.pick.hand.grasp.width
        reason = f"the fingers closed to {1e3 * state.gripper_width:.0f} mm instead of {1e3 * expected:.0f}"
        self._log(f"{world.carried}: not grasped with {self._tally.grasp!r}: {reason}")
        yield self._command("open the hand", width=self._robot.gripper.open_width)
        yield self._command("back off", plan.pick.approach[::-1], speed=_SLOW)
        failure = yield from self._home(world, plan.pick.approach[0])
        return failure if failure[0] else ("grasp", reason)

    def _give_up(self, world: CollisionWorld, state: RobotState) -> Steps:
        """Home after the object slipped out of the hand; what lies where is unknown until the next look."""
        yield self._command("open the hand", width=self._robot.gripper.open_width)
        failure = yield from self._home(world, self._arm(state))
        return failure if failure[0] else ("grasp", "it slipped out of the hand while it was lifted or carried")

    def _put_down(self, world: CollisionWorld, planner: PickPlacePlanner, plan: PickPlace) -> Steps:
        hand = plan.place.hand
        state = yield self._command(f"lower {world.carried}", plan.place.lower, speed=_SLOW)
        q = yield from self._lower_until_contact(world, state, plan.place.lower[-1], hand.T_base_hand)
        held = state.gripper_width
        wanted = min(held + 2 * RELEASE, self._robot.gripper.open_width)
        state = yield self._command(f"let go of {world.carried}", width=wanted)
        left = world.hand(q) @ inverse(plan.pick.hand.T_object_hand)
        world.move(left)
        retreat = planner.retreat(hand, q)
        retreat = plan.place.lower[::-1] if retreat is None else retreat
        yield self._command("retreat", retreat, speed=_SLOW)
        yield self._command("open the hand", width=self._robot.gripper.open_width)
        world.set_width(self._robot.gripper.open_width)
        failure = yield from self._home(world, retreat[-1])
        if state.gripper_width < (held + wanted) / 2:
            return "release", f"the hand opened to {1e3 * state.gripper_width:.0f} mm of {1e3 * wanted:.0f}"
        self._tally.T_base_object = left
        return failure

    def _lower_until_contact(
        self, world: CollisionWorld, state: RobotState, q: Floats, T_base_hand: Floats
    ) -> Generator[RobotCommand, RobotState, Floats]:
        """Lowers step by step until the support holds the hand back; returns the last commanded posture (J)."""
        sag = self._lag(world, q, state)
        for height in np.arange(HOVER - _LOWERING_STEP, _LOWEST, -_LOWERING_STEP):
            step = straight_motion(world, q, raised(T_base_hand, height), free=False)
            if step is None:
                break
            state = yield self._command("feel for the support", step, speed=_SLOW)
            q = step[-1]
            if self._lag(world, q, state) - sag > _CONTACT:
                break
        return q

    def _home(self, world: CollisionWorld, q: Floats) -> Steps:
        """Collision-free motion home; where something is too close, after a step straight up."""
        began = time.perf_counter()
        path = free_motion(world, q, self._robot.home, self._rng)
        if path is None:
            path = self._home_from_above(world, q)
        self._tally.planning_seconds += time.perf_counter() - began
        if path is None:
            return "release", f"no free motion home; too close: {world.contacts(q) or 'nothing'}"
        yield self._command("go home", path)
        return "", ""

    def _home_from_above(self, world: CollisionWorld, q: Floats) -> Floats | None:
        rise = straight_motion(world, q, raised(world.hand(q), LIFT), free=False)
        onward = None if rise is None else free_motion(world, rise[-1], self._robot.home, self._rng)
        return None if rise is None or onward is None else np.vstack([rise, onward])

    def _world(self, clearance: float) -> CollisionWorld:
        carried = self._request.transfer.object
        return CollisionWorld(self._robot, self._table, self._objects, carried=carried, clearance=clearance)

    def _errand(self) -> Errand:
        transfer = self._request.transfer
        entry, T = self._objects[transfer.object]
        return Errand(entry, T, transfer.T_base_targets, transfer.source, transfer.destination)

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
        self._tally.clock = state.time
        shut = self._robot.gripper.closed_width
        return shut + 0.5 * (grasp.width - shut) < state.gripper_width < grasp.width + ROOM

    def _lag(self, world: CollisionWorld, q: Floats, state: RobotState) -> float:
        """Metres that the hand is higher than commanded."""
        return float(world.hand(self._arm(state))[2, 3] - world.hand(q)[2, 3])

    def _arm(self, state: RobotState) -> Floats:
        self._tally.clock = state.time
        where = {name: index for index, name in enumerate(state.joint_names)}
        return state.positions[[where[name] for name in self._robot.joints]]

    def _command(
        self, label: str, waypoints: Floats | None = None, *, speed: float = _FAST, width: float | None = None
    ) -> RobotCommand:
        """A trajectory through ``waypoints`` (W x J), then a gripper width; either may be absent."""
        if waypoints is None:
            none = np.zeros((0, len(self._robot.joints)))
            return RobotCommand(times=np.zeros(0), positions=none, velocities=none, gripper_width=width, label=label)
        motion = time_parameterise(self._robot, waypoints, speed=speed)
        return RobotCommand(
            joint_names=self._robot.joints,
            times=motion.times,
            positions=motion.positions,
            velocities=motion.velocities,
            gripper_width=width,
            label=label,
        )

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
        )
