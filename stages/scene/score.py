"""A run in numbers: how much of the goal holds in the last scene, and how far perception was from the truth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from runner.contract import Message
from stages.messages import Goal, SceneGraph, Snapshot
from stages.scene.catalogue import Catalogue
from stages.scene.scoring import ObjectError, errors
from stages.scene.virtual import satisfied


class Score:
    """What ``runner replay --set`` shows of a run as recorded and of the same run changed (:class:`Scorer`).

    Poses are scored where the recording holds the simulator's truth, relations where it holds a goal.
    """

    def __init__(self, settings: Mapping[str, Mapping[str, Any]]) -> None:
        """``settings`` by stage; all stages of a graph share one catalogue."""
        paths = [Path(config["catalogue"]) for config in settings.values() if "catalogue" in config]
        self._catalogue = Catalogue.load(paths[0]) if paths else None

    def score(self, run: Iterable[tuple[str, Message]]) -> Mapping[str, float]:
        """Numbers by name; those there is nothing to compare with are left out."""
        snapshots: dict[str, Snapshot] = {}
        scenes: dict[str, SceneGraph] = {}
        goals: list[Goal] = []
        for lineage, message in run:
            match message:
                case Snapshot():
                    snapshots[lineage] = message
                case SceneGraph():
                    scenes[lineage] = message
                case Goal():
                    goals.append(message)
                case _:
                    pass
        pairs = [(snapshots[look], scenes[look]) for look in snapshots if look in scenes]
        return {**self._relations(goals, list(scenes.values())), **dict(self._poses(pairs))}

    def _relations(self, goals: list[Goal], scenes: list[SceneGraph]) -> dict[str, float]:
        if not goals or not scenes or self._catalogue is None:
            return {}
        held, violated = satisfied(goals[-1].scene, scenes[-1], self._catalogue)
        return {"relations satisfied": len(held), "relations of the goal": len(held) + len(violated)}

    def _poses(self, pairs: list[tuple[Snapshot, SceneGraph]]) -> Iterator[tuple[str, float]]:
        if self._catalogue is None or not pairs:
            return
        found: list[ObjectError] = []
        for truth, scene in pairs:
            found += errors(truth.names, truth.T_base_objects, scene.objects, self._catalogue)
        yield "looks scored", len(pairs)
        yield "objects found", sum(error.found for error in found)
        yield "objects there", len(found)
        yield from _spread("position error, mm", [1e3 * error.position for error in found if error.found])
        yield from _spread("rotation error, degrees", [float(np.degrees(one.rotation)) for one in found if one.found])


def _spread(name: str, values: list[float]) -> Iterator[tuple[str, float]]:
    if values:
        yield f"{name}, median", median(values)
        yield f"{name}, worst", max(values)
