"""Calibration: what is fitted to synthetic evidence predicts it, and what is printed of it is right."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from benchmarks.perception.calibration import (
    KINDS,
    POSE_SCALES,
    Instance,
    Scene,
    crossed,
    design,
    evaluate,
    expected_error,
    fit,
    plot,
    reliability,
    scenes,
    wilson,
    write_constants,
)
from stages.devices.clutter import COUNTS, Pile
from stages.perception.confidence.calibration import FEATURES, RIGHT_METRES, Calibration
from stages.perception.confidence.evidence import Evidence
from tests.stages.perception.scenes import CATALOGUE

PLAIN = Evidence(
    margin=5.0, fit=0.0015, shown=900.0, visible=1.0, gain=0.9, looked_through=0.0, spread_metres=0.002,
    spread_radians=0.03, breadth=0.1, hypothesis=0.5, confidence=1.0,
)  # fmt: skip


def synthetic(count: int, seed: int) -> list[Scene]:
    """Scenes whose poses are right with a probability that margin and spread decide."""
    rng = np.random.default_rng(seed)
    found: list[Scene] = []
    for _ in range(count):
        margin, spread = float(rng.uniform(-2, 8)), float(rng.uniform(0.001, 0.02))
        evidence = replace(PLAIN, margin=margin, spread_metres=spread, breadth=spread / RIGHT_METRES)
        right = bool(rng.random() < 1 / (1 + np.exp(-(margin - 100 * spread))))
        instance = Instance(
            "mug", right, float(abs(rng.normal(0, 2 * spread))), 0.1, dict.fromkeys(map(str, POSE_SCALES), evidence)
        )
        # The second hypothesis is true as often as a scale of 0.2 says it is.
        deficit = float(rng.uniform(0, 1))
        true = int(rng.random() < 1 / (1 + np.exp(deficit / 0.2)))
        found.append(Scene("low", "noisy", 0, true == 0, true, 10.0, (-5.0, -5.0 - 10.0 * deficit), (instance,)))
    return found


def test_wilson_interval() -> None:
    low, high = wilson(8, 10)
    assert low == pytest.approx(0.4902, abs=1e-4) and high == pytest.approx(0.9433, abs=1e-4)
    assert wilson(5, 5)[1] == 1.0 and wilson(0, 5)[0] == 0.0


def test_bins_hold_every_estimate_once() -> None:
    called = np.array([0.0, 0.05, 0.9, 0.9, 1.0])
    bins = reliability(called, np.array([False, False, True, False, True]))
    assert [(each.count, each.right) for each in bins] == [(2, 0), (2, 1), (1, 1)]
    assert expected_error(bins) == pytest.approx((2 * 0.025 + 2 * 0.4 + 0) / 5)


def test_a_fit_predicts_scenes_that_it_has_not_seen(capsys: pytest.CaptureFixture[str]) -> None:
    constants = fit(synthetic(800, 1))
    weights = dict(zip(FEATURES, constants.weights, strict=True))
    assert weights["margin"] > 1 and weights["spread"] < 0
    assert 0.13 < constants.hypothesis_scale < 0.3
    bins, winners = evaluate(synthetic(800, 2), constants)
    assert expected_error(bins) < 0.05 and expected_error(winners) < 0.05
    printed = capsys.readouterr().out
    assert "800 objects in 800 estimates" in printed and "the least sure tenth" in printed


def test_two_sets_are_judged_with_the_constants_of_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    one, two = synthetic(300, 7), synthetic(300, 8)
    poses, images = crossed([(one, fit(two)), (two, fit(one))])
    assert sum(each.count for each in poses) == sum(each.count for each in images) == 600
    assert expected_error(poses) < 0.06 and "600 objects of both sets" in capsys.readouterr().out


def test_evidence_never_turns_round() -> None:
    # Confidence speaks against in these few scenes; the fit does not believe it.
    scenes = synthetic(40, 3)
    turned = [
        replace(scene, instances=tuple(
            replace(item, evidence={k: replace(e, confidence=float(not item.right)) for k, e in item.evidence.items()})
            for item in scene.instances
        ))
        for scene in scenes
    ]  # fmt: skip
    assert dict(zip(FEATURES, fit(turned).weights, strict=True))["confidence"] == 0.0


def test_constants_come_back_as_they_were_written(tmp_path: Path) -> None:
    constants = fit(synthetic(60, 4))
    path = tmp_path / "calibration.yaml"
    write_constants(constants, path, "python -m benchmarks.calibration FOLDER")
    back = Calibration.load(path)
    X, _ = design(synthetic(20, 5), constants.hypothesis_scale, constants.pose_scale)
    assert [back.probability(x) for x in X] == pytest.approx([constants.probability(x) for x in X], abs=5e-3)
    assert path.read_text().startswith("# Written by `python -m benchmarks.calibration FOLDER`")


def test_the_reliability_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib comes with the extra `benchmarks`")
    bins = reliability(np.array([0.2, 0.9, 0.95]), np.array([False, True, True]))
    for winners in (bins, []):
        plot((bins, winners), (bins, winners), tmp_path / "figures" / f"{len(winners)}.png")
    one, two = ((tmp_path / "figures" / f"{count}.png").stat().st_size for count in (0, len(bins)))
    assert 5000 < one < two


def test_a_true_set_that_is_not_among_the_hypotheses_makes_the_winner_less_sure() -> None:
    scenes = synthetic(200, 6)
    lost = [replace(scene, winner_right=False, true_hypothesis=-1) if i % 4 == 0 else scene
            for i, scene in enumerate(scenes)]  # fmt: skip
    assert fit(lost).hypothesis_scale > 1.1 * fit(scenes).hypothesis_scale


def test_scenes_that_were_estimated_are_kept(tmp_path: Path) -> None:
    lines = [msgspec.json.encode(scene).decode() for scene in synthetic(3, 9)]
    (tmp_path / "test-low-noisy.jsonl").write_text("\n".join(lines) + "\n")
    assert scenes(tmp_path, "test", None, 1, kept=True) == synthetic(3, 9)
    assert scenes(tmp_path, "test", 2, 1, kept=True) == synthetic(3, 9)[:2]
    assert scenes(tmp_path, "train", None, 1, kept=True) == []


def test_every_kind_of_piles_holds_more_doubt_than_clutter_15() -> None:
    assert KINDS["clutter"].pile == Pile()
    for name, kind in KINDS.items():
        assert set(kind.pile.labels) <= set(CATALOGUE.objects)
        assert name == "clutter" or kind.pile.least_visible < Pile().least_visible
        assert name == "clutter" or np.mean(kind.pile.counts) > np.mean(COUNTS)
