"""Sharing, dropping and the order of work change no byte of what hypotheses come to."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stages.perception.filter.settings import FilterSettings
from stages.perception.hypotheses.scene_filter import SceneFilter, SceneResult, Suspect
from tests.stages.perception.scenes import CATALOGUE, Rendered, render, upright

PLACED = {
    "mug": upright("mug", -0.05, 0.0, 0.6),
    "tea_box": upright("tea_box", 0.1, 0.06, 0.2),
}
SETTINGS = FilterSettings(particles=200, iterations=60)


@pytest.fixture(scope="module")
def seen() -> Rendered:
    return render(PLACED)


@pytest.fixture(scope="module")
def suspects(seen: Rendered) -> list[Suspect]:
    """The two objects and two that are not there."""
    return [
        Suspect("mug", seen.boxes["mug"]),
        Suspect("tea_box", seen.boxes["tea_box"]),
        Suspect("tuna_can", seen.boxes["tea_box"]),
        Suspect("sponge", seen.boxes["mug"]),
    ]


PAIRS = list(itertools.combinations(range(4), 2))


@pytest.fixture(scope="module")
def plain(seen: Rendered, suspects: list[Suspect]) -> dict[tuple[int, int], SceneResult]:
    """Every hypothesis by a filter that remembers nothing."""
    scenes = SceneFilter(CATALOGUE, SETTINGS, memory=0)
    results = {pair: scenes.estimate(seen.scene, [suspects[i] for i in pair]) for pair in PAIRS}
    assert scenes.runs >= 2 * len(PAIRS)
    return results


def same(a: SceneResult, b: SceneResult) -> bool:
    poses = [np.array_equal(x.track.T_camera_object, y.track.T_camera_object)
             for x, y in zip(a.objects, b.objects, strict=True)]  # fmt: skip
    return a.cost == b.cost and all(poses)


def test_sharing_and_order_change_no_byte(
    seen: Rendered, suspects: list[Suspect], plain: dict[tuple[int, int], SceneResult]
) -> None:
    scenes = SceneFilter(CATALOGUE, SETTINGS)
    starts = [scenes.look(seen.scene, suspect, among=2) for suspect in reversed(suspects)][::-1]
    for pair in reversed(PAIRS):
        chosen, begun = [suspects[i] for i in pair], [starts[i] for i in pair]
        assert same(scenes.estimate(seen.scene, chosen, begun), plain[pair])
        assert same(scenes.estimate(seen.scene, chosen), plain[pair])


def test_dropping_changes_no_byte_of_the_winner(
    seen: Rendered, suspects: list[Suspect], plain: dict[tuple[int, int], SceneResult]
) -> None:
    scenes = SceneFilter(CATALOGUE, SETTINGS)
    winner = min(PAIRS, key=lambda pair: plain[pair].cost)
    assert winner == (0, 1)
    chosen = [suspects[i] for i in winner]
    starts = [scenes.look(seen.scene, suspect, among=2).T_camera_object for suspect in chosen]
    reached = scenes.begun_cost(seen.scene, chosen, starts)  # what is known of it when the others are tried
    results = {pair: scenes.estimate(seen.scene, [suspects[i] for i in pair], reached=reached) for pair in PAIRS}
    assert same(results[winner], plain[winner])
    dropped = [pair for pair in PAIRS if results[pair].dropped]
    assert {(0, 3), (1, 2)} <= set(dropped)
    for pair in PAIRS:
        if pair in dropped:
            assert reached < results[pair].cost <= plain[pair].cost
        else:  # one that ends above it is not polished, and cannot win
            assert same(results[pair], plain[pair]) or results[pair].cost > reached


def test_a_hypothesis_ends_no_higher_than_it_begins(
    seen: Rendered, suspects: list[Suspect], plain: dict[tuple[int, int], SceneResult]
) -> None:
    scenes = SceneFilter(CATALOGUE, SETTINGS)
    for pair in PAIRS:
        chosen = [suspects[i] for i in pair]
        starts = [scenes.look(seen.scene, suspect, among=2).T_camera_object for suspect in chosen]
        begun = scenes.begun_cost(seen.scene, chosen, starts)
        assert plain[pair].cost <= begun == scenes.begun_cost(seen.scene, chosen, starts)


def test_the_plain_form_takes_no_first_look(seen: Rendered, suspects: list[Suspect]) -> None:
    scenes = SceneFilter(CATALOGUE, FilterSettings.paper(particles=50, iterations=8))
    assert not scenes.looks_first
    result = scenes.estimate(seen.scene, suspects[:2], reached=0.0)
    assert not result.dropped and scenes.runs == 2 and scenes.visits == 0
    again = scenes.estimate(seen.scene, [suspects[0], suspects[2]])
    assert scenes.runs == 3
    assert again.objects[0].track is result.objects[0].track
