"""Names for the objects of a scene, where a label may occur more than once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, permutations, product

import numpy as np
from scipy.optimize import linear_sum_assignment

from stages.geometry.arrays import Floats

_STAYED = 0.1
"""Metres within which an object that nobody took is found again: what touches a neighbour may push it a little."""


@dataclass(frozen=True)
class Named:
    """Where an object was when it was last seen."""

    label: str
    place: Floats
    """x, y, z in a frame that stays, metres."""


def region_name(number: int) -> str:
    """Of what stands there and is no known object, by its number in the scene, from 0 on."""
    return f"unknown_{number + 1}"


def unique_names(labels: Sequence[str], kept: Sequence[str | None] = ()) -> list[str]:
    """The label for the first of its kind, then ``label_2``, ``label_3``, ... in order.

    ``kept`` are the names of those that have one already, None for others. A name that is another object's label is
    passed over.
    """
    names = [*kept] or [None] * len(labels)
    taken = {name for name in names if name is not None}
    result: list[str] = []
    for label, name in zip(labels, names, strict=True):
        further = (f"{label}_{number}" for number in count(2))
        chosen = name or (label if label not in taken else next(n for n in further if n not in taken.union(labels)))
        taken.add(chosen)
        result.append(chosen)
    return result


def names_kept(labels: Sequence[str], places: Floats, known: Mapping[str, Named]) -> list[str | None]:
    """For every object the name of the one of its label that stood where it stands (N x 3), None where none did."""
    names: list[str | None] = [None] * len(labels)
    for label in dict.fromkeys(labels):
        mine = [i for i, other in enumerate(labels) if other == label]
        theirs = [name for name, item in known.items() if item.label == label]
        before = np.array([known[name].place for name in theirs]).reshape(-1, 3)
        # All that is farther away counts alike, so that the one that was moved does not pull at those that stayed.
        apart = np.minimum(np.linalg.norm(places[mine][:, None] - before, axis=2), _STAYED)
        for row, column in zip(*linear_sum_assignment(apart), strict=True):
            if apart[row, column] < _STAYED:
                names[mine[row]] = theirs[column]
    return names


def exchanges(labels: Sequence[str], names: Sequence[str], wanted: Mapping[str, str]) -> Iterator[list[str]]:
    """Every way to name objects of which equal ones are exchangeable.

    Those of a label take the names ``wanted`` for it (name -> label), and beyond these their own.
    """
    groups = _groups(labels, names, wanted)
    for chosen in product(*(permutations(pool, len(mine)) for mine, pool in groups)):
        named = [*names]
        for (mine, _), order in zip(groups, chosen, strict=True):
            for i, name in zip(mine, order, strict=True):
                named[i] = name
        yield named


def best_exchange(
    labels: Sequence[str], names: Sequence[str], wanted: Mapping[str, str], worth: Callable[[int, str], float]
) -> list[str]:
    """The one of the :func:`exchanges` whose objects are together ``worth`` most, each by its number and new name."""
    named = [*names]
    for mine, pool in _groups(labels, names, wanted):
        worths = np.array([[worth(i, name) for name in pool] for i in mine])
        for row, column in zip(*linear_sum_assignment(worths, maximize=True), strict=True):
            named[mine[row]] = pool[column]
    return named


def _groups(
    labels: Sequence[str], names: Sequence[str], wanted: Mapping[str, str]
) -> list[tuple[list[int], list[str]]]:
    """Per label the numbers of its objects and the names that they may take, at least as many."""
    groups: list[tuple[list[int], list[str]]] = []
    for label in dict.fromkeys(labels):
        mine = [i for i, other in enumerate(labels) if other == label]
        pool = [name for name, other in wanted.items() if other == label]
        spare = [names[i] for i in mine if names[i] not in pool]
        groups.append((mine, pool + spare[: max(0, len(mine) - len(pool))]))
    return groups
