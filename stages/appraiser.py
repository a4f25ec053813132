"""Looks at candidates in, the same looks out: how sure each label is now that its object has a pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from runner.contract import Context, Stage
from stages.geometry.arrays import Floats
from stages.geometry.poses import compose
from stages.messages import Observation
from stages.messages.digest import Candidate, LoneEstimate
from stages.perception.refinement.colour import ColourSettings, likeness, load
from stages.perception.rendering.paint import Paint
from stages.perception.rendering.rasteriser import View
from stages.scene.catalogue import Catalogue

_HOPELESS = 0.01
"""Confidence below which, whatever the photograph shows, an object is not there: it is not drawn."""
_YAW_STEP = np.deg2rad(30.0)
"""Between the turns about a continuous axis at which an object is compared with the photograph."""


class Likenesses:
    """How much photographs look as if objects of a catalogue were there."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._paints = {name: Paint.of(item.mesh) for name, item in catalogue.objects.items()}
        self._turns = {name: item.symmetries.transforms(_YAW_STEP) for name, item in catalogue.objects.items()}
        self._settings = ColourSettings()
        load()

    def __call__(
        self, rgb: NDArray[np.uint8], view: View, shown: NDArray[np.bool_], label: str, T_camera_object: Floats
    ) -> float:
        """Of an H x W x 3 image, in which the object is seen within ``shown`` (H x W) if it is there; as
        :func:`likeness`."""
        poses = compose(T_camera_object[None], self._turns[label])[:, :3]
        return likeness(rgb, view, shown, poses, paint=self._paints[label], settings=self._settings)


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
        from stages.perception.detection.alignment import aligned
        from stages.perception.detection.labels import Judge
        from stages.perception.detection.outline import faintness
        from stages.perception.detection.views import Views

        torch.set_num_threads(1)
        torch.set_deterministic_debug_mode("error")
        views = Views.of(config.catalogue, config.learned, place="appraiser.learned")
        self._judge, self._labels = Judge(views), views.labels
        self._appraisal, self._aligned, self._faintness = appraisal, aligned, faintness
        self._likenesses = Likenesses(Catalogue.shared(config.catalogue))

    def on_sightings(
        self, sightings: list[LoneEstimate], observation: Observation, ctx: Context
    ) -> Iterator[LoneEstimate]:
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
        rgb = self._aligned(observation.rgb, observation.depth)
        second = self._appraisal.second_confidences(self._judge, rgb, regions, columns)
        first = np.array([candidate.confidence for candidate, _, _ in found])
        explained = np.array([start.explained for _, start, _ in found])
        faint = self._faintness([glimpse for _, _, glimpse in found], rgb, observation.depth)
        rest = first, second, explained, faint
        hopes = self._appraisal.appraisal(*rest, np.full(len(found), np.nan)).confidences > _HOPELESS
        alike = np.full(len(found), np.nan)
        for i in np.flatnonzero(hopes).tolist():
            candidate, start, _ = found[i]
            if (region := regions[i]) is not None:
                shown = self._appraisal.visible_mask(region, view)
                alike[i] = self._likenesses(rgb, view, shown, candidate.label, start.T_camera_object)
        judged = self._appraisal.appraisal(*rest, alike)
        ctx.log(f"{int((judged.confidences > 0.5).sum())} of {len(found)} candidates are likely once looked at")
        for sighting, (candidate, _, _), region, confidence, share in zip(
            sightings, found, regions, judged.confidences.tolist(), judged.shares.tolist(), strict=True
        ):
            box = candidate.box if region is None else self._appraisal.visible_box(region)
            again = Candidate(label=candidate.label, box=box, confidence=confidence)
            yield msgspec.structs.replace(sighting, candidate=again, share=share)
