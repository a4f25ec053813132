"""How well a look tells right candidates from wrong ones: `python -m benchmarks.appraisal DATASET ... --without LABEL`.

Fits the log-odds of `stages/perception/detection/appraisal.py` to the candidates of all images, and again leaving each
sensor out. ``--without`` leaves an object out, of which look-alikes stand in the images. Each image is looked at with
the whole catalogue, with either half of it, to which the objects of the other half are unknown, and as another camera
would see it.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, Truth, detections_file, images
from benchmarks.common.variations import Objects, by_another_camera, half
from benchmarks.perception.candidates import sensor_of
from runner.process.step import step_seed
from stages.appraiser import Likenesses
from stages.detector import ModelDetector
from stages.devices.bop import read_dataset
from stages.estimate import Quiet
from stages.geometry.arrays import Floats
from stages.hypotheses import Hypotheses
from stages.messages import Observation
from stages.messages.digest import LoneCandidate, LoneEstimate
from stages.particle_filter import ParticleFilter
from stages.perception.detection.alignment import aligned
from stages.perception.detection.appraisal import (
    ALIKE,
    EXPLAINED,
    FAINT,
    bounded_likeness,
    log_odds,
    second_confidences,
    silhouette,
    visible_mask,
)
from stages.perception.detection.boxes import intersection_over_union
from stages.perception.detection.labels import Judge
from stages.perception.detection.outline import faintness
from stages.perception.detection.views import Views
from stages.perception.rendering.rasteriser import View
from stages.scene.catalogue import Catalogue

_NEAR = 0.03
"""Metres between the middles of a found object and the true one of its label."""
_OVERLAP = 0.3
"""A box that overlaps a true one of its label by more, of an object that was found elsewhere, is neither right nor
wrong."""
_RIDGE = 0.3
_STEP = 0.2
"""Of the share that is explained: what counts as one unit, so that the ridge weighs on all terms alike."""
TERMS = (
    "before the look",
    "within the silhouette",
    "explained, a fifth",
    "faint outline, a fifth",
    "as if it were there",
)


@dataclass(frozen=True)
class Case:
    """One candidate."""

    sensor: str
    evidence: Floats
    """1, then what :data:`TERMS` says."""
    right: bool


def variations(dataset: Path, without: Sequence[str], learned: Path | None, camera: int) -> Iterator[Case]:
    """The candidates of a data set by the whole catalogue, by either half of it, and by another camera."""
    whole = Objects(dataset / "models", learned)
    yield from cases(dataset, without, whole)
    views = Views.of(whole.catalogue, learned, place="--learned")
    for odd in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            yield from cases(dataset, without, half(whole.catalogue, views, odd, Path(folder)))
    yield from cases(dataset, without, whole, camera)


def cases(dataset: Path, without: Sequence[str], objects: Objects, camera: int | None = None) -> Iterator[Case]:
    """Every candidate of a data set that is right or wrong."""
    path, learned = objects.catalogue, objects.learned
    catalogue, views = Catalogue.shared(path), Views.of(path, learned, place="--learned")
    detector = ModelDetector(ModelDetector.Config(catalogue=path, learned=learned))
    filters, judge = ParticleFilter(ParticleFilter.Config(catalogue=path)), Judge(views)
    likenesses = Likenesses(catalogue)
    sensors = {(image.scene_id, image.image_id): sensor_of(image) for image in read_dataset(dataset)}
    for taken in images(dataset, detections_file(dataset, "exact")):
        frame, farther = (taken.frame, 1.0) if camera is None else by_another_camera(taken.frame, camera)
        image = replace(taken, frame=frame)
        observation, sightings = _looked(image, detector, filters)
        view = View.of(observation.K, *observation.depth.shape[::-1])
        found = [(s.candidate, s.start, s.glimpse) for s in sightings if s.candidate and s.start and s.glimpse]
        regions = [silhouette(each[2], observation.depth, view, observation.T_camera_table) for each in found]
        labels = [views.labels.index(candidate.label) for candidate, _, _ in found]
        rgb = aligned(observation.rgb, observation.depth)
        second = second_confidences(judge, rgb, regions, labels)
        faint = np.nan_to_num(faintness([glimpse for _, _, glimpse in found], rgb, observation.depth), nan=FAINT)
        for (candidate, start, _), region, again, outline in zip(found, regions, second, faint, strict=True):
            alike = np.nan
            if region is not None:
                shown = visible_mask(region, view)
                alike = likenesses(rgb, view, shown, candidate.label, start.T_camera_object)
            item = catalogue[candidate.label]
            truths = [truth for truth in image.truths if truth.label == item.label]
            middle = item.bounds.mean(0)
            right = any(_apart(start.T_camera_object, truth, middle, farther) < _NEAR for truth in truths)
            boxes = np.array([truth.box for truth in truths]).reshape(-1, 4)
            touches = intersection_over_union(candidate.box[None], boxes).max(initial=0.0) > _OVERLAP
            if candidate.label not in without and (right or not touches):
                odds = log_odds(np.array([candidate.confidence, again]))
                shares = (start.explained - EXPLAINED) / _STEP, (outline - FAINT) / _STEP
                paint = np.nan_to_num(bounded_likeness(np.array(alike)) - ALIKE)
                yield Case(sensors[image.id], np.array([1.0, *odds, *shares, paint]), right)


def _looked(
    image: Image, detector: ModelDetector, filters: ParticleFilter
) -> tuple[Observation, list[LoneEstimate]]:  # fmt: skip
    cause = f"camera.frame#{image.frame.index}"
    candidates = detector.on_frame(image.frame, Quiet(step_seed(0, "detector", cause)))
    search = Hypotheses(Hypotheses.Config(n_objects="auto"))
    observation, *rest = search.on_candidates(image.frame, candidates, Quiet(step_seed(0, "hypotheses", cause)))
    assert isinstance(observation, Observation)
    return observation, [
        filters.on_prospect(part, observation, Quiet()) for part in rest if isinstance(part, LoneCandidate)
    ]


def _apart(T: Floats, truth: Truth, middle: Floats, farther: float) -> float:
    there = truth.T_camera_object[:3, :3] @ middle + farther * truth.T_camera_object[:3, 3]
    return float(np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - there))


def fitted(chosen: Sequence[Case], terms: Sequence[int]) -> Floats:
    """Weights of greatest likelihood (logistic regression with a small ridge, Newton's method)."""
    X, right = _design(chosen, terms), np.array([case.right for case in chosen], float)
    weights, ridge = np.zeros(X.shape[1]), _RIDGE * np.append(0.0, np.ones(len(terms)))
    for _ in range(50):
        p = 1 / (1 + np.exp(-X @ weights))
        slope = X.T @ (p - right) + ridge * weights
        weights -= np.linalg.solve((X.T * (p * (1 - p))) @ X + np.diag(ridge + 1e-9), slope)
    return weights


def _design(chosen: Sequence[Case], terms: Sequence[int]) -> Floats:
    return np.array([case.evidence for case in chosen])[:, [0, *(1 + term for term in terms)]]


def errors(chosen: Sequence[Case], weights: Floats, terms: Sequence[int]) -> tuple[int, int]:
    """Right candidates that are called wrong, and wrong ones that are called right."""
    likely, right = _design(chosen, terms) @ weights > 0, np.array([case.right for case in chosen])
    return int((right & ~likely).sum()), int((~right & likely).sum())


@command
def main() -> int:
    """Prints weights and errors of several choices of terms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("datasets", type=Path, nargs="+", help="BOP data set folders with boxes of the truth")
    parser.add_argument("--without", action="append", default=[], metavar="LABEL")
    parser.add_argument("--learned", type=Path, help="by default the catalogue is learned now and kept in the cache")
    parser.add_argument("--camera", type=int, default=1, metavar="SEED", help="the other camera")
    options = parser.parse_args()
    chosen = [case for dataset in options.datasets
              for case in variations(dataset, options.without, options.learned, options.camera)]  # fmt: skip
    sensors = sorted({case.sensor for case in chosen})
    print(f"{len(chosen)} candidates, {sum(case.right for case in chosen)} right; sensors: {', '.join(sensors)}")
    for terms in (range(count) for count in range(1, len(TERMS) + 1)):
        weights = fitted(chosen, terms)
        parts = [([c for c in chosen if c.sensor != s], [c for c in chosen if c.sensor == s]) for s in sensors]
        left_out = np.sum([errors(test, fitted(train, terms), terms) for train, test in parts], axis=0)
        missed, kept = errors(chosen, weights, terms)
        print(f"{', '.join(TERMS[term] for term in terms)}: weights {np.round(weights, 2).tolist()}, {missed} missed, "
              f"{kept} wrong kept; each sensor left out: {left_out[0]} missed, {left_out[1]} wrong kept")  # fmt: skip
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
