"""Frame in, candidate boxes out: by the trained network, by the objects' meshes, or as a file has them."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Literal

import numpy as np

from runner.contract import Context, Refused, Stage
from stages.devices.bop_detections import Detection, read_detections
from stages.geometry.arrays import Floats
from stages.messages import Candidate, Candidates, Frame
from stages.perception.hypotheses.duplicates import SHARED, shared, unrepeated
from stages.scene.catalogue import Catalogue

_FAR = np.float32(100.0)
"""Metres: the robot's own body is put where no object is looked for."""
_SURE = 0.9
"""Confidence from which on the network knows a label. Little of an object, it takes for another one at less."""
_OTHERS = 8
"""Labels by which a candidate in doubt is known beside its own: as many as a round of the search tries."""
_WEIGHTS = Path(__file__).parent / "perception" / "detector.safetensors"


class Detector(Stage):
    """Looks for the objects that the network was trained on."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings; a candidate is kept when its best label reaches ``threshold``."""

        weights: Path = _WEIGHTS
        threshold: float = 0.3
        expected: int | Literal["auto"] = "auto"
        """Objects known to be there; ``auto`` where nobody knows. Then, or where fewer reach the threshold, what
        reaches ``floor`` is kept too: an object that is mostly hidden is better doubted than missed."""
        floor: float = 0.05
        max_boxes: int = 12
        labels: tuple[str, ...] = ()
        """Objects to look for; empty for all that the network knows."""

        def __post_init__(self) -> None:
            if not 0 < self.threshold < 1:
                raise Refused(f"detector.threshold = {self.threshold}: must lie between 0 and 1")
            if not 0 < self.floor <= self.threshold:
                raise Refused(f"detector.floor = {self.floor}: must lie above 0 and up to threshold = {self.threshold}")
            if self.expected != "auto" and self.expected < 0:
                raise Refused(f"detector.expected = {self.expected}: must be 0 or more, or auto")
            if self.max_boxes < 1:
                raise Refused(f"detector.max_boxes = {self.max_boxes}: must be at least 1")

    @classmethod
    def prepare(cls, config: Config) -> None:
        """Loads torch, which takes a second: for the refiner too, where there is one."""
        import_module("torch")

    def __init__(self, config: Config) -> None:
        # Whoever only reads a graph does without.
        import torch

        from stages.perception.detection.trained.network import DetectionNetwork, detect

        # Sums over several threads are added in another order, which a replay would show as a difference.
        torch.set_num_threads(1)
        # As use_deterministic_algorithms(True), which loads torch's compiler first and takes a second for it.
        torch.set_deterministic_debug_mode("error")
        self._config = config
        self._network, self._detect = DetectionNetwork.load(config.weights), detect
        unknown = sorted(set(config.labels) - set(self._network.labels))
        if unknown:
            known = ", ".join(self._network.labels)
            raise Refused(
                f"detector.labels: {config.weights.name} does not know {', '.join(unknown)} (it knows {known})"
            )

    def on_frame(self, frame: Frame, ctx: Context) -> Candidates:
        """The frame's candidates, most confident first."""
        labels = self._config.labels or self._network.labels
        columns = [self._network.labels.index(label) for label in labels]
        config = self._config
        found = self._detect(self._network, frame.rgb, threshold=config.floor, keep=config.max_boxes, labels=columns)
        sure = int((found.scores >= config.threshold).sum())
        # A second box of one object, or one of its part, is no other object.
        objects = len(unrepeated([labels[i] for i in found.confidences[:sure].argmax(1)], [*found.boxes]))
        kept = slice(sure if config.expected != "auto" and objects >= config.expected else None)
        message = _candidates(found.boxes[kept], found.confidences[kept], labels, others=_OTHERS)
        ctx.log(f"{frame.name}: " + (_summary(message) or "no object found"))
        return message


class ModelDetector(Stage):
    """Looks for the objects of a catalogue in RGB-D photographs by their meshes: no network is trained.

    A box comes once for every label that it may well have, each time with the confidences of all labels.
    """

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings."""

        catalogue: Path
        learned: Path | None = None
        """What ``python -m stages.perception.detection.learn`` made of the catalogue; None learns it at the start,
        which takes minutes the first time, and keeps it in the user's cache."""
        max_candidates: int = 20
        floor: float = 0.0
        """Confidence below which a candidate is left out."""

        def __post_init__(self) -> None:
            if self.max_candidates < 1:
                raise Refused(f"detector.max_candidates = {self.max_candidates}: must be at least 1")
            if not 0 <= self.floor < 1:
                raise Refused(f"detector.floor = {self.floor}: must lie from 0 to below 1")

    def __init__(self, config: Config) -> None:
        import cv2
        import torch

        from stages.perception.detection.propose import Proposer
        from stages.perception.detection.views import Views

        # As for the network above: superpixels are sums too.
        cv2.setNumThreads(1)
        torch.set_num_threads(1)
        torch.set_deterministic_debug_mode("error")
        self.config = config
        self._proposer = Proposer(Views.of(config.catalogue, config.learned, place="detector.learned"))

    def on_frame(self, frame: Frame, ctx: Context) -> Candidates:
        """The frame's candidates, most confident first."""
        depth = np.where(np.isfinite(frame.depth), frame.depth, np.float32(0))
        if frame.robot_mask is not None:
            depth[frame.robot_mask] = _FAR
        up = None if frame.T_base_camera is None else frame.T_base_camera[2, :3]
        found = self._proposer.propose(frame.rgb, depth, frame.K, ctx.rng, up=up, most=self.config.max_candidates)
        labels = self._proposer.labels
        rows = zip(found.boxes, found.labels, found.confidences, strict=True)
        candidates = tuple(Candidate(box=box, label=labels[k], confidence=float(row[k])) for box, k, row in rows)
        kept = [i for i, candidate in enumerate(candidates) if candidate.confidence >= self.config.floor]
        message = Candidates(
            candidates=tuple(candidates[i] for i in kept), labels=labels, confidences=found.confidences[kept]
        )
        ctx.log(f"{frame.name}: " + (_summary(message) or "no object found"))
        return message


class RecordedDetections(Stage):
    """Answers each frame with the boxes that a BOP-format detections file holds for it."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """A detections file, and the catalogue that names its categories."""

        detections: Path
        catalogue: Path
        stride: int = 1
        """The camera's: boxes are in pixels of the whole image, of which it may give every so many rows and columns."""

        def __post_init__(self) -> None:
            if self.stride < 1:
                raise Refused(f"detector.stride = {self.stride}: must be 1 (all pixels) or more")

    def __init__(self, config: Config) -> None:
        names = {item.label: name for name, item in Catalogue.load(config.catalogue).objects.items()}
        self._labels = tuple(names.values())
        self._name, self._stride = config.detections.name, config.stride
        self._images: dict[tuple[int, int], list[Detection]] = defaultdict(list)
        for detection in read_detections(config.detections, names):
            self._images[detection.scene_id, detection.image_id].append(detection)

    def on_frame(self, frame: Frame, ctx: Context) -> Candidates:
        """The file's boxes for this image, in the file's order."""
        detections = self._images.get((frame.scene_id, frame.image_id), [])
        if not detections:
            ctx.log(f"{self._name} has no box for scene {frame.scene_id} image {frame.image_id}", level="warning")
        confidences = np.zeros((len(detections), len(self._labels)))
        for row, detection in zip(confidences, detections, strict=True):
            row[self._labels.index(detection.label)] = detection.score
        candidates = tuple(
            Candidate(box=item.box / self._stride, label=item.label, confidence=item.score) for item in detections
        )
        return Candidates(candidates=candidates, labels=self._labels, confidences=confidences)


def _candidates(boxes: Floats, confidences: Floats, labels: tuple[str, ...], *, others: int) -> Candidates:
    """Equation 1: each box with its most confident label, and with up to so many ``others`` where that is in doubt.

    Of these, labels that are surely seen come last: most objects are there once. But what is surely seen in a box about
    this one comes first: two equal objects, of which one hides part of the other, the detector frames as one.
    """
    best, score = confidences.argmax(1), confidences.max(1, initial=0.0)
    sure = np.flatnonzero(score >= _SURE)
    ranks = np.zeros(confidences.shape)
    ranks[:, best[sure]] = 1
    for rank, box in zip(ranks, boxes, strict=True):
        rank[[best[k] for k in sure if shared(boxes[k], box) > SHARED]] = -1
    orders = np.lexsort((-confidences, ranks))
    candidates = tuple(
        Candidate(
            box=box,
            label=labels[first],
            confidence=float(row[first]),
            others=() if row[first] >= _SURE else tuple([labels[k] for k in order if k != first][:others]),
        )
        for box, row, first, order in zip(boxes, confidences, best, orders, strict=True)
    )
    return Candidates(candidates=candidates, labels=labels, confidences=confidences)


def _summary(message: Candidates) -> str:
    return ", ".join(f"{candidate.label} {candidate.confidence:.2f}" for candidate in message.candidates)
