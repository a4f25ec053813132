"""Finding the order of transfers: breadth-first search, or any engine of unified-planning over the same PDDL."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

from runner.contract import Refused
from stages.planning.symbolic.pddl import fact
from stages.planning.symbolic.problem import TABLE, Problem
from stages.scene.domain import DOMAIN, symbol

BFS = "bfs"
"""The engine that is always there: :func:`breadth_first`."""
State = tuple[tuple[str, ...], frozenset[str], frozenset[tuple[str, str, str]], frozenset[str]]
"""Support of each item, children in their region, obstructions that remain, items that show the wrong side."""


@dataclass(frozen=True)
class Step:
    """One item picked and placed."""

    item: str
    source: str
    destination: str
    region: str = ""
    """The region in which the item is placed; empty for anywhere on (or in) the destination."""
    parent: str = ""
    """What the region belongs to."""

    @property
    def key(self) -> str:
        """As :attr:`stages.messages.task.Transfer.key`."""
        return f"{self.item}: {self.source} -> {self.destination}"


@dataclass(frozen=True)
class Solution:
    """The steps of a plan, or None where none exists, and how many states were expanded."""

    steps: tuple[Step, ...] | None
    expanded: int


def actions(step: Step, problem: Problem) -> tuple[str, str]:
    """The pick and the place of a step as ground PDDL actions of :data:`~stages.scene.domain.DOMAIN`."""
    pick = fact("pick-from" if step.source in problem.concave else "pick", step.item, step.source)
    if step.region:
        return pick, fact("place-at-region", step.item, step.region, step.parent, step.destination)
    return pick, fact("place-in" if step.destination in problem.concave else "place-on", step.item, step.destination)


def breadth_first(problem: Problem, *, reluctant: Collection[str] = ()) -> Solution:
    """The shortest plan. Among equally short ones it moves ``reluctant`` items as late as it can.

    A state's moves are pick-and-place pairs, since nothing else can follow a pick. Where one of them puts an item
    where it finally belongs, it is the only one followed: that item has to make that move sometime, and making it
    now is in nobody's way.
    """
    search = Moves(problem, sorted(problem.items, key=lambda item: item in reluctant))
    start = search.start
    parents: dict[State, tuple[State, Step] | None] = {start: None}
    frontier, expanded = [start], 0
    while frontier:
        following: list[State] = []
        for state in frontier:
            if search.reached(state):
                return Solution(_path(parents, state), expanded)
            expanded += 1
            for step, successor in search.worthwhile(state):
                if successor not in parents:
                    parents[successor] = (state, step)
                    following.append(successor)
        frontier = following
    return Solution(None, expanded)


def fewest(problem: Problem) -> int:
    """Transfers that every plan needs: as many as the shortest has while geometry forbids none; 0 where none has."""
    return len(breadth_first(problem).steps or ())


def _path(parents: dict[State, tuple[State, Step] | None], state: State) -> tuple[Step, ...]:
    steps: list[Step] = []
    while (came := parents[state]) is not None:
        state, step = came
        steps.append(step)
    return tuple(reversed(steps))


class Moves:
    """What follows from a state."""

    def __init__(self, problem: Problem, order: Sequence[str]) -> None:
        """``order``: of the items, as moves are listed."""
        self._problem = problem
        self._movable = [item for item in order if item in problem.graspable]
        self._index = {item: i for i, item in enumerate(problem.items)}
        self._roomy = problem.roomy
        self._taken = problem.clear | (frozenset(problem.goal.values()) - problem.roomy)
        """What can carry nothing but what the goal has there."""

    def reached(self, state: State) -> bool:
        """Whether the goal holds."""
        supports, held, _, turned = state
        problem = self._problem
        placed = all(supports[self._index[item]] == support for item, support in problem.goal.items())
        return placed and held >= problem.regions.keys() and problem.clear.isdisjoint(supports) and not turned

    @property
    def start(self) -> State:
        """The state in which the problem begins."""
        problem = self._problem
        return tuple(problem.supports.values()), problem.held, problem.obstructions, problem.turned

    def worthwhile(self, state: State) -> list[tuple[Step, State]]:
        """The moves worth following: the first that is final, or else all."""
        found: list[tuple[Step, State]] = []
        for item in self._free(state):
            for step, successor in self.of(item, state):
                if self._settled(item, successor):
                    return [(step, successor)]
                found.append((step, successor))
        return found

    def final(self, state: State) -> list[tuple[Step, State]]:
        """All moves after which an item is where it belongs for good."""
        moves = (move for item in self._free(state) for move in self.of(item, state))
        return [move for move in moves if self._settled(move[0].item, move[1])]

    def aside(self, item: str, state: State) -> tuple[Step, State]:
        """The move of one item to anywhere on the table, where it shows any side."""
        moves = (move for move in self.of(item, state) if move[0].destination == TABLE and not move[0].region)
        step, (supports, held, obstructions, _) = next(moves)
        return step, (supports, held, obstructions, state[3])

    def pending(self, state: State) -> list[str]:
        """Items of the goal that cannot stay, and what may not stay on one."""
        supports, goal = state[0], self._problem.goal
        away = [item for item in self._movable if not self._settled(item, state)]
        return [item for item in away if item in goal or supports[self._index[item]] in self._problem.clear]

    def _free(self, state: State) -> list[str]:
        """Items on which nothing rests and that cannot stay."""
        return [item for item in self._movable if item not in state[0] and not self._settled(item, state)]

    def of(self, item: str, state: State) -> Iterator[tuple[Step, State]]:
        """The moves of one item."""
        supports, held, obstructions, turned = state
        at, regions = self._index[item], self._problem.regions
        held -= {child for child in held if child == item or regions[child].parent == item}
        obstructions = frozenset(entry for entry in obstructions if entry[0] != item)
        turned -= {item}
        lifted = (*supports[:at], "", *supports[at + 1 :])
        for destination in self._problem.destinations(item):
            if destination not in self._roomy and destination in lifted:
                continue
            if any(entry[1:] == (item, destination) for entry in obstructions):
                continue
            placed = (*supports[:at], destination, *supports[at + 1 :])
            if self._region_on(item, destination, lifted) and not any(
                entry[1:] == (item, regions[item].name) for entry in obstructions
            ):
                step = Step(item, supports[at], destination, regions[item].name, regions[item].parent)
                yield step, (placed, held | {item}, obstructions, turned)
            yield Step(item, supports[at], destination), (placed, held, obstructions, turned)

    def _region_on(self, item: str, destination: str, supports: tuple[str, ...]) -> bool:
        """Whether the item's region is on this support: where the goal has it, if the region's parent is there."""
        region = self._problem.regions.get(item)
        here = destination == self._problem.goal.get(item)
        return region is not None and here and supports[self._index[region.parent]] == destination

    def _settled(self, item: str, state: State) -> bool:
        """Whether an item is where it belongs and nothing below or beside it will have to move."""
        return item in self._problem.goal and self._stays(item, state)

    def _stays(self, item: str, state: State) -> bool:
        """Whether neither an item nor anything below or beside it will have to move. It may be anywhere where the goal
        does not say what carries it."""
        if item == TABLE:
            return True
        supports, held, obstructions, turned = state
        goal, support = self._problem.goal, supports[self._index[item]]
        if support != goal.get(item) and (item in goal or support in self._taken):
            return False
        if item in turned or any(entry[0] == item for entry in obstructions):
            return False
        region = self._problem.regions.get(item)
        beside = region is None or (item in held and self._stays(region.parent, state))
        return beside and self._stays(support, state)


def check_engine(engine: str) -> None:
    """Raises :class:`runner.contract.Refused` for what is neither ``bfs`` nor an installed planner."""
    if engine == BFS:
        return
    from unified_planning.shortcuts import get_environment

    factory = get_environment().factory
    known = [BFS, *(name for name in factory.engines if factory.engine(name).is_oneshot_planner())]
    if engine not in known:
        raise Refused(
            f"planner.engine={engine!r}: known are {', '.join(known)} (unified-planning finds what is installed)"
        )


def with_engine(engine: str, problem_pddl: str, problem: Problem) -> Solution:
    """A plan by an installed engine of unified-planning, from the PDDL alone."""
    from unified_planning.engines import PlanGenerationResultStatus as Status
    from unified_planning.io import PDDLReader
    from unified_planning.shortcuts import OneshotPlanner, get_environment

    get_environment().credits_stream = None
    with warnings.catch_warnings():
        # unified-planning uses old names of pyparsing, and warns of engines that do not say whether they are complete.
        warnings.simplefilter("ignore")
        parsed = PDDLReader().parse_problem_string(DOMAIN, problem_pddl)
        with OneshotPlanner(name=engine) as planner:
            result = planner.solve(parsed)  # pyright: ignore[reportAttributeAccessIssue]
    if result.status is Status.UNSUPPORTED_PROBLEM:
        raise Refused(f"planner.engine={engine!r} does not read this PDDL (:adl); {BFS} does")
    if result.status not in (Status.SOLVED_SATISFICING, Status.SOLVED_OPTIMALLY):
        return Solution(None, 0)
    ground = [(item.action.name, *map(str, item.actual_parameters)) for item in result.plan.actions]
    return Solution(tuple(_steps(ground, problem)), 0)


def _steps(ground: Sequence[tuple[str, ...]], problem: Problem) -> Iterator[Step]:
    """Pairs of ground actions, a pick and the place that follows it, as steps."""
    names = {symbol(name): name for name in (TABLE, *problem.items)}
    regions = {symbol(region.name): region for region in problem.regions.values()}
    for (_, item, source), (_, _, *where) in zip(ground[::2], ground[1::2], strict=True):
        region = regions[where[0]] if len(where) == 3 else None
        beside = (region.name, region.parent) if region else ()
        yield Step(names[item], names[source], names[where[-1]], *beside)


def continued(ground: Sequence[str], problem: Problem) -> tuple[Step, ...]:
    """The steps of a plan's remaining actions where these lead to the goal from here, else none."""
    try:
        steps = tuple(_steps([tuple(action.strip("()").split()) for action in ground], problem))
    except KeyError:  # An object is gone, or a region is told otherwise.
        return ()
    return steps if leads_home(steps, problem) else ()


def leads_home(steps: Iterable[Step], problem: Problem) -> bool:
    """Whether the steps can be done one after the other, and the goal holds then."""
    moves = Moves(problem, problem.items)
    state = moves.start
    for step in steps:
        after = dict(moves.of(step.item, state)) if step.item not in state[0] else {}
        if step not in after:
            return False
        state = after[step]
    return moves.reached(state)
