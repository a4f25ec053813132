"""The symbolic problem between two scene graphs: what is written as PDDL and what the search solves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from stages.messages.scene import SceneGraph
from stages.scene.domain import TABLE
from stages.scene.facing import sides


@dataclass(frozen=True)
class VirtualRegion:
    """A virtual object of the goal, as the planner sees it."""

    name: str
    parent: str
    child: str


@dataclass(frozen=True)
class Problem:
    """Where everything is, what can be moved, and where it belongs.

    Containers and the supports that the goal puts several objects on are roomy: geometry, not ``clear``, says whether
    another object fits.
    """

    supports: Mapping[str, str]
    """Item -> what carries it now."""
    goal: Mapping[str, str]
    """Item of the goal -> what carries it there; without those that may be anywhere."""
    clear: frozenset[str]
    """Items of the goal on and in which nothing may be."""
    concave: frozenset[str]
    graspable: frozenset[str]
    regions: Mapping[str, VirtualRegion]
    """Child -> the region in which it belongs."""
    held: frozenset[str]
    """Children that are in their region now."""
    faced: frozenset[str] = frozenset()
    """Items of which the goal says which side they show."""
    turned: frozenset[str] = frozenset()
    """Those of them that show another one now, or may do so, and all of which another one is up."""
    obstructions: frozenset[tuple[str, str, str]] = frozenset()
    """(obstacle, item, support or region): the obstacle must have been picked before the item is placed there."""

    @staticmethod
    def between(
        current: SceneGraph,
        goal: SceneGraph,
        *,
        held: frozenset[str],
        graspable: frozenset[str],
        turned: frozenset[str] = frozenset(),
    ) -> Problem:
        """The problem of turning one scene into another that has at least the goal's objects."""
        return Problem(
            supports=carriers(current),
            goal=wanted(goal),
            clear=frozenset(item.arguments[0] for item in goal.assertions if item.predicate == "clear"),
            concave=frozenset(containers(goal) | containers(current)),
            graspable=graspable,
            regions={item.child: VirtualRegion(item.name, item.parent, item.child) for item in goal.virtual_objects},
            held=held,
            faced=frozenset(sides(goal)),
            turned=turned,
        )

    @property
    def items(self) -> tuple[str, ...]:
        """All items of the current scene, in its order."""
        return tuple(self.supports)

    @property
    def roomy(self) -> frozenset[str]:
        """Supports that may carry several items."""
        carriers = list(self.goal.values())
        several = {name for name in carriers if carriers.count(name) > 1}
        return frozenset({TABLE} | self.concave | several)

    def destinations(self, item: str) -> tuple[str, ...]:
        """Supports worth placing an item on: its own in the goal, and the table, which serves to put it aside.

        Putting blocks aside on other blocks never makes a plan shorter, so no other support is needed.
        """
        return tuple(dict.fromkeys((self.goal.get(item, TABLE), TABLE)))

    def finally_at(self, item: str) -> str:
        """The region in which the item belongs, or the support that it belongs on where it has none."""
        return self.regions[item].name if item in self.regions else self.goal.get(item, TABLE)

    def beside(self, item: str) -> Iterator[str]:
        """What the item belongs beside, what that one belongs beside, and so on."""
        while item in self.regions:
            item = self.regions[item].parent
            yield item

    def laid_out_anew(self) -> Problem:
        """The problem in which what others belong beside moves before they are placed: to where it was shown, at best,
        for there all of them had room."""
        moved = {(one.parent, one.child, one.name) for one in self.regions.values() if one.parent in self.graspable}
        return replace(self, obstructions=self.obstructions | moved)

    def satisfied(self) -> bool:
        """Whether the goal holds already."""
        occupied = set(self.supports.values())
        placed = all(self.supports[item] == support for item, support in self.goal.items())
        return placed and not self.clear & occupied and self.held >= set(self.regions) and not self.turned


def carriers(scene: SceneGraph) -> dict[str, str]:
    """Object -> what it is on or in, in the order of the scene's objects."""
    return {item.name: TABLE for item in scene.objects} | wanted(scene)


def wanted(goal: SceneGraph) -> dict[str, str]:
    """The same for those of which a goal says what carries them; the others may be anywhere."""
    names = {item.name for item in goal.objects}
    return {
        child: support
        for assertion in goal.assertions
        if assertion.predicate in ("on", "in") and assertion.arguments[0] in names
        for child, support in [assertion.arguments]
    }


def containers(scene: SceneGraph) -> set[str]:
    """Objects in which the scene graph says that something is."""
    names = {item.name for item in scene.objects}
    return {item.arguments[1] for item in scene.assertions if item.predicate == "in" and item.arguments[0] in names}


def cycle(goal: Mapping[str, str]) -> tuple[str, ...]:
    """Objects that rest on each other in a circle; empty where there is none."""
    for start in goal:
        path, at = [start], goal[start]
        while at in goal and at not in path:
            path.append(at)
            at = goal[at]
        if at == start:
            return tuple(path)
    return ()
