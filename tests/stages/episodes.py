"""Scenes and messages of small episodes, for tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from runner.contract import Level
from stages.messages import Assertion, Outcome, Plan, SceneGraph, Transfer, VirtualObject
from stages.messages.scene import SceneObject
from stages.scene.catalogue import BUILT_IN

CATALOGUE = BUILT_IN
CONCAVE = {"tray", "bowl", "cup", "mug"}
K = np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]])
TABLE_HEIGHT = 0.7


@dataclass
class Recorded:
    """A context that keeps what a stage logs."""

    directory: Path = Path("unused")
    time_ns: int = 0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    lines: list[str] = field(default_factory=list[str])

    def log(self, text: str, *, level: Level = "info") -> None:
        self.lines.append(text)


def translation(x: float, y: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def scene(supporters: Mapping[str, str], *, beside: Mapping[str, str] | None = None) -> SceneGraph:
    """Objects by what supports each; ``beside`` maps a child to the parent it stands next to."""
    poses = {
        name: translation(0.7, 0.12 * k, TABLE_HEIGHT + 0.05 * _depth(name, supporters))
        for k, name in enumerate(supporters)
    }
    assertions = [Assertion(predicate="exist", arguments=(name,)) for name in supporters]
    for name, below in supporters.items():
        predicate = "in" if below in CONCAVE else "on"
        assertions.append(Assertion(predicate=predicate, arguments=(name, below)))
    virtual = tuple(_region(child, parent, poses) for child, parent in (beside or {}).items())
    for item in virtual:
        assertions.append(Assertion(predicate="has", arguments=(item.parent, item.name)))
        assertions.append(Assertion(predicate="in", arguments=(item.name, item.child)))
    return SceneGraph(
        objects=tuple(SceneObject(name=name, label=name, T_base_object=T) for name, T in poses.items()),
        virtual_objects=virtual,
        assertions=tuple(assertions),
        T_base_table=translation(0.7, 0, TABLE_HEIGHT),
        T_base_camera=translation(0.1, 0, 1.4),
        K=K,
    )


def _depth(name: str, supporters: Mapping[str, str]) -> int:
    below = supporters.get(name, "table")
    return 0 if below == "table" else 1 + _depth(below, supporters)


def _region(child: str, parent: str, poses: Mapping[str, np.ndarray]) -> VirtualObject:
    return VirtualObject(
        name=f"{child}_near_{parent}",
        parent=parent,
        child=child,
        T_parent_virtual=np.linalg.inv(poses[parent]) @ poses[child],
        radius=0.03,
    )


def transfer(name: str, source: str, destination: str) -> Transfer:
    return Transfer(
        object=name,
        source=source,
        destination=destination,
        T_base_targets=np.eye(4)[None],
        pick=f"(pick {name} {source})",
        place=f"(place {name} {destination})",
    )


def plan(*transfers: Transfer, status: str = "solved", reason: str = "") -> Plan:
    return Plan(
        status=status,  # type: ignore[arg-type]
        reason=reason,
        transfers=transfers,
        actions=tuple(action for item in transfers for action in (item.pick, item.place)),
        domain_pddl="(define (domain tabletop))",
        problem_pddl="(define (problem breakfast) (:domain tabletop))",
        expanded=7,
    )


def outcome(number: int, item: Transfer, *, failed_stage: str = "", reason: str = "") -> Outcome:
    return Outcome(
        number=number,
        object=item.object,
        destination=item.destination,
        success=not failed_stage,
        failed_stage=failed_stage,  # type: ignore[arg-type]
        reason=reason,
        grasp="top 1",
        attempts=1,
        robot_seconds=12.25,
        planning_seconds=0.5,
    )
