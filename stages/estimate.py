"""Perception as a library call: an image and a catalogue in, a scene out, without a graph or a runner."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from runner.contract import Context, Level, Message, Refused
from stages.appraiser import Appraiser
from stages.detector import Detector, ModelDetector
from stages.geometry.arrays import Floats
from stages.geometry.camera import checked_camera_pose, checked_depth, checked_intrinsics
from stages.geometry.lens import Lens
from stages.hypotheses import Hypotheses
from stages.messages import (
    Assertion,
    Candidate,
    Candidates,
    Frame,
    Hypothesis,
    ObjectPose,
    Observation,
    Posterior,
    SceneEstimate,
    SceneGraph,
)
from stages.messages.digest import Contender, LoneCandidate, LoneEstimate
from stages.messages.scene import UnknownRegion
from stages.particle_filter import ParticleFilter
from stages.ranker import Ranker
from stages.refiner import Refiner
from stages.scene.catalogue import Catalogue
from stages.scene_graph import SceneGraphBuilder

Box = tuple[str, Sequence[float]] | tuple[str, Sequence[float], float]
"""Label, (x0, y0, x1, y1) in pixels and, where it is not 1, confidence."""


@dataclass(frozen=True)
class EstimatedScene:
    """What one image shows."""

    estimate: SceneEstimate
    graph: SceneGraph

    @property
    def objects(self) -> tuple[ObjectPose, ...]:
        """Each with ``name``, ``label``, ``T_camera_object``, ``probability`` that this pose is right within 2 cm and
        15 degrees modulo symmetries, its spread, ``alternatives`` with their probabilities, and ``facing``: how likely
        its label faces as the pose says."""
        return self.estimate.objects

    @property
    def unknown(self) -> tuple[UnknownRegion, ...]:
        """What stands on the plane and no object explains, the largest first."""
        return self.estimate.unknown

    @property
    def relations(self) -> tuple[Assertion, ...]:
        """What exists, is clear, is on or in what; as text ``on(cup, tray)``."""
        return self.graph.assertions


class Detecting(Protocol):
    """What finds candidates: any detector stage."""

    def on_frame(self, frame: Frame, ctx: Context) -> Candidates:
        """The frame's candidates."""
        ...


def estimate_scene(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.floating[Any]],
    K: Floats,
    catalogue: Path | str,
    *,
    boxes: Sequence[Box] | None = None,
    detector: Detecting | None = None,
    n_objects: int | Literal["auto"] = "auto",
    dof: Literal[3, 6] = 6,
    device: Literal["auto", "cpu", "cuda"] = "cpu",
    T_base_camera: Floats | None = None,
    distortion: Sequence[float] = (),
) -> EstimatedScene:
    """The objects on the table in one image, where they are, and how they relate.

    ``rgb`` is H x W x 3, sRGB, ``depth`` H x W metres registered to it, 0 or not finite where there is no reading;
    ``K`` 3 x 3 without skew, pixel centres at integer coordinates; ``distortion`` are OpenCV's coefficients (k1 k2 p1
    p2 k3) of the lens that is still in both; boxes and poses are those of the straight image. ``catalogue`` is a YAML
    file or a BOP ``models`` folder.

    Candidates are the ``boxes``, else what ``detector`` finds, else what the network that comes with the package does;
    it knows the objects of its own catalogue. Of these the scene has ``n_objects``, or as many as explain the image
    best. ``dof=3`` takes objects to stand upright. Poses in the scene graph are in the table's frame without
    ``T_base_camera`` (4 x 4).

    The first call for a catalogue lays its objects out, which takes some seconds; equal calls give equal bytes.

    Raises:
        Refused: an input is not of its form, a label is not in the catalogue, or there is no support plane.
    """
    path = Path(catalogue)
    frame = _straightened(_frame(rgb, depth, K, T_base_camera), distortion)
    appraiser = None
    if boxes is None:
        candidates = (detector or _network(path)).on_frame(frame, Quiet())
        appraiser = _appraiser(path, detector.config.learned) if isinstance(detector, ModelDetector) else None
    else:
        candidates = _candidates(boxes, Catalogue.shared(path))
    hypotheses, filters, refiner, builder = _stages(path, n_objects, dof, device)
    # A ranker of its own: no name depends on an image before.
    estimator = SceneEstimator(hypotheses, filters, Ranker(Ranker.Config()), refiner, appraiser)
    observation, *_, final = estimator.messages(frame, candidates, Quiet())
    assert isinstance(observation, Observation) and isinstance(final, SceneEstimate)
    if observation.unusable:
        raise Refused(observation.unusable)
    return EstimatedScene(final, builder.on_scene_estimate(final))


class Filters(Protocol):
    """Particle filters that answer every part of a look, in order: in this process or in several."""

    def look(self, prospects: Sequence[LoneCandidate], observation: Observation) -> list[LoneEstimate]:
        """What the look at each candidate alone found."""
        ...

    def estimate(self, hypotheses: Sequence[Hypothesis], observation: Observation) -> list[Posterior]:
        """What became of each hypothesis."""
        ...


@dataclass(frozen=True)
class SceneEstimator:
    """The stages between candidates and the final scene, called one after the other."""

    hypotheses: Hypotheses
    filters: Filters
    ranker: Ranker
    refiner: Refiner
    appraiser: Appraiser | None = None
    """For candidates that come from meshes."""

    def messages(self, frame: Frame, candidates: Candidates, ctx: Context) -> Iterator[Message]:
        """Everything that the stages say of one image; the ranked scene and, last, the same scene refined."""
        observation, prospects = self._begun(frame, candidates, ctx)
        yield observation
        yield from prospects
        sightings = self.filters.look(prospects, observation)
        yield from sightings
        if self.appraiser is not None:
            sightings = list(self.appraiser.on_sightings(sightings, observation, ctx))
            yield from sightings
        found: list[Hypothesis | Contender] = list(self.hypotheses.on_sightings(sightings, ctx))
        while hypotheses := [part for part in found if isinstance(part, Hypothesis)]:
            yield from hypotheses
            posteriors = self.filters.estimate(hypotheses, observation)
            yield from posteriors
            found = list(self.hypotheses.on_posteriors(posteriors, ctx))
        contenders = [part for part in found if isinstance(part, Contender)]
        yield from contenders
        ranked = self.ranker.on_contenders(contenders, observation, ctx)
        yield ranked
        yield self.refiner.on_scene_estimate(ranked, observation, ctx)

    def _begun(self, frame: Frame, candidates: Candidates, ctx: Context) -> tuple[Observation, list[LoneCandidate]]:
        observation, *rest = self.hypotheses.on_candidates(frame, candidates, ctx)
        assert isinstance(observation, Observation)
        return observation, [part for part in rest if isinstance(part, LoneCandidate)]


@dataclass(frozen=True)
class FiltersHere:
    """One particle filter, in this process."""

    stage: ParticleFilter

    def look(self, prospects: Sequence[LoneCandidate], observation: Observation) -> list[LoneEstimate]:
        """One look after the other."""
        return [self.stage.on_prospect(prospect, observation, Quiet()) for prospect in prospects]

    def estimate(self, hypotheses: Sequence[Hypothesis], observation: Observation) -> list[Posterior]:
        """One hypothesis after the other."""
        return [self.stage.on_hypothesis(hypothesis, observation, Quiet()) for hypothesis in hypotheses]


class Quiet:
    """The context of a step outside a graph; what stages say is for a run's terminal."""

    time_ns = 0
    directory = Path()

    def __init__(self, seed: int | Sequence[int] = 0) -> None:
        self.rng = np.random.default_rng(seed)

    def log(self, text: str, *, level: Level = "info") -> None:
        """Says nothing."""


@lru_cache(maxsize=4)
def _stages(
    catalogue: Path, n_objects: int | Literal["auto"], dof: Literal[3, 6], device: Literal["auto", "cpu", "cuda"]
) -> tuple[Hypotheses, Filters, Refiner, SceneGraphBuilder]:
    """What takes time to lay out, for the calls that follow."""
    return (
        Hypotheses(Hypotheses.Config(n_objects=n_objects)),
        FiltersHere(ParticleFilter(ParticleFilter.Config(catalogue=catalogue, dof=dof, device=device))),
        Refiner(Refiner.Config(catalogue=catalogue, dof=dof)),
        SceneGraphBuilder(SceneGraphBuilder.Config(catalogue=catalogue)),
    )


@lru_cache(maxsize=4)
def _appraiser(catalogue: Path, learned: Path | None) -> Appraiser:
    """Judges what the detector by meshes finds."""
    return Appraiser(Appraiser.Config(catalogue=catalogue, learned=learned))


@lru_cache(maxsize=4)
def _network(catalogue: Path) -> Detector:
    try:
        return Detector(Detector.Config(labels=tuple(Catalogue.shared(catalogue).objects)))
    except Refused as refusal:
        raise Refused(f"{refusal}; give boxes, or a detector that knows the catalogue's objects") from None


def _frame(rgb: NDArray[np.uint8], depth: NDArray[np.floating[Any]], K: Floats, T_base_camera: Floats | None) -> Frame:
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.size == 0:
        raise Refused(f"rgb is {rgb.dtype} {rgb.shape}; H x W x 3 of uint8 is expected, of a pixel or more")
    if depth.shape != rgb.shape[:2] or not np.issubdtype(depth.dtype, np.floating):
        raise Refused(f"depth is {depth.dtype} {depth.shape}; {rgb.shape[:2]} of floats, metres, is expected")
    if np.shape(K) != (3, 3):
        raise Refused(f"K is {np.shape(K)}; 3 x 3 is expected")
    try:
        metres, pinhole = checked_depth(np.ascontiguousarray(depth, np.float32)), checked_intrinsics(np.array(K, float))
    except ValueError as error:
        raise Refused(str(error)) from None
    try:
        placed = None if T_base_camera is None else checked_camera_pose(np.array(T_base_camera, float))
    except ValueError as error:
        raise Refused(f"T_base_camera: {error}") from None
    return Frame(
        rgb=np.ascontiguousarray(rgb), depth=metres, K=pinhole,
        T_base_camera=placed, robot_mask=None,
        name="image", index=0, total=1,
    )  # fmt: skip


def _straightened(frame: Frame, distortion: Sequence[float]) -> Frame:
    try:
        rgb, depth = Lens(frame.K, frame.depth.shape, distortion).straighten(frame.rgb, frame.depth)
    except ValueError as error:
        raise Refused(f"distortion: {error}") from None
    return msgspec.structs.replace(frame, rgb=rgb, depth=depth)


def _candidates(boxes: Sequence[Box], catalogue: Catalogue) -> Candidates:
    found = [
        Candidate(
            label=catalogue[label].name,
            box=np.array(box, float),
            confidence=float(confidence[0]) if confidence else 1.0,
        )
        for label, box, *confidence in boxes
    ]
    labels = tuple(dict.fromkeys(item.label for item in found))
    confidences = np.zeros((len(found), len(labels)))
    for row, item in zip(confidences, found, strict=True):
        finite = item.box.shape == (4,) and np.isfinite(item.box).all()
        if not finite or (item.box[2:] <= item.box[:2]).any():
            raise Refused(f"box of {item.label}: {item.box.tolist()} is not x0, y0, x1, y1 with x0 < x1 and y0 < y1")
        if not 0 <= item.confidence <= 1:
            raise Refused(f"box of {item.label}: confidence {item.confidence:g} must lie from 0 to 1")
        row[labels.index(item.label)] = item.confidence
    return Candidates(candidates=tuple(found), labels=labels, confidences=confidences)
