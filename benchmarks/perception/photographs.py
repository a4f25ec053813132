"""What becomes of each object in photographs without boxes: `python -m benchmarks.photographs DATASET...`.

Nobody says how many objects there are. Prints which stage lost each object that shows at least a third of itself, what
every false object is, and the table. ``--half`` takes every other object out of the catalogue: those are unknown then,
and must not be taken for what they are like. ``--camera SEED`` changes light, sharpness, noise, depth scale and
registration of every frame, as with a camera that is not here.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, Truth, detections_file, images
from benchmarks.common.variations import Objects, by_another_camera, half
from benchmarks.comparison.accuracy import Claims, Score, described, score
from runner.contract import Message
from runner.process.step import step_seed
from stages.appraiser import Appraiser
from stages.detector import ModelDetector
from stages.devices.bop_results import Result
from stages.estimate import FiltersHere, Quiet, SceneEstimator
from stages.hypotheses import Hypotheses
from stages.messages import Candidates, Posterior, SceneEstimate
from stages.messages.digest import LoneEstimate
from stages.particle_filter import ParticleFilter
from stages.perception.detection.boxes import intersection_over_union
from stages.perception.detection.views import Views
from stages.ranker import Ranker
from stages.refiner import Refiner
from stages.scene.catalogue import Catalogue

_SHOWN = 1 / 3
_NEAR = 0.04
"""Metres from the truth within which a stage had an object."""


@dataclass(frozen=True)
class Seen:
    """One image and what every stage said of it."""

    candidates: Candidates
    messages: tuple[Message, ...]
    seconds: float
    """Of processor time."""

    @property
    def scene(self) -> SceneEstimate:
        """What it comes to."""
        final = self.messages[-1]
        assert isinstance(final, SceneEstimate)
        return final


class Photographs:
    """The stages of `graphs/photos.yaml` in one process, with the seeds of its runner."""

    def __init__(self, objects: Objects) -> None:
        catalogue, learned = objects.catalogue, objects.learned
        self._detector = ModelDetector(ModelDetector.Config(catalogue=catalogue, learned=learned))
        self._estimator = SceneEstimator(
            Hypotheses(Hypotheses.Config(n_objects="auto")),
            FiltersHere(ParticleFilter(ParticleFilter.Config(catalogue=catalogue))),
            Ranker(Ranker.Config()),
            Refiner(Refiner.Config(catalogue=catalogue)),
            Appraiser(Appraiser.Config(catalogue=catalogue, learned=learned)),
        )

    def __call__(self, image: Image) -> Seen:
        """All that is said of an image."""
        cause, began = f"camera.frame#{image.frame.index}", time.process_time()
        candidates = self._detector.on_frame(image.frame, Quiet(step_seed(0, "detector", cause)))
        ctx = Quiet(step_seed(0, "hypotheses", cause))
        messages = tuple(self._estimator.messages(image.frame, candidates, ctx))
        return Seen(candidates, messages, time.process_time() - began)


def lost(one: Score, seen: Seen, name: str) -> str:
    """The stage that lost an object which is not within 2 cm and 15 degrees, in words."""
    if one.result is not None and one.metres < 2 * _NEAR:
        return f"its pose is wrong: {described(one)}"
    looks = [m for m in seen.messages if isinstance(m, LoneEstimate) and m.candidate and m.candidate.label == name]
    near = [look for look in looks if look.start and _apart(look.start.T_camera_object, one.truth) < _NEAR]
    if not near:
        boxes = np.array([c.box for c in seen.candidates.candidates if c.label == name]).reshape(-1, 4)
        assert one.truth.box is not None
        framed = intersection_over_union(one.truth.box[None], boxes).max(initial=0.0) > 0.5
        return "the look at its candidate ends elsewhere" if framed else "it has no candidate"
    if near[-1].share >= 1:
        return f"refuted by its looks: {_judged(near[-1])}"
    scenes = [m for m in seen.messages if isinstance(m, Posterior)]
    estimated = any(o.label == name and _apart(o.T_camera_object, one.truth) < _NEAR for s in scenes for o in s.objects)
    return f"{'outweighed' if estimated else 'in no hypothesis'}: {_judged(near[-1])}"


def _apart(T: np.ndarray, truth: Truth) -> float:
    return float(np.linalg.norm(T[:3, 3] - truth.T_camera_object[:3, 3]))


def _judged(look: LoneEstimate) -> str:
    assert look.candidate and look.start
    likely, explained, asked = look.candidate.confidence, look.start.explained, max(look.share, 0.0)
    return f"likely {likely:.2f}, explains {explained:.2f}, asked for {asked:.2f}"


def scored(image: Image, seen: Seen, catalogue: Catalogue) -> tuple[list[Score], list[Result], list[str]]:
    """Scores of the objects of a catalogue, the results, and a line for each that is false."""
    numbers = {name: item.label for name, item in catalogue.objects.items()}
    results = [Result.of(seen.scene, item, numbers[item.label], seen.seconds) for item in seen.scene.objects]
    scores = score([truth for truth in image.truths if truth.label in numbers.values()], results, catalogue)
    used = [one.result for one in scores]
    false = [f"{item.label}, called {item.probability:.2f}, at {np.round(item.box).astype(int).tolist()}"
             for item, result in zip(seen.scene.objects, results, strict=True)
             if not any(result is each for each in used)]  # fmt: skip
    return scores, results, false


@command
def main() -> int:
    """Prints a line for every object that is lost or false, and the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", type=Path, nargs="+", help="BOP data set folders with the truth")
    parser.add_argument("--learned", type=Path, help="by default the catalogue is learned now and kept in the cache")
    parser.add_argument("--half", choices=("odd", "even"), help="objects of the catalogue that stay")
    parser.add_argument("--camera", type=int, metavar="SEED")
    parser.add_argument("--scenes", type=int, nargs="+", help="by default all")
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for dataset in options.datasets:
            objects = Objects(dataset / "models", options.learned)
            if options.half:
                views = Views.of(objects.catalogue, objects.learned, place="--learned")
                objects = half(objects.catalogue, views, options.half == "odd", Path(folder) / dataset.name)
            catalogue, stages = Catalogue.shared(objects.catalogue), Photographs(objects)
            for image in images(dataset, detections_file(dataset, "exact")):
                if options.scenes is None or image.id[0] in options.scenes:
                    counts += _judge(image, options.camera, stages, catalogue)
    print(f"right {counts['right']} of {counts['objects']}, false {counts['false']} in {counts['images']} images, "
          f"right {counts['sure_right']} of {counts['sure']} called 0.9 and more")  # fmt: skip
    return 0


def _judge(image: Image, camera: int | None, stages: Photographs, catalogue: Catalogue) -> Counter[str]:
    if camera is not None:
        frame, farther = by_another_camera(image.frame, camera)
        image = replace(image, frame=frame, truths=tuple(_moved(truth, farther) for truth in image.truths))
    names = {item.label: name for name, item in catalogue.objects.items()}
    seen = stages(image)
    scores, results, false = scored(image, seen, catalogue)
    print(f"{image.frame.name}: {len(seen.scene.objects)} objects, {len(seen.scene.log_weights)} hypotheses, "
          f"{seen.seconds:.1f} s", flush=True)  # fmt: skip
    for one in scores:
        if one.truth.visible >= _SHOWN and not one.within(0.02, 15):
            print(f"  {names[one.truth.label]} lost; {lost(one, seen, names[one.truth.label])}")
    for line in false:
        print(f"  false: {line}")
    shown = [one for one in scores if one.truth.visible >= _SHOWN]
    claims = Claims.of(scores, results)
    return Counter(images=1, objects=len(shown), right=sum(one.within(0.02, 15) for one in shown), false=claims.false,
                   sure=claims.sure, sure_right=claims.sure_right)  # fmt: skip


def _moved(truth: Truth, farther: float) -> Truth:
    T = truth.T_camera_object.copy()
    T[:3, 3] *= farther
    return replace(truth, T_camera_object=T)


if __name__ == "__main__":
    raise SystemExit(main())
