"""PDDL that other tools read: names, poses in comments, the goal of a demonstrated scene."""

import re

import pytest
from scipy.spatial.transform import Rotation
from unified_planning.io import PDDLReader
from unified_planning.shortcuts import get_environment

from stages.planning.symbolic.pddl import goal_pddl, problem_pddl
from stages.planning.symbolic.problem import Problem
from stages.scene.domain import DOMAIN, symbol
from tests.stages.layouts import Layout, breakfast

get_environment().credits_stream = None
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # unified-planning's use of pyparsing.


def test_the_domain_has_the_papers_predicates():
    for predicate in ("exist", "clear", "on", "in", "has", "holding", "handempty"):
        assert f"({predicate}" in DOMAIN


def test_every_type_is_declared_as_strict_parsers_want_it():
    assert "(:requirements :adl :typing)" in DOMAIN
    plain = re.sub(";.*", "", DOMAIN)
    types = re.search(r"\(:types([^)]*)\)", plain)[1]  # pyright: ignore[reportOptionalSubscript]
    above = set(re.findall(r"- (\w+)", types))
    declared = set(re.sub(r"- \w+", "", types).split())
    assert above <= declared | {"object"}
    assert set(re.findall(r"\?\w+ - (\w+)", plain)) <= declared


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("Cup", "cup"),
        ("003_cracker box", "o_003_cracker_box"),
        ("tea-box", "tea-box"),
        ("table", "table"),
        ("", "o_"),
    ],
)
def test_names_become_symbols(name: str, expected: str):
    assert symbol(name) == expected


def test_every_pose_label_is_tied_to_a_pose_in_the_base_frame():
    graph = breakfast().graph()
    text = goal_pddl("breakfast", graph)
    for item in graph.objects:
        line = next(line for line in text.splitlines() if f" goal_{item.name} " in line)
        numbers = [float(word) for word in re.findall(r"-?\d+\.\d+", line)]
        assert numbers[:3] == pytest.approx(item.T_base_object[:3, 3], abs=1e-4)
        R = Rotation.from_quat(numbers[3:]).as_matrix()
        assert pytest.approx(item.T_base_object[:3, :3], abs=1e-3) == R


def test_the_goal_holds_every_assertion_of_the_scene():
    graph = breakfast().graph()
    text = goal_pddl("breakfast", graph)
    for item in graph.assertions:
        assert f"({item.predicate} {' '.join(item.arguments)})" in text


def test_a_goal_is_a_complete_problem():
    layout = Layout().put("cereal_box", 0, 0).put("mug", 0.0, 0.13)
    parsed = PDDLReader().parse_problem_string(DOMAIN, goal_pddl("side by side", layout.graph()))
    assert {str(item) for item in parsed.all_objects} >= {"cereal_box", "mug", "mug_near_cereal_box"}


def test_a_problem_is_read_back_as_it_was_written():
    goal, current = breakfast().graph(), breakfast().put("cup", 0.1, -0.3).graph()
    problem = Problem.between(current, goal, held=frozenset(), graspable=frozenset({"cup"}))
    parsed = PDDLReader().parse_problem_string(DOMAIN, problem_pddl("breakfast", problem, current, goal))
    holds = {str(name): value.is_true() for name, value in parsed.initial_values.items()}
    assert holds["on(cup, table)"]
    assert holds["in(bowl, tray)"]
    assert holds["at(cup, pos_cup)"]
    assert holds["graspable(cup)"]
    assert not holds["graspable(tray)"]
    assert {str(item) for item in parsed.goals[0].args} >= {"in(cup, bowl)", "on(tuna_can, tea_box)", "clear(cup)"}
