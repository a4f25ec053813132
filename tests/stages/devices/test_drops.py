"""Dropped objects come to rest on, in and against each other, and layouts repeat."""

from pathlib import Path

import numpy as np
import pytest

from stages.devices.drops import Thing, distractors, random_layout, settle, things
from stages.perception.detection.trained.training_images import DISTRACTOR
from stages.scene.catalogue import Catalogue

CATALOGUE = Path(__file__).parents[3] / "stages/scene/catalogue.yaml"


@pytest.fixture(scope="module")
def known() -> list[Thing]:
    return things(Catalogue.load(CATALOGUE))


def lifted(height: float, x: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3], pose[2, 3] = x, height
    return pose


def test_a_can_dropped_on_a_box_rests_on_it(known: list[Thing]) -> None:
    names = list(Catalogue.load(CATALOGUE).objects)
    tea, can = known[names.index("tea_box")], known[names.index("tuna_can")]
    heights = [float(np.ptp(thing.mesh.vertices[:, 2])) for thing in (tea, can)]
    low = [float(thing.mesh.vertices[:, 2].min()) for thing in (tea, can)]
    box, upper = settle([tea, can], [lifted(0.005 - low[0]), lifted(heights[0] + 0.01 - low[1])])
    assert box[2, 3] + low[0] == pytest.approx(0, abs=0.003)
    assert upper[2, 3] + low[1] == pytest.approx(heights[0], abs=0.003)


def test_layouts_repeat_and_rest_above_the_table(known: list[Thing]) -> None:
    other = distractors(known, np.random.default_rng(1), count=6)
    first, again = (random_layout(known, other, np.random.default_rng(11)) for _ in range(2))
    assert len(first.bodies) >= 2
    for body, same in zip(first.bodies, again.bodies, strict=True):
        np.testing.assert_array_equal(body.T_table_object, same.T_table_object)
        lowest = (body.mesh.vertices @ body.T_table_object[2, :3] + body.T_table_object[2, 3]).min()
        assert -0.01 < lowest < 0.3


def test_distractors_never_carry_a_label_and_look_different(known: list[Thing]) -> None:
    other = distractors(known, np.random.default_rng(2), count=20)
    assert len(other) > 10 and all(thing.label == DISTRACTOR for thing in other)
    for thing in other:
        twins = [one for one in known if np.array_equal(one.mesh.vertices, thing.mesh.vertices)]
        for twin in twins:
            assert np.abs(twin.mesh.colors.astype(int) - thing.mesh.colors).mean() >= 50
