"""Looks at candidates in, the same looks out: how sure each label is now that its object has a pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from runner.contract import Context, Stage
from stages.messages import Observation
from stages.messages.digest import Candidate, Sighting
from stages.perception.rendering.rasteriser import View


class Appraiser(Stage):
    """Judges candidates that come from meshes again, each within the silhouette of its object.

    Confidences become those that both judgements and depth leave, boxes those of what is visible of the objects.
    """

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings: those of the detector."""

        catalogue: Path
        learned: Path | None = None

    def __init__(self, config: Config) -> None:
        import torch

        from stages.perception.detection import appraisal
        from stages.perception.detection.labels import Judge
        from stages.perception.detection.outline import faintness
        from stages.perception.detection.views import Views

        torch.set_num_threads(1)
        torch.set_deterministic_debug_mode("error")
        views = Views.of(config.catalogue, config.learned, place="appraiser.learned")
        self._judge, self._labels = Judge(views), views.labels
        self._appraisal, self._faintness = appraisal, faintness

    def on_sightings(self, sightings: list[Sighting], observation: Observation, ctx: Context) -> Iterator[Sighting]:
        """The same candidates, as sure as what their objects show allows."""
        found = [(s.candidate, s.start, s.glimpse) for s in sightings if s.candidate and s.start and s.glimpse]
        if not found:  # the paper's plain form takes no looks
            yield from sightings
            return
        view = View.of(observation.K, *observation.depth.shape[::-1])
        regions = [
            self._appraisal.silhouette(glimpse, observation.depth, view, observation.T_camera_table)
            for _, _, glimpse in found
        ]
        columns = [self._labels.index(candidate.label) for candidate, _, _ in found]
        second = self._appraisal.second_confidences(self._judge, observation.rgb, regions, columns)
        first = np.array([candidate.confidence for candidate, _, _ in found])
        explained = np.array([start.explained for _, start, _ in found])
        faint = self._faintness([glimpse for _, _, glimpse in found], observation.rgb, observation.depth)
        judged = self._appraisal.appraisal(first, second, explained, faint)
        ctx.log(f"{int((judged.confidences > 0.5).sum())} of {len(found)} candidates are likely once looked at")
        for sighting, (candidate, _, _), region, confidence, share in zip(
            sightings, found, regions, judged.confidences.tolist(), judged.shares.tolist(), strict=True
        ):
            box = candidate.box if region is None else self._appraisal.visible_box(region)
            again = Candidate(label=candidate.label, box=box, confidence=confidence)
            yield msgspec.structs.replace(sighting, candidate=again, share=share)
