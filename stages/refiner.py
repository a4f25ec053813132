"""The ranked scene in, the same scene refined out: joint polish at full resolution, colour settles flips and labels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from runner.contract import Context, Refused, Stage
from stages.geometry.poses import pose
from stages.messages import ObjectPose, Observation, SceneEstimate
from stages.perception.confidence.doubt import Judge, annotated, judged
from stages.perception.filter.likelihood import ObservedScene
from stages.perception.filter.settings import FilterSettings
from stages.perception.refinement.refinement import Placed, RefinedObject, RefinementSettings, SceneRefiner
from stages.scene.catalogue import Catalogue


class Refiner(Stage):
    """Does once, for the winner, what would be too dear for every hypothesis."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings: those of the particle filter."""

        catalogue: Path
        """A catalogue's YAML file, or a BOP ``models`` folder."""
        form: Literal["default", "paper"] = "default"
        """``paper`` passes the ranked scene on as it is."""
        dof: Literal[3, 6] = 6
        without: tuple[str, ...] = ()
        """Improvements over the paper's plain form that are switched off."""

        def __post_init__(self) -> None:
            if self.form not in ("default", "paper"):
                raise Refused(f"refiner.form is '{self.form}'; choose default or paper")
            if self.dof not in (3, 6):
                raise Refused(f"refiner.dof is {self.dof}; choose 3 or 6")

    def __init__(self, config: Config) -> None:
        self.config = config
        self._refiner: SceneRefiner | None = None
        if config.form == "default":
            # torch takes a second to load; whoever only reads a graph does without.
            import torch

            torch.set_num_threads(1)
            torch.set_deterministic_debug_mode("error")
            settings = RefinementSettings.of(FilterSettings(dof=config.dof).without(*config.without))
            catalogue = Catalogue.shared(config.catalogue)
            self._refiner = SceneRefiner(catalogue, settings)
            self._refiner.warm_up()
            self._judge = Judge(catalogue, dof=config.dof)
            self._judge.warm_up()

    def on_scene_estimate(self, scene_estimate: SceneEstimate, observation: Observation, ctx: Context) -> SceneEstimate:
        """The same objects at better poses."""
        if self._refiner is None:
            return scene_estimate
        scene = ObservedScene.of(observation.depth, observation.foreground, observation.K, observation.T_camera_table)
        placed = [Placed(item.label, item.T_camera_object) for item in scene_estimate.objects]
        refined = self._refiner.refine(scene, observation.rgb, placed)
        doubted = tuple(map(judged, scene_estimate.objects, refined.objects))
        log_weights = scene_estimate.log_weights / scene_estimate.lambda_r
        log_weights[list(scene_estimate.repeated)] = -np.inf
        doubt = self._judge.assess(scene, doubted, log_weights, scene_estimate.winner)
        objects = tuple(map(_object, scene_estimate.objects, refined.objects))
        return annotated(msgspec.structs.replace(scene_estimate, objects=objects), doubt)


def _object(item: ObjectPose, refined: RefinedObject) -> ObjectPose:
    T = refined.T_camera_object
    return msgspec.structs.replace(
        item, T_camera_object=pose(T[:, :3], T[:, 3]), cost=refined.cost, visible=refined.visible, facing=refined.facing
    )
