"""The goal by the simulator's truth: which of its relations hold, where perception differs, what was lost."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages import Assertion, Goal, Outcome, SceneGraph, Snapshot, Verdict, VirtualObject
from stages.messages.scene import SceneObject
from stages.scene.catalogue import Catalogue
from stages.scene.naming import exchanges, unique_names
from stages.scene.relations import Tolerances, assertions, supports
from stages.scene.scoring import label_of, matched
from stages.scene.stance import TIPPED, Stances, standing_of, turned
from stages.scene.virtual import satisfied

_BELOW = 0.02
"""Metres below the table's surface from which on an object has left the table."""
_STAYED = 0.03
"""Metres within which an object of no goal stays where it stood."""


@dataclass(frozen=True, slots=True)
class Loss:
    """An object that ended where nobody wanted it."""

    name: str
    how: Literal["left the table", "was knocked over", "is in no goal and was moved"]
    said: bool
    """Whether the verdict's reason or a failed transfer names it; of what was moved, any transfer."""

    def __str__(self) -> str:
        return f"{self.name} {self.how}, {'as was said' if self.said else 'and nobody said so'}"


@dataclass(frozen=True, slots=True)
class Judgement:
    """What the simulator knows of the end of an episode."""

    claimed: bool
    """Whether the verdict says that the goal is restored."""
    held: tuple[Assertion, ...] = ()
    """Relations of the goal as it was shown that hold at the end."""
    violated: tuple[Assertion, ...] = ()
    differences: tuple[str, ...] = ()
    """Where the verdict says something else, relation by relation."""
    losses: tuple[Loss, ...] = ()
    regained: tuple[Assertion, ...] = ()
    """Relations that hold at the end and did not at the start."""
    end_seen: bool = True
    """Whether there is a look after the last transfer; if not, the rest is of the last look before it."""

    @property
    def restored(self) -> bool:
        """Whether every relation of the goal holds; never where no goal was taught, nor where the end was not seen."""
        return bool(self.held) and not self.violated and self.end_seen

    @property
    def false_success(self) -> bool:
        """Whether a success was claimed that is none."""
        return self.claimed and not self.restored


class Truth:
    """Judges episodes with one catalogue's objects.

    The goal is what was shown: on, in, clear and exist are those of the true poses at the look that taught it. What
    stands beside what is a matter of a threshold, so the pairs are those that were taught, each where it truly stood.
    Equal objects are exchangeable: they are named as they were taught, and at the end as suits the goal best.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._stances = {label: Stances(item) for label, item in catalogue.objects.items()}

    def judge(
        self,
        snapshots: Sequence[Snapshot],
        goal: Goal | None,
        verdict: Verdict | None,
        outcomes: Sequence[Outcome],
        began: SceneGraph | None = None,
    ) -> Judgement:
        """The end of an episode; ``snapshots`` are those of its looks, in order, and perhaps one more of its ``end``.

        Without a verdict, where the run was killed, it claims nothing. ``began`` is what the robot perceived when it
        began to restore; its names are those by which it tells losses. Without, they are taken for those of the goal.
        """
        claimed = verdict is not None and verdict.success
        shows = [k for k, one in enumerate(snapshots) if goal and _shows(one.purpose, goal.name)]
        if goal is None or not shows:
            return Judgement(claimed)
        shown = shows[-1]
        wanted = self._wanted(self._as_taught(snapshots[shown], goal.scene), goal.scene)
        held, violated = self._satisfied(wanted, snapshots[-1])
        lacking = self._satisfied(wanted, snapshots[min(shown + 1, len(snapshots) - 1)])[1]
        perceived = goal.scene if began is None else began
        named = self._named(snapshots[shown:], perceived, at=0 if began is None else 1)
        return Judgement(
            claimed, held, violated, _differences(held, violated, verdict) if verdict else (),
            self._losses(named, goal.scene, _words(verdict, outcomes), {one.object for one in outcomes}),
            tuple(each for each in held if each in lacking), _end_seen(snapshots[shown:], verdict, outcomes),
        )  # fmt: skip

    def _as_taught(self, shown: Snapshot, taught: SceneGraph) -> Snapshot:
        """Equal objects with the names of those that were perceived where they are."""
        return self._named([shown], taught, at=0)[0]

    def _named(self, snapshots: Sequence[Snapshot], perceived: SceneGraph, *, at: int) -> list[Snapshot]:
        """Looks whose objects have the names of those that were perceived where they are at one of them, or the last.

        What was not perceived gets a name that is left.
        """
        look = snapshots[min(at, len(snapshots) - 1)]
        names = list(dict.fromkeys(name for one in (look, *snapshots) for name in one.names))
        labels = [label_of(name, self._catalogue) for name in names]
        matches = matched(look.names, look.T_base_objects, perceived.objects, self._catalogue)
        kept = [matches[k].name if k in matches else None for k in range(len(names))]
        new = dict(zip(names, unique_names(labels, kept), strict=True))
        return [msgspec.structs.replace(one, names=tuple(new[name] for name in one.names)) for one in snapshots]

    def _satisfied(self, wanted: SceneGraph, snapshot: Snapshot) -> tuple[tuple[Assertion, ...], tuple[Assertion, ...]]:
        """Which of the goal's relations hold at a look and which do not."""
        scenes = (self._scene(named, wanted) for named in self._exchanged(snapshot, wanted))
        found = [satisfied(wanted, scene, self._catalogue, share=1.0) for scene in scenes]
        return min(found, key=lambda relations: len(relations[1]))

    def _exchanged(self, snapshot: Snapshot, wanted: SceneGraph) -> Iterator[Snapshot]:
        """The scene with every way to give its objects the goal's names for their kind."""
        labels = [label_of(name, self._catalogue) for name in snapshot.names]
        for names in exchanges(labels, snapshot.names, {item.name: item.label for item in wanted.objects}):
            yield msgspec.structs.replace(snapshot, names=tuple(names))

    def _scene(self, snapshot: Snapshot, taught: SceneGraph) -> SceneGraph:
        """The true scene graph; what left the table does not exist in it."""
        T_base_table = _table(snapshot, taught)
        objects = tuple(
            SceneObject(name=name, label=label_of(name, self._catalogue), T_base_object=T, facing=1.0)
            for name, T in zip(snapshot.names, snapshot.T_base_objects, strict=True)
            if not _left(T, T_base_table)
        )
        found = assertions(supports(standing_of(objects, self._stances, T_base_table), Tolerances()))
        return msgspec.structs.replace(taught, objects=objects, virtual_objects=(), assertions=found)

    def _wanted(self, shown: Snapshot, taught: SceneGraph) -> SceneGraph:
        """The goal as it was shown."""
        scene = self._scene(shown, taught)
        poses = {item.name: item.T_base_object for item in scene.objects}
        regions = tuple(
            _moved(item, poses) for item in taught.virtual_objects if {item.parent, item.child} <= set(poses)
        )
        names = {item.name for item in regions}
        beside = tuple(
            item for item in taught.assertions if item.predicate == "faces" or not names.isdisjoint(item.arguments)
        )
        return msgspec.structs.replace(scene, virtual_objects=regions, assertions=(*scene.assertions, *beside))

    def _losses(
        self, snapshots: Sequence[Snapshot], taught: SceneGraph, words: set[str], carried: set[str]
    ) -> tuple[Loss, ...]:
        """What left the table, stands neither as it was shown nor as at the start, or had to stay and did not."""
        shown, start, final = map(_poses, (snapshots[0], snapshots[min(1, len(snapshots) - 1)], snapshots[-1]))
        came = {name: T for one in reversed(snapshots[1:]) for name, T in _poses(one).items()}
        T_base_table = _table(snapshots[-1], taught)
        found: list[Loss] = []
        for name, T in final.items():
            before = [poses[name] for poses in (shown, start, came) if name in poses]
            if _left(T, T_base_table):
                found.append(Loss(name, "left the table", name in words))
            elif not any(self._alike(name, T, other) for other in before):
                found.append(Loss(name, "was knocked over", name in words))
            elif name not in shown and np.linalg.norm(T[:2, 3] - came[name][:2, 3]) > _STAYED:
                found.append(Loss(name, "is in no goal and was moved", name in words | carried))
        return tuple(found)

    def _alike(self, name: str, A: Floats, B: Floats) -> bool:
        """Whether the same side of an object is up, modulo its symmetries."""
        return turned(self._catalogue[label_of(name, self._catalogue)], A, B) < TIPPED


def _poses(snapshot: Snapshot) -> dict[str, Floats]:
    """T_base_object by name."""
    return dict(zip(snapshot.names, snapshot.T_base_objects, strict=True))


def _shows(purpose: str, name: str) -> bool:
    """Whether a look was for a goal, or for the goal of that name."""
    return purpose.partition(",")[0] in ("goal", f"goal {name}")


def _end_seen(snapshots: Sequence[Snapshot], verdict: Verdict | None, outcomes: Sequence[Outcome]) -> bool:
    """Whether nothing has moved since the last look; without a verdict something may."""
    looks = {one.purpose.partition(",")[0] for one in snapshots}
    last = max((one.number for one in outcomes), default=0)
    return "end" in looks or (verdict is not None and (not last or f"after transfer {last}" in looks))


def _table(snapshot: Snapshot, taught: SceneGraph) -> Floats:
    """T_base_table, as it was perceived where the recording is older than the field."""
    return taught.T_base_table if snapshot.T_base_table is None else snapshot.T_base_table


def _left(T_base_object: Floats, T_base_table: Floats) -> bool:
    return bool((inverse(T_base_table) @ T_base_object)[2, 3] < -_BELOW)


def _moved(region: VirtualObject, poses: dict[str, Floats]) -> VirtualObject:
    T_parent_child = inverse(poses[region.parent]) @ poses[region.child]
    return msgspec.structs.replace(region, T_parent_virtual=T_parent_child)


def _differences(held: Sequence[Assertion], violated: Sequence[Assertion], verdict: Verdict) -> tuple[str, ...]:
    true = dict.fromkeys(held, "holds") | dict.fromkeys(violated, "does not hold")
    said = dict.fromkeys(verdict.satisfied, "holds") | dict.fromkeys(verdict.violated, "does not hold")
    none = "is no relation of the goal"
    return tuple(
        f"{item} {said.get(item, none)} by perception and {true.get(item, none)} in truth"
        for item in dict.fromkeys((*true, *said))
        if true.get(item) != said.get(item)
    )


def _words(verdict: Verdict | None, outcomes: Sequence[Outcome]) -> set[str]:
    """The words in which failures were told."""
    failed = [f"{item.object} {item.reason}" for item in outcomes if not item.success]
    return set(re.findall(r"\w+", " ".join([verdict.reason if verdict else "", *failed])))
