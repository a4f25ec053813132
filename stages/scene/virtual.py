"""Virtual objects: regions that say what stands beside what, and whether a goal's relations hold in a scene."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import product

import msgspec
import numpy as np

from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages.scene import Assertion, SceneGraph, VirtualObject
from stages.scene import facing
from stages.scene.catalogue import Catalogue, Symmetries
from stages.scene.relations import Support
from stages.scene.stance import Standing, is_tipped

CLAIMED = 0.85
"""Share of a region's radius within which what is perceived to be in it is said to be: the rest is for perception's
errors."""
RADIUS = 0.04
"""Of a region, metres, unless somebody says otherwise."""
SYMMETRY_STEP = np.deg2rad(4)
"""Sampling of continuous symmetries when a ring is evaluated, radians: 1 cm at 15 cm from the axis."""


def virtual_objects(
    standing: Sequence[Standing],
    found: Mapping[str, Support],
    *,
    gap: float,
    radius: float,
    doubtful: Collection[str] = (),
) -> tuple[VirtualObject, ...]:
    """A region for each pair of neighbours: same supporter, footprints less than ``gap`` metres apart.

    The neighbours of a supporter form a graph; its minimum spanning forest keeps the relations few and free of
    cycles. In each tree an object that cannot be moved, then the one with the largest footprint, is the root, and
    every other object belongs into a region of its neighbour towards the root. So each object has one parent.

    A region turns with its parent. An object whose pose is ``doubtful`` is therefore the parent of none, unless it is
    the root: what it alone joins to the others belongs into a region of its own parent.
    """
    made: list[VirtualObject] = []
    for supporter in dict.fromkeys(support.parent for support in found.values()):
        siblings = [item for item in standing if found[item.name].parent == supporter]
        made += [_region(parent, child, radius) for parent, child in _tree(siblings, gap, doubtful)]
    return tuple(made)


def _region(parent: Standing, child: Standing, radius: float) -> VirtualObject:
    return region(parent.name, child.name, inverse(parent.T_table_object) @ child.T_table_object, radius)


def region(parent: str, child: str, T_parent_virtual: Floats, radius: float) -> VirtualObject:
    """The region of ``parent`` in which ``child`` belongs."""
    return VirtualObject(
        name=f"{child}_near_{parent}", parent=parent, child=child, T_parent_virtual=T_parent_virtual, radius=radius
    )


def _tree(siblings: Sequence[Standing], gap: float, doubtful: Collection[str]) -> list[tuple[Standing, Standing]]:
    """(parent, child) pairs of the minimum spanning forest, parents first, a sure one for each child."""
    edges = _spanning(siblings, gap, doubtful)
    pairs: list[tuple[Standing, Standing]] = []
    reached: set[str] = set()
    sure: dict[str, Standing] = {}
    for root in sorted(siblings, key=lambda item: _root_first(item, item.name in doubtful)):
        pending = [] if root.name in reached else [root]
        reached.add(root.name)
        while pending:
            parent = pending.pop(0)
            children = [c for c in siblings if frozenset((parent.name, c.name)) in edges and c.name not in reached]
            reached.update(child.name for child in children)
            pairs += [(sure.get(parent.name, parent), child) for child in children]
            sure |= {child.name: sure.get(parent.name, parent) for child in children if child.name in doubtful}
            pending += children
    return pairs


def _root_first(item: Standing, doubtful: bool) -> tuple[bool, bool, float, str]:
    area = regions.area(item.stance.outline)
    return bool(item.stance.item.grasps), doubtful, -area, item.name


def _spanning(siblings: Sequence[Standing], gap: float, doubtful: Collection[str]) -> set[frozenset[str]]:
    """Kruskal's minimum spanning forest over the gaps between footprints, sure neighbours first; ties go by name."""
    pairs = [sorted((a, b), key=lambda item: item.name) for i, a in enumerate(siblings) for b in siblings[i + 1 :]]
    edges = sorted(
        (a.name in doubtful or b.name in doubtful, regions.gap(a.outline, b.outline), a.name, b.name) for a, b in pairs
    )
    component = {item.name: item.name for item in siblings}
    chosen: set[frozenset[str]] = set()
    for _, distance, a, b in edges:
        if distance >= gap or component[a] == component[b]:
            continue
        chosen.add(frozenset((a, b)))
        merged = component[b]
        component = {name: component[a] if root == merged else root for name, root in component.items()}
    return chosen


def among_neighbours(
    virtual: Sequence[VirtualObject],
    found: Mapping[str, Support],
    poses: Mapping[str, Floats],
    moved: Collection[str] = (),
) -> tuple[VirtualObject, ...]:
    """The regions of those objects that are there, told of what one supporter carries.

    ``poses`` are T_base_object by name; those of the objects that are ``moved`` are not the ones that the regions were
    told by. What stood beside another object may turn out to stand on a third one, which was not seen: then that is
    beside it, unless it has its place among the others already.
    """
    placed = {name for item in virtual for name in (item.parent, item.child)}
    told: list[VirtualObject] = []
    for item in virtual:
        stacks = [_downwards(name, found) for name in (item.parent, item.child)]
        for parent, child in product(*stacks):
            if parent == child or found[parent].parent != found[child].parent:
                continue
            if (parent, child) == (item.parent, item.child) and {parent, child}.isdisjoint(moved):
                told.append(item)
            elif placed.isdisjoint({parent, child} - {item.parent, item.child}):
                told.append(region(parent, child, inverse(poses[parent]) @ poses[child], item.radius))
                placed |= {parent, child}
    return tuple(told)


def renamed(virtual: Sequence[VirtualObject], names: Mapping[str, str]) -> tuple[VirtualObject, ...]:
    """The same regions of objects that have new names, by those they had."""
    return tuple(
        region(names.get(one.parent, one.parent), names.get(one.child, one.child), one.T_parent_virtual, one.radius)
        for one in virtual
    )


def _downwards(name: str, found: Mapping[str, Support]) -> list[str]:
    """An object, what carries it, what carries that, down to the table; nothing where it is not there."""
    stack: list[str] = []
    while name in found:
        stack.append(name)
        name = found[name].parent
    return stack


def assertions(virtual: Sequence[VirtualObject]) -> tuple[Assertion, ...]:
    """{has(parent, region), in(region, child)} for each virtual object, as in the paper."""
    has = (Assertion(predicate="has", arguments=(item.parent, item.name)) for item in virtual)
    inside = (Assertion(predicate="in", arguments=(item.name, item.child)) for item in virtual)
    return tuple(assertion for pair in zip(has, inside, strict=True) for assertion in pair)


def region_poses(virtual: VirtualObject, T_base_parent: Floats, symmetries: Symmetries) -> Floats:
    """Where the region may be, N x 4 x 4 in the base frame, as demonstrated first.

    One pose per symmetry of the parent, a ring of them where it is round. Near symmetries count: depth alone cannot
    tell such poses apart, so the side on which the estimate puts the region means nothing.
    """
    return T_base_parent @ symmetries.lookalikes(SYMMETRY_STEP) @ virtual.T_parent_virtual


def in_region(
    virtual: VirtualObject, T_base_parent: Floats, T_base_child: Floats, symmetries: Symmetries, share: float = CLAIMED
) -> bool:
    """Whether the child stands within ``share`` of the region's radius, horizontally, of one of the region's poses."""
    centres = region_poses(virtual, T_base_parent, symmetries)[:, :2, 3]
    return bool(np.linalg.norm(centres - T_base_child[:2, 3], axis=1).min() <= share * virtual.radius)


def rerooted(goal: SceneGraph, root: str) -> SceneGraph:
    """The same neighbours told from ``root``, which is beside nothing then.

    Which of two neighbours is beside the other is a matter of telling; who can be placed first is not. Where the old
    child is turned as in the goal, its old parent in the new region means the old child in the old one.
    """
    regions = {item.child: item for item in goal.virtual_objects}
    turned: dict[str, VirtualObject] = {}
    while root in regions:
        old = regions[root]
        turned[old.name] = region(root, old.parent, inverse(old.T_parent_virtual), old.radius)
        root = old.parent
    kept = tuple(item for item in goal.assertions if turned.keys().isdisjoint(item.arguments))
    return msgspec.structs.replace(
        goal,
        virtual_objects=tuple(turned.get(item.name, item) for item in goal.virtual_objects),
        assertions=(*kept, *assertions(tuple(turned.values()))),
    )


def without(goal: SceneGraph, names: set[str]) -> SceneGraph:
    """The part of a goal that does without some of its objects, what rests on or in these and regions beside them."""
    gone = set(names)
    while more := {
        item.arguments[0]
        for item in goal.assertions
        if item.predicate in ("on", "in") and item.arguments[1] in gone and item.arguments[0] not in gone
    } & {item.name for item in goal.objects}:
        gone |= more
    gone |= {item.name for item in goal.virtual_objects if not gone.isdisjoint((item.parent, item.child))}
    return msgspec.structs.replace(
        goal,
        objects=tuple(item for item in goal.objects if item.name not in gone),
        virtual_objects=tuple(item for item in goal.virtual_objects if item.name not in gone),
        assertions=tuple(item for item in goal.assertions if gone.isdisjoint(item.arguments)),
    )


def satisfied(
    goal: SceneGraph,
    current: SceneGraph,
    catalogue: Catalogue,
    share: float = CLAIMED,
    *,
    taught: SceneGraph | None = None,
) -> tuple[tuple[Assertion, ...], tuple[Assertion, ...]]:
    """The goal's assertions that hold in the current scene, and those that do not.

    Compares the topological layout (paper, section VI-B): exist, on, in and clear as the current scene asserts them;
    has and in of a virtual object by the current poses, in ``share`` of its radius, whatever virtual objects the
    current scene has, and faces by the current poses. Where ``goal`` tells a region the other way round than it was
    ``taught``, the taught one counts: half a turn of a box turns what is told from it, too. What lies and stood, or the
    other way round, is not on or in what carries it as the goal has it. Poses and objects that the goal does not name
    are not compared, except that these may not be on or in a goal object that was clear.
    """
    over = fallen(goal, current, catalogue)
    # Regions of the current scene may have the same names and mean other places.
    regions_now = {item.name for item in current.virtual_objects}
    real = (item for item in current.assertions if regions_now.isdisjoint(item.arguments))
    standing = (item for item in real if item.predicate not in ("on", "in") or item.arguments[0] not in over)
    asserted = {(item.predicate, item.arguments) for item in standing}
    asserted |= _held_regions(goal, current, catalogue, share, taught) | facing.held(goal, current)
    held = [item for item in goal.assertions if (item.predicate, item.arguments) in asserted]
    violated = [item for item in goal.assertions if (item.predicate, item.arguments) not in asserted]
    return tuple(held), tuple(violated)


def fallen(goal: SceneGraph, current: SceneGraph, catalogue: Catalogue) -> frozenset[str]:
    """Objects of the goal of which another side is up than there: they have fallen over, or must be laid down."""
    shown = {item.name: item.T_base_object for item in goal.objects}
    return frozenset(
        item.name
        for item in current.objects
        if item.name in shown and is_tipped(catalogue[item.label], item.T_base_object, shown[item.name])
    )


def _held_regions(
    goal: SceneGraph, current: SceneGraph, catalogue: Catalogue, share: float, taught: SceneGraph | None
) -> set[tuple[str, tuple[str, ...]]]:
    poses = {item.name: item for item in current.objects}
    judged = {frozenset((item.parent, item.child)): item for item in taught.virtual_objects} if taught else {}
    held: set[tuple[str, tuple[str, ...]]] = set()
    for virtual in goal.virtual_objects:
        if virtual.parent not in poses:
            continue
        held.add(("has", (virtual.parent, virtual.name)))
        judge = judged.get(frozenset((virtual.parent, virtual.child)), virtual)
        parent, child = poses.get(judge.parent), poses.get(judge.child)
        if parent is None or child is None:
            continue
        symmetries = catalogue[parent.label].symmetries
        if in_region(judge, parent.T_base_object, child.T_base_object, symmetries, share):
            held.add(("in", (virtual.name, virtual.child)))
    return held
