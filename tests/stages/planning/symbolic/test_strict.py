"""What other planners make of the files: they take them and refuse what nobody declared; Fast Downward solves them."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from unified_planning.io import PDDLReader
from unified_planning.shortcuts import get_environment

from stages.messages import SceneGraph
from stages.planning.symbolic.pddl import goal_pddl, problem_pddl
from stages.planning.symbolic.problem import Problem
from stages.planning.symbolic.search import breadth_first, check_engine, continued, with_engine
from stages.scene.domain import DOMAIN
from stages.scene.written import scene_of
from tests.stages.layouts import breakfast, catalogue

get_environment().credits_stream = None
solved = pytest.mark.skipif(find_spec("up_fast_downward") is None, reason="no build of Fast Downward for this machine")

BY_HAND = """\
(define (problem by-hand)
  (:domain scene)
  (:objects tray bowl cup tea_box tuna_can - item)
  (:init)
  (:goal (and (in cup tray) (on tuna_can table) (clear tea_box))))
"""
NOW = breakfast().put("cup", 0.1, -0.3).put("milk_carton", 0.0, 0.45).graph()


def between(goal: SceneGraph) -> Problem:
    regions = frozenset(item.child for item in goal.virtual_objects)
    return Problem.between(NOW, goal, held=regions, graspable=frozenset({"cup", "tuna_can", "tea_box", "soup_can"}))


def task(goal: SceneGraph) -> str:
    return problem_pddl("task", between(goal), NOW, goal)


TAUGHT, WRITTEN = breakfast().graph(), scene_of(BY_HAND, catalogue())
FILES = {"taught": goal_pddl("taught", TAUGHT), "by hand": BY_HAND, "to taught": task(TAUGHT), "to hand": task(WRITTEN)}


def files(folder: Path, domain: str, problem: str) -> tuple[Path, Path]:
    paths = folder / "domain.pddl", folder / "problem.pddl"
    for path, text in zip(paths, (domain, problem), strict=True):
        path.write_text(text)
    return paths


def translated(folder: Path, domain: str, problem: str) -> subprocess.CompletedProcess[str]:
    """What the translator of Fast Downward says of two files."""
    command = (sys.executable, "-m", "fast_downward.translate", "--sas-file", folder / "output.sas")
    paths = files(folder, domain, problem)
    return subprocess.run((*command, *paths), capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("name", FILES)
def test_a_strict_reader_takes_every_file(name: str, tmp_path: Path) -> None:
    done = translated(tmp_path, DOMAIN, FILES[name])
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert "warning" not in done.stdout.lower()
    assert (tmp_path / "output.sas").read_text().startswith("begin_version")


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("(on ?i - item ?s - support)", "(lies ?i - item ?s - support)", "on"),
        ("- item\n", "- gadget\n", "gadget"),
        ("(in cup bowl)", "(in fork bowl)", "fork"),
    ],
)
def test_what_nobody_declared_is_refused(old: str, new: str, named: str, tmp_path: Path) -> None:
    problem = FILES["to taught"]
    assert old in DOMAIN + problem
    done = translated(tmp_path, DOMAIN.replace(old, new), problem.replace(old, new))
    assert done.returncode != 0 and named in done.stdout + done.stderr


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # unified-planning's use of pyparsing.
@pytest.mark.parametrize("typed", ["(graspable ?i - item)", "(?i - item ?s - item)", "(?l - label)", "table - support"])
def test_a_type_of_the_domain_that_nobody_declared_is_refused(typed: str) -> None:
    """By unified-planning: Fast Downward finds no object of such a type, and goes on."""
    assert typed in DOMAIN
    PDDLReader().parse_problem_string(DOMAIN)
    with pytest.raises((SyntaxError, KeyError), match="gadget"):
        PDDLReader().parse_problem_string(DOMAIN.replace(typed, re.sub(r"- \w+", "- gadget", typed, count=1)))


@solved
@pytest.mark.parametrize("goal", [TAUGHT, WRITTEN], ids=["taught", "by hand"])
def test_fast_downward_solves_what_the_files_ask_for(goal: SceneGraph, tmp_path: Path) -> None:
    import up_fast_downward

    driver = Path(up_fast_downward.__file__).parent / "downward" / "fast-downward.py"
    plan = tmp_path / "plan"
    paths = files(tmp_path, DOMAIN, task(goal))
    command = (sys.executable, driver, "--plan-file", plan, "--alias", "lama-first", *paths)
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    actions = re.findall(r"^\(.*\)$", plan.read_text(), re.MULTILINE)
    assert continued(actions, between(goal))


@solved
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # unified-planning's use of pyparsing.
def test_the_planner_may_search_with_fast_downward() -> None:
    check_engine("fast-downward")
    found = with_engine("fast-downward", task(WRITTEN), between(WRITTEN)).steps
    shortest = breadth_first(between(WRITTEN)).steps
    assert found and shortest and {step.key for step in found} >= {step.key for step in shortest}
