"""Posteriors of all hypotheses in, the maximal likely scene out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runner.contract import Context, Stage
from stages.messages import Observation, Posterior, SceneEstimate


class Ranker(Stage):
    """Ranks hypotheses by the unnormalised weight of their best particle (paper, section IV-A.3)."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """The ranker has no settings."""

    def __init__(self, config: Config) -> None:
        self.config = config

    def on_posteriors(self, posteriors: list[Posterior], observation: Observation, ctx: Context) -> SceneEstimate:
        """The scene of greatest weight; of equals, the one of the more confident hypothesis (lower index)."""
        log_weights = np.array([posterior.log_weight for posterior in posteriors], float)
        winner = int(np.argmax(log_weights))
        best = posteriors[winner]
        return SceneEstimate(
            objects=best.objects,
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
        )
