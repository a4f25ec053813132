"""Goals that people write by hand: PDDL read as a scene graph, or the line of what cannot be meant."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from typing import Any, cast

import numpy as np
from scipy.spatial.transform import Rotation

from runner.contract import Refused
from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, pose
from stages.messages.scene import Assertion, Predicate, SceneGraph, SceneObject, VirtualObject
from stages.scene import virtual
from stages.scene.catalogue import Catalogue
from stages.scene.domain import DOMAIN, symbol
from stages.scene.relations import TABLE
from stages.scene.stance import Stances, Standing

RELATIONS = ("on", "in", "clear", "exist")
"""What a goal may ask for."""
TYPES = ("item", "region", "label")
"""What its objects may be."""
_POSE = re.compile(r";[ \t]*goal_(\S*)(.*)")
_NUMBERS = re.compile(r"\s+xyz((?:\s+\S+){3})\s+quaternion_xyzw((?:\s+\S+){4})\s*")
_FACT = re.compile(r"\(([^()]*)\)")


@dataclass(frozen=True)
class _Fact:
    """A relation of the goal, and where it stands in the file."""

    predicate: str
    arguments: tuple[str, ...]
    line: int

    def __str__(self) -> str:
        return f"({' '.join([self.predicate, *self.arguments])})"


def scene_of(text: str, catalogue: Catalogue) -> SceneGraph:
    """The scene graph of a goal that is written as a PDDL problem for :data:`~stages.scene.domain.DOMAIN`.

    Its items are the objects, by the names that perception gives: a label of the catalogue, then ``label_2`` and so on.
    Its ``:goal`` has the relations, and comments may have poses; what is beside what is told by those alone. An object
    without a pose stands on the first of the sides on which its kind rests, anywhere. Nobody has looked: the camera is
    said to be where the robot's base is.

    Raises :class:`runner.contract.Refused` naming the line, what stands there and what may.
    """
    text = text.lower()
    items, facts, owners = _parsed(text)
    labels = {item: _label(item, catalogue, text) for item in items}
    names = {TABLE: TABLE} | {item: label + item.removeprefix(symbol(label)) for item, label in labels.items()}
    carriers, poses = _carriers(facts, items), _poses(text, items)
    _refuse_half_told(poses, carriers, text)
    kinds = {item: catalogue[label] for item, label in labels.items()}
    stances = {item: Stances(kind) for item, kind in kinds.items()}
    bottoms = (Standing.at(item, stances[item], T).z_bottom for item, T in poses.items())
    T_base_table = pose(np.eye(3), np.array([0.0, 0.0, min(bottoms, default=0.0)]))
    laid: dict[str, Standing] = {}
    for item, carrier in carriers.items():
        if item in poses:
            laid[item] = Standing.at(item, stances[item], inverse(T_base_table) @ poses[item])
        else:
            upright = Standing.at(item, stances[item], pose(kinds[item].resting[0], np.zeros(3)))
            laid[item] = _centred(upright, laid.get(carrier))
    _refuse_impossible(facts, laid)
    beside = tuple(_region(fact, owners, names, poses) for fact in facts if fact.arguments[0] not in names)
    between = [(fact.predicate, fact.arguments) for fact in facts if fact.arguments[0] in names]
    stated = dict.fromkeys([*(("exist", (item,)) for item in items), *between])
    relations = (
        Assertion(predicate=cast(Predicate, predicate), arguments=tuple(names[one] for one in arguments))
        for predicate, arguments in stated
    )
    return SceneGraph(
        objects=tuple(
            SceneObject(
                name=names[item],
                label=labels[item],
                T_base_object=poses.get(item, T_base_table @ laid[item].T_table_object),
                anywhere=item not in poses,
            )
            for item in items
        ),
        virtual_objects=beside,
        assertions=(*relations, *virtual.assertions(beside)),
        T_base_table=T_base_table,
        T_base_camera=np.eye(4),
        K=np.eye(3),
    )


# --------------------------------------------------------------------------------------------------- what is said


@lru_cache(maxsize=256)
def _parsed(text: str) -> tuple[tuple[str, ...], tuple[_Fact, ...], Mapping[str, str]]:
    """Items, relations of the goal, and what each region is attached to, as a file has them."""
    from unified_planning.io import PDDLReader

    plain = _without_comments(text)
    declared = _declared(plain)
    facts = tuple(_facts(plain, declared))
    try:
        with warnings.catch_warnings():  # unified-planning uses old names of pyparsing.
            warnings.simplefilter("ignore")
            problem: Any = PDDLReader().parse_problem_string(DOMAIN, plain)
    except Exception as error:  # The reader's own, its grammar's, and Python's.
        at = re.search(r"line:? ?(\d+)", str(error))
        line = int(at[1]) if at else max(1, len(text.rstrip().splitlines()))
        there = next(iter(text.splitlines()[line - 1 : line]), "").strip()
        raise _refusal(line, there, f"no PDDL of this domain, {str(error).splitlines()[0]}", _forms(declared)) from None
    parts = list(problem.goals)
    while parts:
        part = parts.pop()
        if part.is_and():
            parts += part.args
        elif not part.is_fluent_exp():
            raise _refusal(_line(plain, ":goal"), str(part), "more than an `and` of relations", _forms(declared))
    items = tuple(one.name for one in problem.all_objects if one.type.name == "item")
    if not items:
        raise _refusal(_line(plain, ":goal"), ":goal", "about no object", "one or more of type item in :objects")
    holds = (exp for exp, value in problem.explicit_initial_values.items() if value.is_true())
    return items, facts, {str(exp.args[1]): str(exp.args[0]) for exp in holds if exp.fluent().name == "has"}


def _declared(plain: str) -> list[str]:
    """Names of ``:objects``, each once and of a type that there is."""
    found = re.search(r"\(\s*:objects\b([^()]*)\)", plain)
    words = found[1].split() if found else []
    after = list(pairwise(["", *words]))
    typed = [word for before, word in after if before == "-"]
    names = [word for before, word in after if "-" not in (before, word)]
    if unknown := next((kind for kind in typed if kind not in TYPES), None):
        raise _refusal(_line(plain, unknown), unknown, "no type of an object", ", ".join(TYPES))
    if words and words[-2:-1] != ["-"]:
        raise _refusal(_line(plain, words[-1]), words[-1], "without a type", f"{words[-1]} - item")
    if twice := next((name for name in names if name == TABLE or names.count(name) > 1), None):
        raise _refusal(_line(plain, twice), twice, "declared more than once", f"each name once, and {TABLE} never")
    return names


def _facts(plain: str, declared: Collection[str]) -> Iterator[_Fact]:
    """Relations of the goal between what is declared."""
    goal = re.search(r"\(\s*:goal\b", plain)
    for found in _FACT.finditer(plain, goal.end() if goal else len(plain)):
        predicate, *arguments = found[1].split() or [""]
        line = _line_at(plain, found.start())
        if predicate == "and":  # Of nothing.
            continue
        if predicate not in RELATIONS:
            raise _refusal(line, found[0], "no relation that a goal may have", _forms(declared))
        if unknown := next((name for name in arguments if name not in (TABLE, *declared)), None):
            raise _refusal(line, unknown, "not among the objects", ", ".join([TABLE, *declared]))
        if predicate in ("on", "in") and arguments[:1] == [TABLE]:
            raise _refusal(line, found[0], f"the {TABLE} rests on nothing", _forms(declared))
        yield _Fact(predicate, tuple(arguments), line)


def _label(item: str, catalogue: Catalogue, text: str) -> str:
    """What kind of object an item is, by its name."""
    labels = {symbol(label): label for label in catalogue.objects}
    further = re.fullmatch(r"(.+)_([2-9]|[1-9]\d+)", item)
    label = labels.get(item) or (labels.get(further[1]) if further else None)
    if label is None:
        valid = f"a label, or label_2, label_3, ... for further ones: {', '.join(labels)}"
        raise _refusal(_line(_without_comments(text), item), item, "no object of the catalogue", valid)
    return label


def _poses(text: str, items: Sequence[str]) -> dict[str, Floats]:
    """T_base_object of each item of which a comment says it."""
    poses: dict[str, Floats] = {}
    for found in _POSE.finditer(text):
        item, T, line, said = found[1], _pose(found[2]), _line_at(text, found.start()), found[0].strip()
        if item not in items or T is None:
            valid = f"; goal_ITEM xyz X Y Z quaternion_xyzw X Y Z W, for each of {', '.join(items)}"
            raise _refusal(line, said, "no pose of an item", valid)
        if item in poses:
            raise _refusal(line, said, f"a second pose of {item}", "one for each item")
        poses[item] = T
    return poses


def _pose(text: str) -> Floats | None:
    """What stands behind an item in the comment that says its pose; None where that is none."""
    found = _NUMBERS.fullmatch(text)
    if found is None:
        return None
    try:
        xyz, quaternion = (np.array(part.split(), np.float64) for part in found.groups())
        T = pose(Rotation.from_quat(quaternion).as_matrix(), xyz)
    except ValueError:  # no number, or no rotation
        return None
    return T if np.isfinite(T).all() else None


# ------------------------------------------------------------------------------------------------- what it means


def _carriers(facts: Sequence[_Fact], items: Sequence[str]) -> dict[str, str]:
    """Item -> what carries it, the table where that is not said; those that carry come first."""
    said: dict[str, _Fact] = {}
    for fact in facts:
        if fact.predicate in ("on", "in") and fact.arguments[0] in items:
            before = said.setdefault(fact.arguments[0], fact)
            if str(before) != str(fact):
                raise _refusal(fact.line, str(fact), f"contradicts {before} on line {before.line}", "one of the two")
    carriers = {item: said[item].arguments[1] if item in said else TABLE for item in items}
    try:
        order = TopologicalSorter({item: {carrier} for item, carrier in carriers.items()}).static_order()
        return {item: carriers[item] for item in order if item != TABLE}
    except CycleError as error:
        circle = [said[item] for item in set(error.args[1])]
        circle.sort(key=lambda fact: fact.line)
        valid = f"all but one of them, so that the last rests on the {TABLE}"
        raise _refusal(circle[-1].line, " ".join(map(str, circle)), "a circle", valid) from None


def _refuse_half_told(poses: Mapping[str, Floats], carriers: Mapping[str, str], text: str) -> None:
    """A pose says where an object is on what carries it only with the pose of that."""
    for item, carrier in carriers.items():
        if item in poses and carrier != TABLE and carrier not in poses:
            valid = f"the pose of {carrier} as well, or of neither"
            raise _refusal(_line(text, f"goal_{item}"), f"goal_{item}", f"without goal_{carrier}", valid)


def _refuse_impossible(facts: Sequence[_Fact], laid: Mapping[str, Standing]) -> None:
    """What no scene can show: something in what is not hollow, or on what is, and something on what is clear."""
    resting = [fact for fact in facts if fact.predicate in ("on", "in") and fact.arguments[0] in laid]
    carried = {fact.arguments[1]: fact for fact in resting}
    for fact in facts:
        first, last = fact.arguments[0], fact.arguments[-1]
        if fact in resting:
            how = "in" if last in laid and laid[last].stance.holds else "on"
            if fact.predicate != how:
                hollow = "hollow" if how == "in" else "not hollow"
                raise _refusal(fact.line, str(fact), f"{last} is {hollow}", f"({how} {first} {last})")
        if fact.predicate == "clear" and first == TABLE:
            raise _refusal(fact.line, str(fact), f"the {TABLE} carries everything", ", ".join(laid))
        if fact.predicate == "clear" and first in carried:
            other = carried[first]
            raise _refusal(fact.line, str(fact), f"contradicts {other} on line {other.line}", "one of the two")


def _centred(item: Standing, carrier: Standing | None) -> Standing:
    """An object in the middle of what carries it and turned like that; on the table anywhere."""
    T = (carrier or item).T_table_stance.copy()
    if carrier is not None:
        surface = carrier.floor if carrier.stance.cavity else carrier.top
        T[:2, 3] += regions.centroid(surface) - regions.centroid(regions.moved(item.stance.bottom, T))
    height = carrier.rest_height(regions.moved(item.stance.bottom, T)) if carrier else 0.0
    T[2, 3] = height - item.stance.low
    return replace(item, T_table_stance=T)


def _region(
    fact: _Fact, owners: Mapping[str, str], names: Mapping[str, str], poses: Mapping[str, Floats]
) -> VirtualObject:
    """Where an object belongs beside another, by their poses."""
    region, child = fact.arguments
    parent = owners.get(region, "")
    if parent not in poses or child not in poses:
        valid = f"poses of both in comments, and (has ITEM {region}) in :init"
        raise _refusal(fact.line, str(fact), "says not where that is beside which item", valid)
    T_parent_virtual = inverse(poses[parent]) @ poses[child]
    return virtual.region(names[parent], names[child], T_parent_virtual, virtual.RADIUS)


# ---------------------------------------------------------------------------------------------------- what is not


def _refusal(line: int, there: str, why: str, valid: str) -> Refused:
    return Refused(f"line {line}: {there!r}: {why}; valid: {valid}")


def _forms(declared: Collection[str]) -> str:
    return f"(on A B), (in A B), (clear A), (exist A) of {', '.join([TABLE, *declared])}"


def _without_comments(text: str) -> str:
    """The same in the same places."""
    return re.sub(";.*", lambda comment: " " * len(comment[0]), text)


def _line(text: str, word: str) -> int:
    """The first line with a word."""
    found = re.search(rf"(?<![\w-]){re.escape(word)}(?![\w-])", text)
    return _line_at(text, found.start() if found else 0)


def _line_at(text: str, position: int) -> int:
    return text.count("\n", 0, position) + 1
