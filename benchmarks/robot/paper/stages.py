"""Perception of the paper's proof of concept: poses from features instead of DIGEST, known labels, upright objects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.common.datasets import Image
from benchmarks.comparison.baselines import METHODS
from runner.contract import Context, Refused, Stage
from stages.messages import Candidates, Frame, ObjectPose, Observation, SceneEstimate
from stages.perception.observation.preprocessing import preprocess
from stages.scene.catalogue import BUILT_IN, Catalogue


class FeatureScene(Stage):
    """The scene that a baseline finds in the most confident candidate of each label."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Which baseline."""

        catalogue: Path = BUILT_IN
        method: str = "ppf"
        n_objects: int = 6
        max_height: float = 0.6
        """Metres above the support plane beyond which a reading belongs to no object."""

        def __post_init__(self) -> None:
            if self.method not in METHODS:
                raise Refused(f"features.method: {self.method!r} is none of {', '.join(METHODS)}")

    def __init__(self, config: Config) -> None:
        self.config = config
        self._catalogue = Catalogue.shared(config.catalogue)
        self._estimate = METHODS[config.method]
        self._estimate.prepare(self._catalogue)

    def on_candidates(
        self, frame: Frame, candidates: Candidates, ctx: Context
    ) -> Iterator[Observation | SceneEstimate]:
        """The observation, then the scene with one pose an object."""
        best = {each.label: each for each in sorted(candidates.candidates, key=lambda each: each.confidence)}
        seen = preprocess(frame, tuple(best.values()), ctx.rng, max_height=self.config.max_height)
        yield seen
        known = msgspec.structs.replace(candidates, candidates=tuple(best.values()))
        image = Image(msgspec.structs.replace(frame, n_objects=self.config.n_objects), known, ())
        found = self._estimate(image, self._catalogue, dof=4)
        yield SceneEstimate(
            objects=tuple(
                ObjectPose(
                    name=label, label=label, T_camera_object=T, confidence=best[label].confidence, cost=-agreement,
                    box=best[label].box,
                )
                for label, T, agreement in found
            ),
            winner=0,
            log_weights=np.zeros(1),
            left_out=0,
            T_camera_table=seen.T_camera_table,
            T_base_camera=seen.T_base_camera,
            K=seen.K,
            scene_id=seen.scene_id,
            image_id=seen.image_id,
            name=seen.name,
            support=seen.support,
        )  # fmt: skip
