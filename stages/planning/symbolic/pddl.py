"""Scenes and tasks as PDDL that any planner reads; every pose label is tied to a pose in the robot's base frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from stages.geometry.arrays import Floats
from stages.messages.scene import SceneGraph
from stages.planning.symbolic.problem import TABLE, Problem
from stages.scene.domain import symbol


def fact(predicate: str, *names: str) -> str:
    """``(predicate name ...)``."""
    return f"({' '.join([predicate, *map(symbol, names)])})"


def pose_comments(scene: SceneGraph, prefix: str) -> list[str]:
    """One comment for each object that has a place: its pose label and the pose in the base frame."""
    placed = (item for item in scene.objects if not item.anywhere)
    return [f"; {prefix + symbol(item.name):24} {_pose(item.T_base_object)}" for item in placed]


def _pose(T: Floats) -> str:
    position = " ".join(f"{value:.4f}" for value in T[:3, 3])
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True) + np.zeros(4)
    return f"xyz {position} quaternion_xyzw {x:.4f} {y:.4f} {z:.4f} {w:.4f}"


def goal_pddl(name: str, scene: SceneGraph) -> str:
    """A demonstrated scene as a complete PDDL problem for the domain, solved already: start and goal are the scene.

    Put another scene's facts in its ``:init``, and it is the task of restoring the demonstrated one.
    """
    children = frozenset(item.child for item in scene.virtual_objects)
    problem = Problem.between(scene, scene, held=children, graspable=frozenset())
    return problem_pddl(name, problem, scene, scene)


def problem_pddl(name: str, problem: Problem, current: SceneGraph, goal: SceneGraph) -> str:
    """The task as a PDDL problem for :data:`~stages.scene.domain.DOMAIN`."""
    return "\n".join(
        [
            f"; From the scene {current.name!r} to the goal {name!r}: poses in the robot's base frame, metres.",
            *pose_comments(current, "pos_"),
            "; and in the goal scene",
            *pose_comments(goal, "goal_"),
            f"(define (problem {symbol(name)})",
            "  (:domain scene)",
            *_block("objects", _typed(problem.items, goal)),
            *_block("init", _init(problem, goal)),
            *_block("goal", ["(and", *(f"  {line}" for line in _goal(problem)), ")"]),
            ")",
            "",
        ]
    )


def _block(name: str, lines: Iterable[str]) -> list[str]:
    return [f"  (:{name}", *(f"    {line}" for line in lines), "  )"]


def _typed(items: Sequence[str], goal: SceneGraph) -> list[str]:
    regions = [item.name for item in goal.virtual_objects]
    lists = {"item": items, "region": regions, "label": [f"pos_{symbol(item)}" for item in items]}
    return [f"{' '.join(map(symbol, names))} - {kind}" for kind, names in lists.items() if names]


def _init(problem: Problem, goal: SceneGraph) -> list[str]:
    occupied = set(problem.supports.values())
    regions = problem.regions.values()
    return [
        "(handempty)",
        *(fact("exist", item) for item in problem.items),
        *(fact("at", item, f"pos_{symbol(item)}") for item in problem.items),
        *(fact("in" if s in problem.concave else "on", item, s) for item, s in problem.supports.items()),
        *(fact("clear", item) for item in problem.items if item not in occupied),
        *(fact("graspable", item) for item in problem.items if item in problem.graspable),
        *(fact("concave", item) for item in problem.items if item in problem.concave),
        *(fact("roomy", item) for item in (TABLE, *problem.items) if item in problem.roomy),
        *(fact("may-rest", item, s) for item in problem.items for s in problem.destinations(item)),
        *(fact("has", region.parent, region.name) for region in regions),
        *(fact("belongs", region.child, region.name) for region in regions),
        *(fact("in", region.name, region.child) for region in regions if region.child in problem.held),
        *(fact("turned", item) for item in sorted(problem.turned)),
        *(fact("obstructs", *names) for names in sorted(problem.obstructions)),
    ]


def _goal(problem: Problem) -> list[str]:
    return [
        *(fact("in" if s in problem.concave else "on", item, s) for item, s in problem.goal.items()),
        *(fact("clear", item) for item in sorted(problem.clear)),
        *(fact("in", region.name, region.child) for region in problem.regions.values()),
        *(f"(not {fact('turned', item)})" for item in sorted(problem.faced | problem.turned)),
    ]
