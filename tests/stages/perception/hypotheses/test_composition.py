"""What composed scenes cost, what they must cost, and the ranking at first look."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.geometry.arrays import Floats
from stages.geometry.poses import random_rotations
from stages.messages.digest import PATCH_STRIDE, LonePose, ParticleTrace
from stages.perception.filter.likelihood import CostForm, Shape
from stages.perception.hypotheses.combinations import cheapest
from stages.perception.hypotheses.composition import Composition, FirstLook, charge, claim, glimpse, rise, scene_cost
from stages.perception.rendering.rasteriser import Float32s, inverse_depth
from tests.stages.perception.scenes import CATALOGUE, VIEW, Rendered, render, upright

PLACED = {
    "mug": upright("mug", -0.05, 0.0, 0.6),
    "tea_box": upright("tea_box", 0.1, 0.06, 0.2),
    "tuna_can": upright("tuna_can", -0.22, 0.08, 0.0),
}
FORM = CostForm()
EVERYTHING = np.array([0.0, 0.0, VIEW.width, VIEW.height])


@pytest.fixture(scope="module")
def seen() -> Rendered:
    return render(PLACED)


@pytest.fixture(scope="module")
def shapes() -> dict[str, Shape]:
    return {label: Shape.of(CATALOGUE[label].simplified(300)) for label in PLACED}


def layer(shapes: dict[str, Shape], label: str, T_camera_object: Floats) -> Float32s:
    return inverse_depth(shapes[label].soup, T_camera_object[:3], VIEW)


def true_layers(seen: Rendered, shapes: dict[str, Shape]) -> list[Float32s]:
    return [layer(shapes, label, seen.poses[label]) for label in PLACED]


@given(st.sets(st.sampled_from(sorted(PLACED))), st.integers(0, 10_000), st.sampled_from([0.005, 0.05, 0.3]))
def test_no_scene_costs_less_than_the_bound(
    seen: Rendered, shapes: dict[str, Shape], chosen: set[str], seed: int, spread: float
) -> None:
    rng = np.random.default_rng(seed)
    layers: list[Float32s] = []
    for label in sorted(chosen):
        turned = random_rotations(1, rng)[0] if spread > 0.01 else seen.poses[label][:3, :3]
        moved = seen.poses[label][:3, 3] + rng.normal(0, spread, 3)
        moved[2] = max(moved[2], 0.3)
        layers.append(layer(shapes, label, np.column_stack([turned, moved])))
    composition = Composition(seen.scene, FORM, [[seen.boxes[label]] for label in sorted(chosen)])
    assert composition.cost(layers) >= composition.bound() - 1e-6


def test_the_bound_is_what_the_missing_objects_leave_unexplained(seen: Rendered, shapes: dict[str, Shape]) -> None:
    boxes = [[box] for box in seen.boxes.values()]
    complete = Composition(seen.scene, FORM, boxes)
    assert complete.bound() < complete.cost(true_layers(seen, shapes)) < 0.2 * complete.cost_of_nothing()
    lacking = Composition(seen.scene, FORM, boxes[:2])
    assert lacking.bound() > complete.cost(true_layers(seen, shapes))
    nothing = Composition(seen.scene, FORM, [])
    assert nothing.bound() == nothing.cost([]) == complete.cost_of_nothing()


def test_boxes_limit_what_an_object_explains(seen: Rendered, shapes: dict[str, Shape]) -> None:
    layers = true_layers(seen, shapes)
    wide = Composition(seen.scene, FORM, [[EVERYTHING]] * 3)
    assert wide.cost(layers) == scene_cost(seen.scene, layers, FORM)
    fitting = Composition(seen.scene, FORM, [[box] for box in seen.boxes.values()])
    assert fitting.cost(layers) == pytest.approx(wide.cost(layers), rel=0.05)
    exchanged = Composition(seen.scene, FORM, [[box] for box in reversed(seen.boxes.values())])
    assert exchanged.cost(layers) > 0.5 * exchanged.cost_of_nothing()


def test_an_object_in_two_boxes_explains_what_is_in_both(seen: Rendered, shapes: dict[str, Shape]) -> None:
    layers = true_layers(seen, shapes)
    x0, y0, x1, y1 = seen.boxes["tea_box"]
    middle = (y0 + y1) / 2
    halves = [np.array([x0, y0, x1, middle]), np.array([x0, middle, x1, y1])]

    def composition(tea_box: list[Floats]) -> Composition:
        return Composition(seen.scene, FORM, [tea_box if n == "tea_box" else [box] for n, box in seen.boxes.items()])

    twice, whole = composition(halves), composition([seen.boxes["tea_box"]])
    assert twice.bound() <= twice.cost(layers) == pytest.approx(whole.cost(layers), rel=0.05)
    for half in halves:
        assert composition([half]).cost(layers) > 1.2 * twice.cost(layers)


def test_the_first_look_costs_what_the_composition_costs(seen: Rendered, shapes: dict[str, Shape]) -> None:
    layers, boxes = true_layers(seen, shapes), list(seen.boxes.values())
    look = FirstLook([glimpse(seen.scene, *each, FORM) for each in zip(layers, boxes, strict=True)])
    for size in range(4):
        for chosen in itertools.combinations(range(3), size):
            composition = Composition(seen.scene, FORM, [[boxes[i]] for i in chosen])
            change = composition.cost([layers[i] for i in chosen]) - composition.cost_of_nothing()
            assert look.cost(chosen) == pytest.approx(change, rel=0.1, abs=0.2 * PATCH_STRIDE**2)


def start(*, claim: float) -> LonePose:
    trace = ParticleTrace(iterations=(), costs=np.zeros(0), positions=np.zeros((0, 4)))
    return LonePose(T_camera_object=np.eye(4), trace=trace, rise=0.03, claim=claim)


def test_an_object_is_charged_for_its_box_and_for_what_it_claims() -> None:
    box = np.array([10.0, 10.0, 30.0, 20.0])
    assert charge(box, start(claim=0.0), 0.9) == pytest.approx(0.1 * 200 * 0.03)
    assert charge(box, start(claim=5.0), 0.9) == pytest.approx(4.5)


def test_what_covers_its_own_readings_explains_them_and_what_hides_it_claims_nothing(
    seen: Rendered, shapes: dict[str, Shape]
) -> None:
    claimed, explained = claim(seen.scene, layer(shapes, "tea_box", seen.poses["tea_box"]), FORM)
    assert explained > 0.85 and claimed > 0.5 * FORM.truncation * seen.scene.foreground.sum() / len(PLACED)
    wrong = seen.poses["tea_box"].copy()
    wrong[:3, 3] += (0.03, 0.0, -0.02)
    assert claim(seen.scene, layer(shapes, "tea_box", wrong), FORM)[1] < explained - 0.2
    behind = seen.poses["mug"].copy()
    behind[:3, 3] = 1.3 * seen.poses["tea_box"][:3, 3]
    assert claim(seen.scene, layer(shapes, "mug", behind), FORM)[0] < 0.1 * claimed


def test_an_object_cost_keeps_the_objects_and_drops_their_doubles(seen: Rendered, shapes: dict[str, Shape]) -> None:
    layers, boxes = true_layers(seen, shapes), list(seen.boxes.values())
    # The second tea box stands a millimetre beside the first; the hidden mug stands behind it.
    beside, behind = seen.poses["tea_box"].copy(), seen.poses["mug"].copy()
    beside[0, 3] += 0.001
    behind[:3, 3] = 1.3 * seen.poses["tea_box"][:3, 3]
    layers += [layer(shapes, "tea_box", beside), layer(shapes, "mug", behind)]
    boxes += [boxes[1], boxes[1]]
    glimpses = [glimpse(seen.scene, *each, FORM) for each in zip(layers, boxes, strict=True)]
    look = FirstLook(glimpses, [charge(box, start(claim=0.0), 0.1) for box in boxes])
    best = cheapest(look.cost, 5, None, 1)[0]
    assert best in {(0, 1, 2), (0, 2, 3)}


def test_an_object_out_of_sight_has_an_empty_glimpse(seen: Rendered, shapes: dict[str, Shape]) -> None:
    away = seen.poses["mug"].copy()
    away[0, 3] += 5.0
    found = glimpse(seen.scene, layer(shapes, "mug", away), seen.boxes["mug"], FORM)
    assert found.inverse.size == found.change.size == 0
    assert FirstLook([found]).cost((0,)) == 0.0


def test_an_object_rises_from_the_plane_by_what_it_could_explain(shapes: dict[str, Shape]) -> None:
    placed = {"tray": upright("tray", 0.0, 0.0, 0.0), "tea_box": upright("tea_box", 0.0, 0.0, 0.0)}
    seen, tray = render(placed), Shape.of(CATALOGUE["tray"].simplified(300))
    flat = rise(seen.scene, inverse_depth(tray.soup, seen.poses["tray"][:3], VIEW), FORM)
    high = rise(seen.scene, layer(shapes, "tea_box", seen.poses["tea_box"]), FORM)
    assert 0.002 < flat < 0.5 * high and 0.8 * FORM.truncation < high < FORM.truncation
    assert rise(seen.scene, np.zeros_like(seen.scene.depth), FORM) == FORM.truncation
