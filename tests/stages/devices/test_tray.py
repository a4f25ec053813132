from collections.abc import Callable

import numpy as np
import pytest

from runner.contract import Refused
from stages.devices.simulation import Simulation
from stages.devices.suites import tray
from stages.devices.suites.tray import GOALS, sample_goal, sample_start, support_height
from stages.devices.tabletop import Layout
from stages.scene.catalogue import Catalogue
from tests.stages.planning.scenes import catalogue

Sampler = Callable[[str, Catalogue, np.random.Generator], Layout]


@pytest.mark.parametrize("sample", [sample_goal, sample_start])
@pytest.mark.parametrize("goal", GOALS)
def test_layouts_stand_still(goal: str, sample: Sampler) -> None:
    names = tray.object_names(goal)
    simulation = Simulation(catalogue(), names)
    for seed in range(3):
        layout = sample(goal, catalogue(), np.random.default_rng(seed))
        assert set(layout) == set(names)
        simulation.arrange(layout)
        for name, T in zip(names, simulation.object_poses(), strict=True):
            assert np.linalg.norm(T[:3, 3] - layout[name][:3, 3]) < 0.003, (seed, name)
            assert T[2, 2] > 0.999, (seed, name)


@pytest.mark.parametrize("goal", GOALS)
def test_goals_have_a_stack_a_filled_tray_and_neighbours(goal: str) -> None:
    spots = GOALS[goal]
    inside = [spot for spot in spots if spot.support == tray.TRAY]
    assert len(spots) == 5
    assert any(spot.support not in (tray.TRAY, "table") for spot in spots)
    assert inside
    assert len(inside) >= 2 or any(spot.beside for spot in spots)


def test_equal_generators_give_equal_layouts() -> None:
    first, second = (sample_start("tea", catalogue(), np.random.default_rng(4)) for _ in range(2))
    for name, T in first.items():
        np.testing.assert_array_equal(T, second[name])


def test_start_and_goal_differ() -> None:
    goal = sample_goal("tea", catalogue(), np.random.default_rng([3, 0]))
    start = sample_start("tea", catalogue(), np.random.default_rng([3, 1]))
    assert all(np.linalg.norm(goal[name][:2, 3] - start[name][:2, 3]) > 0.01 for name in goal)


def test_an_unknown_goal_is_refused_with_the_choices() -> None:
    with pytest.raises(Refused, match=r"dinner.*auto.*tea"):
        tray.goal_name("dinner", 0)


def test_support_heights() -> None:
    large, box = catalogue()["tray"], catalogue()["tea_box"]
    assert support_height(large, 0.0, 0.0) == pytest.approx(-0.009)
    assert support_height(large, 0.195, 0.0) == pytest.approx(0.015)
    assert support_height(box, 0.0, 0.0) == pytest.approx(0.040)
