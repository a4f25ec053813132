"""All estimated hypotheses in, the maximal likely scene out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_

import msgspec
import numpy as np

from runner.contract import Context, Stage
from stages.messages import ObjectPose, Observation, SceneEstimate
from stages.messages.digest import Contender
from stages.perception.hypotheses.duplicates import is_same_scene, without_doubles
from stages.scene.doubts import UNSURE
from stages.scene.naming import Named, names_kept, unique_names


class Ranker(Stage):
    """Ranks hypotheses by the unnormalised weight of their best particle (paper, section IV-A.3).

    Equal objects keep their names from look to look by where they stand, if it is known where the camera is.
    """

    stateful = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """The ranker has no settings."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self._known: dict[str, Named] = {}

    def on_contenders(self, contenders: list[Contender], observation: Observation, ctx: Context) -> SceneEstimate:
        """The scene of greatest weight; of equals, the one of the more confident hypothesis (lower index)."""
        log_weights = np.array([each.log_weight for each in contenders], float)
        winner = int(np.argmax(log_weights))
        best = contenders[winner]
        scenes = [without_doubles(each.objects) for each in contenders]
        return SceneEstimate(
            objects=self._named(scenes[winner], observation),
            winner=winner,
            log_weights=log_weights,
            left_out=best.left_out,
            T_camera_table=observation.T_camera_table,
            T_base_camera=observation.T_base_camera,
            K=observation.K,
            scene_id=observation.scene_id,
            image_id=observation.image_id,
            name=observation.name,
            support=observation.support,
            lambda_r=best.lambda_r,
            repeated=_repeated(scenes, np.argsort(-log_weights, kind="stable").tolist()),
            contested=_contested(scenes[winner], scenes),
            unusable=observation.unusable,
        )

    def _named(self, objects: Sequence[ObjectPose], observation: Observation) -> tuple[ObjectPose, ...]:
        """The objects with the names of those that stood where they stand; looks without a common frame share none."""
        if observation.T_base_camera is None:
            return tuple(objects)
        labels = [item.label for item in objects]
        T_base_objects = [observation.T_base_camera @ item.T_camera_object for item in objects]
        places = np.reshape(T_base_objects, (-1, 4, 4))[:, :3, 3]
        names = unique_names(labels, names_kept(labels, places, self._known))
        self._known = {**self._known, **dict(zip(names, map(Named, labels, places), strict=True))}
        return tuple(msgspec.structs.replace(item, name=name) for item, name in zip(objects, names, strict=True))


def _contested(best: Sequence[ObjectPose], scenes: Sequence[Sequence[ObjectPose]]) -> tuple[str, ...]:
    """Labels of which another scene has more objects that the detector takes for likely than the best one has."""
    likely = (Counter(item.label for item in scene if item.confidence >= UNSURE) for scene in scenes)
    most = reduce(or_, likely, Counter[str]())
    return tuple(sorted(most - Counter(item.label for item in best)))


def _repeated(scenes: Sequence[Sequence[ObjectPose]], order: Sequence[int]) -> tuple[int, ...]:
    """Those that are the same as one before them in the order."""
    new: list[int] = []
    for i in order:
        if not any(is_same_scene(scenes[k], scenes[i]) for k in new):
            new.append(i)
    return tuple(sorted(set(order) - set(new)))
