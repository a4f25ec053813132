"""Plans made one transfer after the other, each in the scene that those before it leave behind.

The search (:mod:`stages.planning.symbolic.search`) finds the fewest transfers, and learns of room only from steps that
had none: what it learns it never forgets, and in dense scenes that may rule out every order. Here an object that can go
where it belongs goes there; where none can, what is in the way of one is put aside, and waits until that one has
moved. What ends nowhere begins again in another order. Such plans make detours (:func:`shortened`), and may be longer
than they need be even without them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from stages.geometry.arrays import Floats
from stages.planning.places.placements import Scene
from stages.planning.symbolic.problem import TABLE, Problem
from stages.planning.symbolic.search import Moves, State, Step, leads_home
from stages.planning.targets import Blocked, Crowded, Next, Targets, neighbours

_WAYS = 6
"""Tried in all: orders, the first as the objects are listed; in two ways each where some belong beside others."""
_LOOKS = 600
"""Times that places are looked for to make a plan shorter."""
_ASIDE = 2
"""Times that one object is put aside."""


def stepwise(
    problem: Problem, targets: Targets, scene: Scene, rng: np.random.Generator, *, avoided: Sequence[str] = ()
) -> list[tuple[Step, Floats]] | None:
    """Steps with their T_base_targets, N x 4 x 4 each; None where no order leads to the goal.

    Transfers with ``avoided`` keys failed before and get other targets. Where an order does not lead there as
    things stand, what belongs beside something is put aside, and what it belongs beside goes to where it was shown.
    """
    order = list(problem.items)
    starts: list[tuple[Problem, Iterable[str]]] = [(problem, ())]
    if problem.regions:
        starts.append((problem.laid_out_anew(), problem.regions))
    for _ in range(_WAYS // len(starts)):
        for attempt, apart in starts:
            way = _Way(Moves(attempt, order), attempt, targets, scene, avoided)
            if way.leads_home(apart):
                return way.steps
        rng.shuffle(order)
    return None


def shortened(
    steps: Iterable[tuple[Step, Floats]],
    problem: Problem,
    targets: Targets,
    scene: Scene,
    *,
    avoided: Sequence[str] = (),
) -> list[tuple[Step, Floats]]:
    """Steps with their T_base_targets, without those that the others can do without, at first all of one object's;
    ``avoided`` as above. After as many looks for places as are worth it the plan is short enough.
    """
    never, enough = hopeless(avoided), targets.looked + _LOOKS

    def placed(fewer: Sequence[Step]) -> list[tuple[Step, Floats]] | None:
        again = [step for step in fewer if step.key in avoided]
        if targets.looked > enough or not leads_home(fewer, problem) or any(step.key in never for step in fewer):
            return None
        poses = targets.of(fewer, scene, again=again, late=problem.items, what="a shorter plan")
        return list(zip(fewer, poses, strict=True)) if isinstance(poses, list) else None

    best, k = list(steps), 0
    for item in dict.fromkeys(step.item for step, _ in best):
        best = placed([step for step, _ in best if step.item != item]) or best
    while k < len(best):
        fewer = placed(_without([step for step, _ in best], k))
        best, k = (fewer, k) if fewer else (best, k + 1)
    return best


def hopeless(avoided: Sequence[str]) -> set[str]:
    """Of keys of transfers that failed those that occur again: they failed in other places, too."""
    return {key for key in avoided if avoided.count(key) > 1}


def _without(steps: Sequence[Step], k: int) -> list[Step]:
    """Steps without one of them; the next of its object begins where it did."""
    rest = [*steps[:k], *steps[k + 1 :]]
    after = next((i for i in range(k, len(rest)) if rest[i].item == steps[k].item), None)
    if after is not None:
        rest[after] = replace(rest[after], source=steps[k].source)
    return rest


class _Way:
    """One way forward."""

    def __init__(self, moves: Moves, problem: Problem, targets: Targets, scene: Scene, avoided: Sequence[str]) -> None:
        self.steps: list[tuple[Step, Floats]] = []
        self._moves, self._problem, self._targets, self._avoided = moves, problem, targets, avoided
        self._state, self._scene = moves.start, scene
        self._asides: Counter[str] = Counter()
        self._waits: dict[str, str] = {}
        """What was put aside -> the object for which it was."""

    def leads_home(self, apart: Iterable[str]) -> bool:
        """Goes on until the goal is reached, or nothing can be moved any more; before that, ``apart`` are put aside."""
        for name in apart:
            while self._put_aside([(name, name)]) and name not in self._asides:
                pass
        while not self._moves.reached(self._state):
            blocked = self._go_home()
            if blocked is not None and not self._put_aside(self._hindering(blocked)):
                return False
        return True

    def _go_home(self) -> list[Blocked] | None:
        """Takes the first object home that can go there, at best in nobody's way; else what all are blocked by."""
        final = [move for move in self._moves.final(self._state) if move[0].item not in self._waits]
        blocked: list[Blocked] = []
        for late in (False, True):
            for step, after in final:
                others = [item for item in self._moves.pending(self._state) if item != step.item]
                found = self._next(step, others, late=late)
                if isinstance(found, Next):
                    self._go(step, after, found)
                    return None
                if isinstance(found, Blocked):
                    blocked.append(found)
        return blocked

    def _hindering(self, blocked: Sequence[Blocked]) -> list[tuple[str, str]]:
        """What is in the way, and of which object; then what must move."""
        ahead = [(name, one.step.item) for one in blocked for name in self._in_the_way(one)]
        return ahead + [(name, name) for name in self._moves.pending(self._state)]

    def _put_aside(self, ahead: list[tuple[str, str]]) -> bool:
        """Puts the first object aside that can be, or what is in the way of that; ``ahead`` also says for which."""
        pending = self._moves.pending(self._state)
        tried: set[str] = set()
        while ahead:
            below, other = ahead.pop(0)
            name = self._uppermost(below)
            if name in tried or name not in self._problem.graspable or self._asides[name] == _ASIDE:
                continue
            tried.add(name)
            step, after = self._moves.aside(name, self._state)
            awaits = self._home_of(other) if other != name else None
            found = self._next(step, [*pending, name], late=True, awaits=awaits)
            if isinstance(found, Next):
                self._go(step, after, found)
                self._asides[name] += 1
                if other != name:
                    self._waits[name] = other
                return True
            if isinstance(found, Blocked):
                ahead = [*((obstacle, name) for obstacle in self._in_the_way(found)), *ahead]
        return False

    def _go(self, step: Step, after: State, found: Next) -> None:
        self.steps.append((step, found.T_base_targets))
        self._state, self._scene = after, found.scene
        self._waits = {item: other for item, other in self._waits.items() if other != step.item}

    def _next(
        self, step: Step, pending: Sequence[str], *, late: bool, awaits: Step | None = None
    ) -> Next | Blocked | Crowded:
        rest = [self._home_of(item) for item in pending]
        again = step.key in self._avoided
        return self._targets.next(step, rest, self._scene, again=again, late=late, awaits=awaits)

    def _home_of(self, item: str) -> Step:
        """The step that takes an item to where it belongs."""
        region = self._problem.regions.get(item)
        beside = (region.name, region.parent) if region else ()
        return Step(item, self._scene.supports[item], self._problem.goal.get(item, TABLE), *beside)

    def _in_the_way(self, blocked: Blocked) -> Sequence[str]:
        """What a step is blocked by and can be moved, at last in other ways to do it. Where there is none, a region
        without room goes with what it is beside; where nothing is known, it may be what stands beside the object."""
        step = blocked.step
        ways = (*blocked.obstacles, *blocked.otherwise)
        movable = [name for name in ways if name in self._problem.graspable]
        parent = [step.parent] if step.region and not blocked.why else []
        return movable or parent or neighbours(step.item, self._scene)

    def _uppermost(self, name: str) -> str:
        """What has to be moved first to move an object: it, or what rests on it."""
        while above := sorted(item for item, support in self._scene.supports.items() if support == name):
            name = above[0]
        return name
