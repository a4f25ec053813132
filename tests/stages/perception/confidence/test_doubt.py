"""Doubt: sure of what the image shows, unsure of what it leaves open."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.perception.confidence.calibration import CONSTANTS, Calibration, cost_of_an_object, hypothesis_probabilities
from stages.perception.confidence.doubt import Judge, SceneDoubt
from stages.perception.confidence.evidence import Evidence, Judged, Rival
from tests.stages.perception.scenes import CATALOGUE, Rendered, render, upright

BOX = upright("tea_box", 0.0, 0.0, 0.6)
HIDDEN_HANDLE, SHOWN_HANDLE = upright("mug", 0.0, 0.0, np.pi / 2), upright("mug", 0.0, 0.0, -0.9)


PLAUSIBLE = Calibration(
    hypothesis_scale=0.05, pose_scale=40.0, spread_scale=1.0, bias=0.5,
    weights=(0.6, -0.5, 0.0, 0.5, -0.5, -0.3, 0.3, 0.1, -0.3, -0.3, -0.3),
    centres=(0.0, -6.3, 7.0, 0.8, 0.0, -1.5, 2.0, 0.8, 0.05, 0.2, 0.2),
    scales=(1.0, 0.4, 0.8, 0.2, 0.1, 0.8, 2.0, 0.2, 0.1, 0.3, 0.3),
)  # fmt: skip
"""What tests judge with, whatever was fitted last."""


def assess(seen: Rendered, poses: dict[str, Floats] | None = None, *, dof: int = 6) -> SceneDoubt:
    judged = [Judged(label, T, 0.9) for label, T in (poses or seen.poses).items()]
    judge = Judge(CATALOGUE, dof=3 if dof == 3 else 6, calibration=PLAUSIBLE)
    return judge.assess(seen.scene, judged, np.array([-1.0, -3.0, -9.0]), 0)


@pytest.mark.parametrize("dof", [3, 6])
def test_a_box_in_plain_view_is_sure(dof: int) -> None:
    (found,) = assess(render({"tea_box": BOX}), dof=dof).objects
    assert found.probability > 0.9 and not found.shares and not found.contradicted
    assert found.evidence.spread_metres < 0.003 and found.evidence.spread_radians < np.deg2rad(4)
    assert found.evidence.visible > 0.95


@pytest.mark.parametrize("dof", [3, 6])
def test_a_mug_with_a_hidden_handle_is_in_doubt(dof: int) -> None:
    (shown,) = assess(render({"mug": SHOWN_HANDLE}), dof=dof).objects
    (hidden,) = assess(render({"mug": HIDDEN_HANDLE}), dof=dof).objects
    assert hidden.probability < 0.9 < shown.probability
    assert hidden.evidence.spread_radians > np.deg2rad(8) > 2 * shown.evidence.spread_radians
    assert hidden.shares and not shown.shares
    # What may be is turned about the upright axis and stands where the estimate stands.
    (T, up) = hidden.alternatives[0], render({"mug": HIDDEN_HANDLE}).poses["mug"][:3, 2]
    assert T[:, 2] @ up > 0.95
    assert hidden.probability + sum(hidden.shares) <= 1 + 1e-9


def test_a_flip_that_depth_cannot_see_is_an_alternative() -> None:
    (found,) = assess(render({"soup_can": upright("soup_can", 0.0, 0.0, 0.0)})).objects
    assert found.evidence.margin < 1
    upside_down = found.alternatives[0]
    assert upside_down[:, 2] @ render({"soup_can": upright("soup_can", 0.0, 0.0, 0.0)}).poses["soup_can"][:3, 2] < -0.95
    # The other end up is another pose, not spread about this one.
    assert found.evidence.spread_radians < np.deg2rad(10)


def test_colour_settles_what_depth_cannot_see() -> None:
    seen = render({"soup_can": upright("soup_can", 0.0, 0.0, 0.0)})
    T = seen.poses["soup_can"]
    flipped = (T @ pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)))[:3]
    before, after = (
        Judge(CATALOGUE, dof=6, calibration=PLAUSIBLE)
        .assess(seen.scene, [Judged("soup_can", T, 0.9, rivals)], np.zeros(1), 0)
        .objects[0]
        for rivals in ((), (Rival(flipped, nats=10.0),))
    )
    assert after.probability > before.probability and after.evidence.margin > before.evidence.margin + 3
    assert before.shares and not after.shares


def test_of_two_equal_objects_in_one_place_one_is_contradicted() -> None:
    seen = render({"sponge": upright("sponge", 0.0, 0.0, 0.0), "cup": upright("cup", 0.15, 0.0, 0.0)})
    T = seen.poses["sponge"]
    judge = Judge(CATALOGUE, dof=6, calibration=PLAUSIBLE)

    def contradicted(*items: Judged) -> list[bool]:
        return [found.contradicted for found in judge.assess(seen.scene, items, np.zeros(1), 0).objects]

    cup = Judged("cup", seen.poses["cup"], 0.9)

    def twice(millimetres: float, deep: float) -> list[Judged]:
        """The sponge, and one that lies a little beside it, further down."""
        beside = T @ pose(np.eye(3), np.array([0.0, 0.0, -0.001 * millimetres]))
        return [Judged("sponge", where, 0.9, penetration=0.001 * deep) for where in (beside, T)]

    for millimetres, deep, doubled in ((10, 9, True), (10, 4, False), (30, 9, False), (30, 20, True)):
        assert contradicted(*twice(millimetres, deep), cup) == [doubled, False, False]
    other_kind = [twice(10, 20)[1], replace(cup, penetration=0.02)]
    assert contradicted(*other_kind) == [False, False]


def test_an_object_that_floats_before_the_readings_is_contradicted() -> None:
    seen = render({"tea_box": BOX})
    lifted = {"tea_box": pose(np.eye(3), np.array([0.0, 0.0, -0.1])) @ seen.poses["tea_box"]}
    (found,) = assess(seen, lifted).objects
    assert found.contradicted and found.evidence.looked_through > 0.9
    assert found.probability < 0.2


def test_what_lies_in_the_plane_or_in_another_object_is_less_sure() -> None:
    seen = render({"tea_box": BOX})
    judge, plain = Judge(CATALOGUE, dof=6, calibration=PLAUSIBLE), Judged("tea_box", seen.poses["tea_box"], 0.9)
    resting, sunk, inside = (
        judge.assess(seen.scene, [item], np.zeros(1), 0).objects[0].probability
        for item in (plain, replace(plain, sunk=0.02), replace(plain, penetration=0.02))
    )
    assert sunk < resting and inside < resting


def test_readings_that_nothing_explains_speak_against_the_object_whose_box_holds_them() -> None:
    seen = render({"tea_box": BOX, "soup_can": upright("soup_can", -0.13, 0.05, 0.3)})
    judge, T = Judge(CATALOGUE, dof=6, calibration=PLAUSIBLE), seen.poses["tea_box"]
    box, other = (np.asarray(seen.boxes[label], float) for label in ("tea_box", "soup_can"))
    own, both, neither = (
        judge.assess(seen.scene, [Judged("tea_box", T, 0.9, (), given)], np.zeros(1), 0).objects[0]
        for given in (box, np.concatenate([np.minimum(box, other)[:2], np.maximum(box, other)[2:]]), None)
    )
    assert own.evidence.unexplained < 0.02
    assert both.evidence.unexplained > 0.1
    assert both.probability < own.probability
    assert neither.evidence.unexplained == 0.0


def test_an_object_that_shows_nothing_is_not_contradicted_but_unsure() -> None:
    seen = render({"milk_carton": upright("milk_carton", 0.0, 0.0, 0.6)})
    within = {"milk_carton": seen.poses["milk_carton"], "salt_shaker": seen.poses["milk_carton"]}
    _, hidden = assess(seen, within).objects
    assert hidden.evidence.visible == 0
    assert not hidden.contradicted and hidden.probability < 0.5


def test_what_the_catalogue_does_not_explain_is_an_unknown_region() -> None:
    seen = render({"tea_box": BOX, "soup_can": upright("soup_can", -0.13, 0.05, 0.3)})
    assert assess(seen).unknown == ()
    (region,) = assess(seen, {"tea_box": seen.poses["tea_box"]}).unknown
    x0, y0, x1, y1 = seen.boxes["soup_can"]
    assert region.box[0] >= x0 and region.box[1] >= y0 and region.box[2] <= x1 and region.box[3] <= y1
    low, high = CATALOGUE["soup_can"].bounds
    assert region.centre_table == pytest.approx([-0.13, 0.05, (high - low)[2] / 2], abs=0.02)
    assert (region.extent_table < (high - low) + 0.01).all() and region.points > 300


@pytest.mark.parametrize("noise", [0.001, 0.003])
def test_noise_and_edges_are_no_unknown_objects(noise: float) -> None:
    placed = {
        "tea_box": BOX,
        "bowl": upright("bowl", 0.15, 0.05, 0.0),
        "tray": upright("tray", 0.0, 0.2, 0.1),
        "soup_can": upright("soup_can", -0.13, 0.05, 0.3),
    }
    assert assess(render(placed, noise=noise)).unknown == ()


def test_hypotheses_get_probabilities_that_sum_to_one() -> None:
    log_weights = np.array([-40.0, -42.0, -60.0, -1e9])
    found = hypothesis_probabilities(log_weights, 2.0)
    assert found.sum() == pytest.approx(1) and found[0] / found[1] == pytest.approx(np.e)
    assert list(np.argsort(-found)) == [0, 1, 2, 3]
    assert hypothesis_probabilities(log_weights[:1], 2.0).tolist() == [1.0]
    assert hypothesis_probabilities(log_weights[:3], 1e12) == pytest.approx(np.full(3, 1 / 3))


def test_an_object_costs_what_its_share_of_the_foreground_could() -> None:
    scene = render({"tea_box": BOX}).scene
    assert cost_of_an_object(scene, 2) == pytest.approx(0.03 * scene.foreground.sum() / 2)


def test_equal_scenes_are_judged_with_equal_bytes() -> None:
    seen = render({"mug": HIDDEN_HANDLE, "tea_box": upright("tea_box", 0.12, 0.06, 0.2)})
    first, second = assess(seen), assess(seen)
    assert first.probabilities.tobytes() == second.probabilities.tobytes()
    for a, b in zip(first.objects, second.objects, strict=True):
        assert a.probability == b.probability and a.shares == b.shares
        assert a.evidence.features().tobytes() == b.evidence.features().tobytes()


def test_an_empty_scene_is_judged_too() -> None:
    doubt = Judge(CATALOGUE, dof=6, calibration=PLAUSIBLE).assess(render({"tea_box": BOX}).scene, [], np.zeros(1), 0)
    assert doubt.objects == () and doubt.probabilities.tolist() == [1.0] and len(doubt.unknown) == 1


def test_the_fitted_constants_tell_what_is_sure_from_what_is_not() -> None:
    judge = Judge(CATALOGUE, dof=6)
    chances = {
        name: judge.assess(seen.scene, [Judged(label, seen.poses[label], 0.9)], np.zeros(1), 0).objects[0].probability
        for name, label, seen in (
            ("box", "tea_box", render({"tea_box": BOX})),
            ("hidden", "mug", render({"mug": HIDDEN_HANDLE})),
            ("shown", "mug", render({"mug": SHOWN_HANDLE})),
        )
    }
    assert chances["box"] > 0.9 and chances["shown"] > 0.9 > chances["hidden"]


def test_better_evidence_is_never_less_sure() -> None:
    (found,) = assess(render({"mug": HIDDEN_HANDLE})).objects
    calibration = Calibration.load()
    evidence: Evidence = found.evidence
    before = calibration.probability(evidence.features())
    for change in ({"margin": evidence.margin + 4}, {"gain": evidence.gain + 0.3}, {"looked_through": -0.3}):
        assert calibration.probability(replace(evidence, **change).features()) >= before


def test_probabilities_are_probabilities_whatever_the_evidence() -> None:
    (found,) = assess(render({"tea_box": BOX})).objects
    calibration, rng = Calibration.load(), np.random.default_rng(0)
    names = ("margin", "fit", "shown", "gain", "looked_through", "breadth", "sunk", "unexplained", "penetration")
    for _ in range(200):
        values = dict(zip(names, (10.0 ** rng.uniform(-6, 6, len(names)) * rng.choice([-1, 1])).tolist(), strict=True))
        assert 0.0 <= calibration.probability(replace(found.evidence, **values).features()) <= 1.0


def test_constants_for_other_features_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(CONSTANTS.read_text().replace("weights: [", "weights: [0.5, "))
    with pytest.raises(Refused, match=r"calibration\.yaml: weights has 12 numbers; there are 11 features"):
        Calibration.load(path)


def test_constants_of_another_form_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text("bias: much\n")
    with pytest.raises(Refused, match=r"calibration\.yaml: .*bias"):
        Calibration.load(path)
