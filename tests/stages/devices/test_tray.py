from collections.abc import Callable

import numpy as np
import pytest

from runner.contract import Refused
from stages.devices.simulation import Simulation
from stages.devices.suites import tray
from stages.devices.suites.placing import moved, support_height
from stages.devices.suites.suite import Rejected
from stages.devices.suites.tray import GOALS, Tray, look_alikes, sample_goal, sample_start
from stages.devices.tabletop import Layout
from stages.robots import Robot
from stages.scene.catalogue import Catalogue
from tests.stages.planning.scenes import ROBOT, TABLE, catalogue, standing

Sampler = Callable[[str, Catalogue, Robot, np.random.Generator], Layout]


@pytest.mark.parametrize("sample", [sample_goal, sample_start])
@pytest.mark.parametrize("goal", GOALS)
def test_layouts_stand_still(goal: str, sample: Sampler) -> None:
    names = tray.object_names(goal)
    simulation = Simulation(catalogue(), ROBOT, names, TABLE)
    for seed in range(3):
        layout = sample(goal, catalogue(), ROBOT, np.random.default_rng(seed))
        assert set(layout) == set(names)
        simulation.arrange(layout)
        for name, T in zip(names, simulation.object_poses(), strict=True):
            assert np.linalg.norm(T[:3, 3] - layout[name][:3, 3]) < 0.003, (seed, name)
            assert T[2, 2] > 0.999, (seed, name)


@pytest.mark.parametrize("goal", GOALS)
def test_goals_have_a_filled_tray_and_a_stack_or_neighbours(goal: str) -> None:
    spots = GOALS[goal]
    inside = [spot for spot in spots if spot.support == tray.TRAY]
    assert len(spots) == 5
    assert any(spot.beside or spot.support not in (tray.TRAY, "table") for spot in spots)
    assert inside
    assert len(inside) >= 2 or any(spot.beside for spot in spots)


def test_equal_generators_give_equal_layouts() -> None:
    first, second = (sample_start("tea", catalogue(), ROBOT, np.random.default_rng(4)) for _ in range(2))
    for name, T in first.items():
        np.testing.assert_array_equal(T, second[name])


def test_start_and_goal_differ() -> None:
    goal = sample_goal("tea", catalogue(), ROBOT, np.random.default_rng([3, 0]))
    start = sample_start("tea", catalogue(), ROBOT, np.random.default_rng([3, 1]))
    assert all(np.linalg.norm(goal[name][:2, 3] - start[name][:2, 3]) > 0.01 for name in goal)


@pytest.mark.parametrize("goal", GOALS)
def test_strangers_come_with_the_start_stand_and_leave_the_others_where_the_seed_has_them(goal: str) -> None:
    for seed in range(3):
        world, plain = (Tray(catalogue(), ROBOT, seed, goal, strangers) for strangers in (3, 0))
        shown = world.sample("goal", np.random.default_rng(seed))
        plain.sample("goal", np.random.default_rng(seed))
        start, without = (suite.sample("start", np.random.default_rng(seed)) for suite in (world, plain))
        strangers = set(world.names) - set(plain.names)
        assert len(strangers) == 3 and set(start) - set(without) == strangers and not strangers & set(shown)
        for name, T in without.items():
            np.testing.assert_array_equal(T, start[name])
        simulation = Simulation(catalogue(), ROBOT, world.names, TABLE)
        simulation.arrange(start)
        for name, settled in simulation.layout().items():
            assert np.linalg.norm(settled[:3, 3] - start[name][:3, 3]) < 0.003, (seed, name)


def test_strangers_are_what_looks_most_like_an_object_of_the_goal() -> None:
    found = look_alikes("tea", catalogue(), np.random.default_rng(0))
    assert len(found) == 5 and {"mug", "sauce_bottle"} < set(found)
    assert not set(found) & set(tray.object_names("tea"))


def test_an_unknown_goal_is_refused_with_the_choices() -> None:
    with pytest.raises(Refused, match=r"dinner.*auto.*tea"):
        tray.goal_name("dinner", 0)


def test_support_heights() -> None:
    large, box = catalogue()["tray"], catalogue()["tea_box"]
    assert support_height(large, 0.0, 0.0) == pytest.approx(-0.009)
    assert support_height(large, 0.195, 0.0) == pytest.approx(0.015)
    assert support_height(box, 0.0, 0.0) == pytest.approx(0.040)


def test_what_is_moved_is_put_down_on_what_is_below_and_never_beside_the_table() -> None:
    objects = catalogue()
    simulation = Simulation(objects, ROBOT, ("tea_box", "tuna_can"), TABLE)
    simulation.arrange({"tea_box": standing("tea_box", 0.6, 0.1), "tuna_can": standing("tuna_can", 0.6, -0.2)})
    for x, y, below in ((0.6, 0.1, objects["tea_box"].dimensions[2]), (0.7, -0.1, 0.0)):
        layout = dict(zip(simulation.present, simulation.object_poses(), strict=True))
        simulation.place("tuna_can", moved("tuna_can", (x, y), layout, objects, TABLE))
        can = simulation.object_poses()[1]
        bottom = can[2, 3] + objects["tuna_can"].bounds[0, 2]
        assert np.allclose([*can[:2, 3], bottom], [x, y, TABLE.height + below], atol=0.004)
        assert can[2, 2] > 0.999
    with pytest.raises(Refused, match=r"x=0\.2 y=0: beside the table; valid: 0\.45 to 1\.15 and -0\.6 to 0\.6"):
        moved("tuna_can", (0.2, 0.0), layout, objects, TABLE)


@pytest.mark.parametrize(("name", "x", "y"), [("plate", 0.65, 0.0), ("tray", 0.6, 0.05)])
def test_what_is_wide_is_not_moved_through_what_is_slim(name: str, x: float, y: float) -> None:
    objects = catalogue()
    layout = {"water_bottle": standing("water_bottle", 0.70, 0.05), name: standing(name, 0.6, -0.3, yaw=0.4)}
    T = moved(name, (x, y), layout, objects, TABLE)
    bottom = T[2, 3] + objects[name].bounds[0, 2]
    assert bottom == pytest.approx(TABLE.height + objects["water_bottle"].dimensions[2], abs=0.002)


def test_what_the_goal_has_beside_the_tray_has_room_beside_it_at_the_start() -> None:
    world = Tray(catalogue(), ROBOT, 420, "tea", 3)
    world.sample("goal", np.random.default_rng([420, 0]))
    # The sugar box stood near the table's front edge; the tray, turned by 25 degrees, would have it over that edge.
    with pytest.raises(Rejected, match="what the goal has beside the tray is out of reach there"):
        world.sample("start", np.random.default_rng([420, 1]))
