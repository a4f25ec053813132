"""What objects show at their poses says which candidates are real; all from meshes, on a rendered photograph."""

from pathlib import Path

import numpy as np
import pytest

from stages.appraiser import Appraiser
from stages.devices.clutter import write_models
from stages.estimate import FiltersHere, SceneEstimator
from stages.hypotheses import Hypotheses
from stages.messages import Candidate, Candidates, Hypothesis, SceneEstimate
from stages.messages.digest import LoneEstimate
from stages.particle_filter import ParticleFilter
from stages.perception.detection.boxes import intersection_over_union
from stages.ranker import Ranker
from stages.refiner import Refiner
from tests.stages.episodes import Recorded
from tests.stages.perception.detection.scenes import NAMES, OBJECTS, photograph, views

SHOWN = ("cereal_box", "bowl")


def doubtful() -> Candidates:
    """Loose boxes of both objects, and of each with a wrong label that is called more likely; one of nothing."""
    boxes = {name: box + np.array([-4.0, -4.0, 6.0, 6.0]) for name, box in photograph(*SHOWN).boxes.items()}
    named = [("cereal_box", boxes["cereal_box"], 0.5), ("sauce_bottle", boxes["cereal_box"], 0.6),
             ("bowl", boxes["bowl"], 0.4), ("cereal_box", boxes["bowl"], 0.45),
             ("bowl", np.array([5.0, 180.0, 60.0, 230.0]), 0.3)]  # fmt: skip
    found = tuple(Candidate(label=label, box=box, confidence=confidence) for label, box, confidence in named)
    return Candidates(candidates=found, labels=NAMES, confidences=np.zeros((len(found), len(NAMES))))


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    views().save(folder / "views.safetensors")
    write_models(folder / "models", OBJECTS)
    return folder / "models"


@pytest.fixture(scope="module")
def messages(models: Path) -> list:
    estimator = SceneEstimator(
        Hypotheses(Hypotheses.Config(n_objects="auto")),
        FiltersHere(ParticleFilter(ParticleFilter.Config(catalogue=models))),
        Ranker(Ranker.Config()),
        Refiner(Refiner.Config(catalogue=models)),
        Appraiser(Appraiser.Config(catalogue=models, learned=models.with_name("views.safetensors"))),
    )
    return list(estimator.messages(photograph(*SHOWN).frame(), doubtful(), Recorded()))


def test_right_labels_are_likely_and_wrong_ones_are_not(messages: list) -> None:
    sightings = [message for message in messages if isinstance(message, LoneEstimate)]
    before, after = sightings[: len(sightings) // 2], sightings[len(sightings) // 2 :]
    judged = {(b.candidate.label, b.candidate.confidence): a for b, a in zip(before, after, strict=True)}
    right = [judged["cereal_box", 0.5], judged["bowl", 0.4]]
    wrong = [judged["sauce_bottle", 0.6], judged["cereal_box", 0.45], judged["bowl", 0.3]]
    assert min(s.candidate.confidence for s in right) > 0.5 > max(s.candidate.confidence for s in wrong)
    assert max(s.share for s in right) < min(s.share for s in wrong)


def test_boxes_become_those_of_what_is_visible(messages: list) -> None:
    for sighting in (m for m in messages if isinstance(m, LoneEstimate) and m.share < 0.5 and m.share != 0.1):
        box = photograph(*SHOWN).boxes[sighting.candidate.label]
        assert intersection_over_union(box[None], sighting.candidate.box[None])[0, 0] > 0.85


def test_the_scene_has_the_objects_and_no_others(messages: list) -> None:
    assert sum(isinstance(message, Hypothesis) for message in messages) > 2
    final = messages[-1]
    assert isinstance(final, SceneEstimate)
    assert sorted(item.label for item in final.objects) == sorted(SHOWN)
