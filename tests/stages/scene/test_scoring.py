"""Perceived scenes against the truth."""

from pathlib import Path

import numpy as np
import pytest

from stages.messages.scene import SceneObject
from stages.scene.catalogue import Catalogue
from stages.scene.scoring import errors
from tests.stages.episodes import CATALOGUE, translation

OBJECTS = Catalogue.load(Path(CATALOGUE))


def turned(degrees: float, *, x: float = 0.0) -> np.ndarray:
    T = translation(x, 0, 0)
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    T[:2, :2] = [[c, -s], [s, c]]
    return T


def perceived(label: str, T: np.ndarray, name: str = "") -> SceneObject:
    return SceneObject(name=name or label, label=label, T_base_object=T)


def test_a_turned_mug_is_an_error_and_a_turned_bowl_is_none() -> None:
    truth = np.stack([np.eye(4), np.eye(4)])
    seen = [perceived("mug", turned(20, x=0.01)), perceived("bowl", turned(20, x=0.01))]
    mug, bowl = errors(("mug", "bowl"), truth, seen, OBJECTS)
    assert mug.position == pytest.approx(0.01) and np.rad2deg(mug.rotation) == pytest.approx(20)
    # Continuous symmetries are sampled, so up to half a sampling step remains.
    assert bowl.position == pytest.approx(0.01) and np.rad2deg(bowl.rotation) <= 2.5 + 1e-6


def test_an_object_without_a_perceived_one_of_its_label_is_not_found() -> None:
    (cup,) = errors(("cup",), np.eye(4)[None], [perceived("mug", np.eye(4))], OBJECTS)
    assert not cup.found and np.isnan(cup.position)


def test_instances_of_a_label_are_matched_by_distance_whatever_their_names() -> None:
    truth = np.stack([translation(0, 0, 0), translation(1, 0, 0)])
    seen = [perceived("cup", translation(1.02, 0, 0)), perceived("cup", translation(0.01, 0, 0), name="cup_2")]
    first, second = errors(("cup", "cup_2"), truth, seen, OBJECTS)
    assert (first.position, second.position) == pytest.approx((0.01, 0.02))


def test_one_perceived_object_answers_for_one_true_object() -> None:
    truth = np.stack([translation(0, 0, 0), translation(0.1, 0, 0)])
    scored = errors(("cup", "cup_2"), truth, [perceived("cup", translation(0.1, 0, 0))], OBJECTS)
    assert [item.found for item in scored] == [False, True]
