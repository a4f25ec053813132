"""Breadth-first search against known optima and exhaustive search, and unified-planning's validator."""

from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from unified_planning.engines import (
    Engine,
    PlanGenerationResult,
    PlanGenerationResultStatus,
    ValidationResultStatus,
)
from unified_planning.engines.mixins import OneshotPlannerMixin
from unified_planning.io import PDDLReader
from unified_planning.model import ProblemKind
from unified_planning.shortcuts import PlanValidator, get_environment

from runner.contract import Refused
from stages.messages import SceneGraph, VirtualObject
from stages.messages.scene import SceneObject
from stages.planning.symbolic.pddl import problem_pddl
from stages.planning.symbolic.problem import Problem, VirtualRegion
from stages.planning.symbolic.search import Moves, Solution, actions, breadth_first, check_engine, with_engine
from stages.scene.domain import DOMAIN

get_environment().credits_stream = None
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # unified-planning's use of pyparsing.


def problem(supports: dict[str, str], goal: dict[str, str], **more: object) -> Problem:
    defaults: dict[str, object] = {
        "clear": frozenset(),
        "concave": frozenset(),
        "graspable": frozenset(supports),
        "regions": {},
        "held": frozenset(),
    }
    return Problem(supports=supports, goal=goal, **{**defaults, **more})  # type: ignore[arg-type]


def tower(*names: str) -> dict[str, str]:
    """Objects on each other, the first on the table."""
    return dict(zip(names, ("table", *names), strict=False))


def steps(solution: Solution) -> list[str]:
    assert solution.steps is not None
    return [f"{step.item} -> {step.region or step.destination}" for step in solution.steps]


def scene(names: list[str], regions: dict[str, VirtualRegion]) -> SceneGraph:
    """A scene graph with the objects' names; poses do not matter here."""
    objects = tuple(SceneObject(name=name, label=name, T_base_object=np.eye(4)) for name in names)
    virtual = tuple(
        VirtualObject(name=r.name, parent=r.parent, child=r.child, T_parent_virtual=np.eye(4), radius=0.04)
        for r in regions.values()
    )
    return SceneGraph(
        objects=objects,
        virtual_objects=virtual,
        assertions=(),
        T_base_table=np.eye(4),
        T_base_camera=None,
        K=np.eye(3),
    )


def text_of(task: Problem) -> str:
    graph = scene(list(task.supports), dict(task.regions))
    return problem_pddl("task", task, graph, graph)


def valid(task: Problem, plan: list[str]) -> bool:
    reader = PDDLReader()
    parsed = reader.parse_problem_string(DOMAIN, text_of(task))
    with PlanValidator(problem_kind=parsed.kind) as validator:
        result = validator.validate(parsed, reader.parse_plan_string(parsed, "\n".join(plan)))
    return result.status is ValidationResultStatus.VALID


def found_actions(task: Problem) -> list[str]:
    found = breadth_first(task).steps
    assert found is not None
    return [action for step in found for action in actions(step, task)]


@pytest.mark.parametrize("height", [2, 3, 5, 8, 12])
def test_reversing_a_tower_moves_each_object_once(height: int):
    names = [f"o{k}" for k in range(height)]
    solution = breadth_first(problem(tower(*names), tower(*reversed(names))))
    assert solution.steps is not None
    assert len(solution.steps) == height
    assert solution.expanded == height


def test_three_of_twelve_loose_objects_are_stacked_in_two_moves():
    names = [f"o{k}" for k in range(12)]
    task = problem(dict.fromkeys(names, "table"), {"o0": "o1", "o1": "o2"})
    assert steps(breadth_first(task)) == ["o1 -> o2", "o0 -> o1"]


def test_the_sussman_anomaly_takes_three_moves():
    task = problem({"a": "table", "b": "table", "c": "a"}, tower("c", "b", "a"))
    assert steps(breadth_first(task)) == ["c -> table", "b -> c", "a -> b"]


def test_nothing_to_do_takes_no_move():
    assert steps(breadth_first(problem(tower("a", "b"), tower("a", "b")))) == []


def test_a_tray_takes_several_objects_and_a_cup_is_emptied():
    task = problem(
        {"tray": "table", "cup": "table", "egg": "cup", "can": "table"},
        {"tray": "table", "cup": "tray", "egg": "tray", "can": "tray"},
        concave=frozenset({"tray", "cup"}),
        graspable=frozenset({"cup", "egg", "can"}),
        clear=frozenset({"cup"}),
    )
    assert sorted(steps(breadth_first(task))) == ["can -> tray", "cup -> tray", "egg -> tray"]
    assert valid(task, found_actions(task))


def test_what_shows_another_side_is_picked_once_and_moved_when_its_turn_comes():
    supports = {"tray": "table", "box": "tray", "cup": "box"}
    task = problem(
        supports,
        {"box": "tray", "cup": "box"},
        concave=frozenset({"tray"}),
        graspable=frozenset({"box", "cup"}),
        faced=frozenset({"box", "cup"}),
        turned=frozenset({"box"}),
    )
    assert not task.satisfied()
    assert steps(breadth_first(task)) == ["cup -> table", "box -> tray", "cup -> box"]
    assert valid(task, found_actions(task)) and not valid(task, [])


REGION = VirtualRegion("can_near_box", "box", "can")
SIDE_BY_SIDE = problem(
    {"tray": "table", "can": "table", "box": "table"},
    {"tray": "table", "can": "tray", "box": "tray"},
    concave=frozenset({"tray"}),
    graspable=frozenset({"can", "box"}),
    regions={"can": REGION},
)


def test_a_child_comes_into_its_region_after_the_parent_is_placed():
    assert steps(breadth_first(SIDE_BY_SIDE)) == ["box -> tray", "can -> can_near_box"]
    assert valid(SIDE_BY_SIDE, found_actions(SIDE_BY_SIDE))


def test_a_region_is_lost_when_its_parent_moves():
    task = problem(
        SIDE_BY_SIDE.supports | {"can": "tray"},
        SIDE_BY_SIDE.goal,
        concave=SIDE_BY_SIDE.concave,
        graspable=SIDE_BY_SIDE.graspable,
        regions={"can": REGION},
        held=frozenset({"can"}),
    )
    assert steps(breadth_first(task)) == ["box -> tray", "can -> can_near_box"]
    assert valid(task, found_actions(task))
    assert not valid(task, ["(pick box table)", "(place-in box tray)"])


BESIDE = {"bowl": VirtualRegion("bowl_near_tray", "tray", "bowl")}


@pytest.mark.parametrize(
    ("more", "stays"),
    [
        ({}, True),
        ({"goal": {"cup": "bowl", "tray": "table"}}, True),
        ({"goal": {"cup": "bowl", "tray": "box"}}, False),
        ({"goal": {"cup": "bowl", "box": "tray"}}, False),
        ({"goal": {"cup": "bowl", "box": "tray"}, "concave": frozenset({"tray"})}, True),
        ({"clear": frozenset({"tray"})}, False),
        ({"turned": frozenset({"bowl"})}, False),
        ({"obstructions": frozenset({("bowl", "box", "table")})}, False),
        ({"regions": BESIDE}, False),
        ({"regions": BESIDE, "held": frozenset({"bowl"})}, True),
    ],
)
def test_what_may_be_anywhere_carries_what_belongs_on_it_unless_it_has_to_move(more: dict[str, object], stays: bool):
    supports = {"tray": "table", "bowl": "tray", "cup": "table", "box": "table"}
    task = problem(supports, **{"goal": {"cup": "bowl"}, **more})  # type: ignore[arg-type]
    moves = Moves(task, task.items)
    assert ("cup: table -> bowl" in {step.key for step, _ in moves.final(moves.start)}) == stays


def test_an_obstacle_is_moved_first():
    task = problem({"a": "table", "b": "table", "c": "table"}, {"a": "b"}, obstructions=frozenset({("c", "a", "b")}))
    assert steps(breadth_first(task)) == ["c -> table", "a -> b"]
    assert valid(task, found_actions(task))


def test_reluctant_objects_come_last():
    names = ["a", "b", "tray"]
    task = problem(dict.fromkeys(names, "table"), {"a": "tray", "b": "tray"}, concave=frozenset({"tray"}))
    assert steps(breadth_first(task)) == ["a -> tray", "b -> tray"]
    assert steps(breadth_first(task, reluctant={"a"})) == ["b -> tray", "a -> tray"]


def test_without_a_grasp_there_is_no_plan():
    task = problem(tower("a", "b"), tower("b", "a"), graspable=frozenset({"a"}))
    assert breadth_first(task).steps is None


def exhaustive(task: Problem) -> int | None:
    """Length of the shortest plan by plain breadth-first search over every move onto anything; convex items only."""
    names = list(task.supports)
    queue = deque([(tuple(task.supports.values()), 0)])
    seen = {queue[0][0]}
    while queue:
        state, moves = queue.popleft()
        if all(state[names.index(name)] == support for name, support in task.goal.items()):
            return moves
        for successor in _every_move(state, names):
            if successor not in seen:
                seen.add(successor)
                queue.append((successor, moves + 1))
    return None


def _every_move(state: tuple[str, ...], names: list[str]) -> Iterator[tuple[str, ...]]:
    clear = [name for name in names if name not in state]
    for item in clear:
        for support in ["table", *clear]:
            if support != item:
                yield tuple(support if name == item else old for name, old in zip(names, state, strict=True))


@st.composite
def towers(draw: st.DrawFn) -> dict[str, str]:
    """A random arrangement of five blocks."""
    order = draw(st.permutations(list("abcde")))
    cuts = draw(st.lists(st.booleans(), min_size=5, max_size=5))
    supports: dict[str, str] = {}
    below = "table"
    for name, cut in zip(order, cuts, strict=True):
        supports[name] = "table" if cut else below
        below = name
    return {name: supports[name] for name in "abcde"}


@given(towers(), towers(), st.sets(st.sampled_from("abcde"), min_size=1))
@settings(max_examples=60)
def test_plans_are_as_short_as_exhaustive_search_finds(start: dict[str, str], end: dict[str, str], named: set[str]):
    goal = {name: support for name, support in end.items() if name in named}
    solution = breadth_first(problem(start, goal))
    assert solution.steps is not None
    assert len(solution.steps) == exhaustive(problem(start, goal))


@given(towers(), towers())
@settings(max_examples=10)
def test_plans_are_valid_in_pddl(start: dict[str, str], end: dict[str, str]):
    task = problem(start, end)
    assert valid(task, found_actions(task))


def test_an_unknown_engine_is_refused_with_the_known_ones():
    with pytest.raises(Refused, match=r"planner\.engine='warp': known are bfs"):
        check_engine("warp")
    check_engine("bfs")


class Known(Engine, OneshotPlannerMixin):
    """A unified-planning engine with one answer."""

    plan = "(pick box table)\n(place-in box tray)\n(pick can table)\n(place-at-region can can_near_box box tray)"

    def __init__(self) -> None:
        Engine.__init__(self)
        OneshotPlannerMixin.__init__(self)

    @property
    def name(self) -> str:
        return "known"

    @staticmethod
    def supports(problem_kind: ProblemKind) -> bool:
        return True

    @staticmethod
    def supported_kind() -> ProblemKind:
        return ProblemKind()

    def _solve(self, problem: Any, *_: Any, **__: Any) -> PlanGenerationResult:
        plan = PDDLReader().parse_plan_string(problem, self.plan)
        return PlanGenerationResult(PlanGenerationResultStatus.SOLVED_SATISFICING, plan, self.name)


def test_any_engine_of_unified_planning_can_be_named():
    get_environment().factory.add_engine("known", __name__, "Known")
    check_engine("known")
    assert with_engine("known", text_of(SIDE_BY_SIDE), SIDE_BY_SIDE).steps == breadth_first(SIDE_BY_SIDE).steps
