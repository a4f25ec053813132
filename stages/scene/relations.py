"""From object poses to exist, clear, on and in (paper, section IV-B).

The paper's rules decide first. An object is supported by another one if gravity is along one of its axes and
``z_i - h_table > 0.5 h_i`` (rule 1), or along none (rule 2); its supporter is the one whose top region overlaps most
with its bottom region. They were made for objects on objects, upright, on a table, and fail in four cases:

* An object in a tray or bowl is a few millimetres up, less than the estimate's noise. Its bottom over a cavity's
  floor, between floor and rim, is therefore evidence of its own: nothing but being inside explains it.
* Of three stacked objects the lowest may overlap most with the uppermost. So a supporter must reach up to the bottom
  of what it supports, and of supporters that rest on each other only the highest counts.
* Gravity is along no axis of a mug that lies on its handle. Its resting poses in the catalogue count like axes.
* A leaning object that overlaps with nothing is on the table all the same.

Whether the assertion is ``on`` or ``in`` depends on the supporter being convex or concave; a concave object that
does not stand upright holds nothing and counts as convex. A plate has a rim and a floor too, yet things are on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stages.geometry import regions
from stages.messages.scene import Assertion, UnknownRegion
from stages.scene.domain import TABLE
from stages.scene.stance import Standing

_INWARDS = 0.01
"""Metres from the edge of a surface within which the middle of something may be beside it."""
_HIDDEN = 0.05
"""Metres above a surface at which what shows of something that stands on it begins at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerances:
    """What the pose estimate's noise may do, metres and shares of an area."""

    lift: float = 0.01
    """An object whose bottom is less than this above the table may stand on it (rule 1)."""
    contact: float = 0.022
    """Largest distance in height between a bottom and the surface that carries it."""
    share_on: float = 0.3
    """Least share of the smaller surface that must overlap for one object to be on another."""
    share_in: float = 0.5
    """Least share of a bottom that must lie over a cavity's floor."""


@dataclass(frozen=True)
class Support:
    """What carries an object, and how."""

    parent: str
    how: Literal["on", "in"]


ON_TABLE = Support(TABLE, "on")


def supports(standing: Sequence[Standing], tolerances: Tolerances) -> dict[str, Support]:
    """The one supporter of each object, by name; the graph is a tree whose root is the table."""
    below = _supporters(standing, tolerances)
    by_name = {item.name: item for item in standing}
    found: dict[str, Support] = {}
    for item in sorted(standing, key=lambda item: (item.z_bottom, item.name)):
        rivals = _direct(below, item.name) or _overlapping(item, standing, tolerances)
        rivals = {name: area for name, area in rivals.items() if not _carries(found, item.name, name)}
        if rivals:
            parent = min(rivals, key=lambda name: (-rivals[name], name))
            found[item.name] = Support(parent, "in" if by_name[parent].stance.holds else "on")
        else:
            found[item.name] = ON_TABLE
    return {item.name: found[item.name] for item in standing}


def gaps(standing: Sequence[Standing], found: Sequence[Assertion], tolerances: Tolerances) -> dict[str, float]:
    """Objects that hang above what is said to carry them, and by how many metres: what really does was not seen."""
    named = {item.name: item for item in standing}
    carriers = {item.arguments[0]: item.arguments[1] for item in found if item.predicate in ("on", "in")}
    above = {item.name: item.z_bottom - _surface(named.get(carriers[item.name]), item) for item in standing}
    return {name: gap for name, gap in above.items() if gap > tolerances.contact}


def is_covered(item: Standing, unknown: Sequence[UnknownRegion], tolerances: Tolerances) -> bool:
    """Whether something that no object explains stands on an object, or in its hollow and out of it.

    Its middle is over the surface; what shows of it begins no deeper than a contact may, rises clearly above the
    surface, and above the rim: what is lower in a hollow may be the object's own wall, estimated a little off.
    """
    for one in unknown:
        bottom, top = one.centre_table[2] + np.array([-0.5, 0.5]) * one.extent_table[2]
        for surface, z in ((item.top, item.z_top), (item.floor, item.z_floor)):
            over = regions.inside(one.centre_table[None, :2], surface, margin=_INWARDS)
            begins = -tolerances.contact < bottom - z < _HIDDEN
            if over and begins and top > max(z + tolerances.contact, item.z_top + tolerances.lift):
                return True
    return False


def _surface(carrier: Standing | None, item: Standing) -> float:
    """Height above the table up to which a carrier (None: the table) may bear an object: its floor, unless that may
    lean on its wall all round, or lie on its rim."""
    if carrier is None:
        return 0.0
    return carrier.z_top if carrier.rim_bears(item.bottom, carrier.floor) else carrier.rest_height(item.bottom)


def _supporters(standing: Sequence[Standing], tolerances: Tolerances) -> dict[str, dict[str, float]]:
    """For each object all that could carry it, directly or through others, and by how much they overlap."""
    found: dict[str, dict[str, float]] = {}
    for upper in standing:
        areas = {lower.name: contact_area(upper, lower, tolerances) for lower in standing if lower is not upper}
        found[upper.name] = {name: area for name, area in areas.items() if area > 0}
    bottoms = {item.name: (item.z_bottom, item.name) for item in standing}
    for upper, lowers in found.items():
        for lower in [name for name in lowers if upper in found[name] and bottoms[upper] < bottoms[name]]:
            del lowers[lower]
    return found


def penetration(a: Standing, b: Standing, tolerances: Tolerances) -> float:
    """Metres by which one of two upright objects would have to move for neither to be inside the other; 0 where one
    carries the other, or one of them leans."""
    carried = contact_area(a, b, tolerances) > 0 or contact_area(b, a, tolerances) > 0
    if carried or not (a.stance.aligned and b.stance.aligned):
        return 0.0
    upwards = min(a.z_top, b.z_top) - max(a.z_bottom, b.z_bottom)
    return max(0.0, min(upwards, -a.separation(b)))


def contact_area(upper: Standing, lower: Standing, tolerances: Tolerances) -> float:
    """Square metres over which ``lower`` may carry ``upper``; 0 where heights or regions do not meet."""
    bottom = regions.area(upper.bottom)
    z = upper.z_bottom
    if lower.stance.cavity and lower.z_floor - tolerances.contact <= z <= lower.z_top + tolerances.contact:
        inside = regions.overlap_area(upper.bottom, lower.floor)
        if inside >= tolerances.share_in * bottom:
            return inside
    above = upper.z_bottom > lower.z_bottom + 0.5 * lower.stance.height
    if not above or abs(z - lower.z_top) > tolerances.contact:
        return 0.0
    across = regions.overlap_area(upper.bottom, lower.top)
    return across if across >= tolerances.share_on * min(bottom, regions.area(lower.top)) else 0.0


def _direct(below: Mapping[str, Mapping[str, float]], name: str) -> dict[str, float]:
    """The supporters of an object that carry none of its other supporters."""
    rivals = below[name]
    direct = {k: v for k, v in rivals.items() if not any(_above(below, other, k) for other in rivals if other != k)}
    return direct or dict(rivals)


def _above(below: Mapping[str, Mapping[str, float]], upper: str, lower: str) -> bool:
    """Whether ``upper`` rests on ``lower``, directly or through others."""
    seen, pending = {upper}, [upper]
    while pending:
        new = [name for name in below[pending.pop()] if name not in seen]
        if lower in new:
            return True
        seen.update(new)
        pending += new
    return False


def _overlapping(item: Standing, standing: Sequence[Standing], tolerances: Tolerances) -> dict[str, float]:
    """The paper's choice where no surface is at the right height: anything lower that overlaps enough."""
    if item.stance.aligned and item.z_bottom <= tolerances.lift:
        return {}
    least = tolerances.share_on * regions.area(item.bottom)
    middle = item.z_bottom + 0.5 * item.stance.height
    lower = [other for other in standing if other is not item and other.z_bottom + 0.5 * other.stance.height < middle]
    areas = {other.name: regions.overlap_area(item.bottom, other.top) for other in lower}
    return {name: area for name, area in areas.items() if area > least}


def _carries(found: Mapping[str, Support], lower: str, upper: str) -> bool:
    """Whether ``upper`` is ``lower`` itself or already rests on it, so that it cannot carry it."""
    while upper != lower and upper in found:
        upper = found[upper].parent
    return upper == lower


def assertions(found: Mapping[str, Support]) -> tuple[Assertion, ...]:
    """exist, on or in, and clear, in the order of the objects; ``clear``: nothing is on or in it."""
    occupied = {support.parent for support in found.values()}
    exist = [Assertion(predicate="exist", arguments=(name,)) for name in found]
    placed = [Assertion(predicate=support.how, arguments=(name, support.parent)) for name, support in found.items()]
    clear = [Assertion(predicate="clear", arguments=(name,)) for name in found if name not in occupied]
    return (*exist, *placed, *clear)
