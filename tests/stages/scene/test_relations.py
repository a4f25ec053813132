"""Relations of hand-made scenes: what is on, in and clear, and that the estimate's noise does not change it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages.geometry import regions
from stages.messages.scene import UnknownRegion
from stages.scene.relations import Tolerances, gaps, is_covered, penetration
from stages.scene.stance import Standing
from tests.stages.layouts import Layout, asserted, breakfast, carried, catalogue, label_of, stances

SCENES = {
    "breakfast": (
        breakfast(),
        {
            "on(tray, table)",
            "in(bowl, tray)",
            "in(cup, bowl)",
            "in(tea_box, tray)",
            "on(tuna_can, tea_box)",
            "on(soup_can, table)",
        },
    ),
    "three stacked, the lowest widest": (
        Layout()
        .put("cereal_box", 0, 0, resting=1)
        .put("sponge", 0, 0.01, on="cereal_box")
        .put("salt_shaker", 0, 0, on="sponge"),
        {"on(cereal_box, table)", "on(sponge, cereal_box)", "on(salt_shaker, sponge)"},
    ),
    "three stacked in a tray": (
        Layout()
        .put("tray", 0, 0)
        .put("tea_box", -0.1, 0, on="tray", resting=1)
        .put("tuna_can", 0, 0, on="tea_box")
        .put("salt_shaker", 0, 0, on="tuna_can"),
        {"on(tray, table)", "in(tea_box, tray)", "on(tuna_can, tea_box)", "on(salt_shaker, tuna_can)"},
    ),
    "on a plate in a tray": (
        Layout().put("tray", 0, 0).put("plate", -0.05, 0, on="tray").put("mug", 0.01, 0.02, on="plate"),
        {"on(tray, table)", "in(plate, tray)", "on(mug, plate)"},
    ),
    "bottles that lie": (
        Layout().put("water_bottle", 0, 0, resting=1).put("sauce_bottle", 0.2, 0, resting=1).put("sponge", 0.3, 0.2),
        {"on(water_bottle, table)", "on(sauce_bottle, table)", "on(sponge, table)"},
    ),
    "a plate on a cup": (
        Layout().put("cup", 0, 0).put("plate", 0, 0).put("soup_can", 0.2, 0),
        {"on(cup, table)", "in(plate, cup)", "on(soup_can, table)"},
    ),
}
SCENES["a plate on a cup"][0].poses["plate"][2, 3] += 0.095


@pytest.mark.parametrize("name", SCENES)
def test_what_carries_what(name: str):
    layout, expected = SCENES[name]
    assert carried(layout.graph()) == expected


@given(st.sampled_from(sorted(SCENES)), st.integers(0, 2**32 - 1))
@settings(max_examples=80)
def test_noise_of_the_estimate_changes_nothing(name: str, seed: int):
    layout, expected = SCENES[name]
    noisy = layout.disturbed(np.random.default_rng(seed), metres=0.005, degrees=3)
    assert carried(noisy.graph()) == expected


@given(st.floats(-np.pi, np.pi), st.floats(-0.3, 0.3))
@settings(max_examples=20)
def test_where_the_scene_stands_changes_nothing(yaw: float, x: float):
    layout, expected = SCENES["breakfast"]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0, yaw]).as_matrix()
    T[0, 3] = x
    assert carried(layout.moved(T).graph()) == expected


def test_clear_is_what_carries_nothing():
    clear = {text for text in asserted(breakfast().graph()) if text.startswith("clear")}
    assert clear == {"clear(cup)", "clear(tuna_can)", "clear(soup_can)"}


def test_everything_exists():
    graph = breakfast().graph()
    assert {f"exist({item.name})" for item in graph.objects} <= asserted(graph)


def test_the_order_of_the_objects_does_not_matter():
    layout, expected = SCENES["three stacked in a tray"]
    reversed_layout = Layout(dict(reversed(layout.poses.items())))
    assert carried(reversed_layout.graph()) == expected


def test_an_upturned_bowl_carries_on_rather_than_in():
    layout = Layout().put("bowl", 0, 0)
    layout.poses["bowl"][:3, :3] = np.diag([1.0, -1.0, -1.0])
    layout.poses["bowl"][2, 3] = 0.03
    layout.put("salt_shaker", 0, 0, on="bowl")
    assert "on(salt_shaker, bowl)" in carried(layout.graph())


def test_an_object_that_leans_on_another_is_supported_by_it():
    layout = Layout().put("cereal_box", 0, 0).put("sponge", 0.0, 0.0)
    lean = Rotation.from_rotvec([0, np.deg2rad(-50), 0]).as_matrix()
    layout.poses["sponge"][:3, :3] = lean
    layout.poses["sponge"][:3, 3] = [0.03, 0, 0.16]
    assert "on(sponge, cereal_box)" in carried(layout.graph())


def test_an_object_that_leans_on_nothing_is_on_the_table():
    layout = Layout().put("mug", 0, 0)
    layout.poses["mug"][:3, :3] = Rotation.from_rotvec([0, np.deg2rad(40), 0]).as_matrix()
    assert carried(layout.graph()) == {"on(mug, table)"}


def test_an_object_without_anything_below_is_on_the_table():
    layout = Layout().put("tea_box", 0, 0).put("cup", 0.3, 0)
    layout.poses["cup"][2, 3] += 0.05
    assert "on(cup, table)" in carried(layout.graph())


def test_height_and_regions_ignore_a_few_degrees_of_tilt():
    straight, tilted = np.eye(4), np.eye(4)
    tilted[:3, :3] = Rotation.from_rotvec([0.05, -0.04, 0]).as_matrix()
    a, b = (Standing.at("tray", stances("tray"), T) for T in (straight, tilted))
    assert a.stance.height == pytest.approx(catalogue()["tray"].dimensions[2])
    assert b.z_bottom == pytest.approx(a.z_bottom)
    assert b.bottom == pytest.approx(a.bottom, abs=1e-3)


def test_a_bowl_carries_a_wide_bottom_higher_than_a_narrow_one():
    bowl = Standing.at("bowl", stances("bowl"), np.eye(4))
    cup, shaker = (Standing.at(name, stances(name), np.eye(4)) for name in ("cup", "salt_shaker"))
    assert bowl.z_floor < bowl.rest_height(shaker.bottom) < bowl.rest_height(cup.bottom) < bowl.z_top


@pytest.mark.parametrize(
    ("lower", "upper", "resting"),
    [("bowl", "tea_box", 1), ("cup", "sponge", 0), ("mug", "cereal_box", 1), ("cup", "plate", 0), ("plate", "tray", 0)],
)
def test_what_reaches_over_a_rim_rests_on_it(lower: str, upper: str, resting: int):
    layout = Layout().put(lower, 0, 0).put(upper, 0, 0, resting=resting)
    below, above = (Standing.at(name, stances(name), T) for name, T in layout.poses.items())
    assert below.rest_height(above.bottom) == pytest.approx(below.z_top)


@pytest.mark.parametrize(
    ("lower", "upper", "x", "y", "height"),
    [
        ("cup", "cup_2", 0.0, 0.0, 0.034),
        ("mug", "soup_can", -0.0153, 0.0, 0.005),
        ("bowl", "sponge", 0.0, 0.0, 0.024),
        ("plate", "milk_carton", 0.0, 0.0, 0.006),
        ("tray", "sponge", -0.144, -0.103, 0.006),
        ("tray", "sponge", -0.165, 0.0, 0.006),
    ],
)
def test_what_sinks_into_an_opening_or_overhangs_one_side_rests_below_the_rim(
    lower: str, upper: str, x: float, y: float, height: float
):
    """Also what was estimated a centimetre into two walls of a tray."""
    layout = Layout().put(lower, 0, 0).put(upper, x, y)
    below, above = (Standing.at(name, stances(label_of(name)), T) for name, T in layout.poses.items())
    assert below.rest_height(above.bottom) - below.z_bottom == pytest.approx(height, abs=0.005)


@pytest.mark.parametrize("carrier", ["", "cereal_box", "tray"])
@pytest.mark.parametrize(("lift", "expected"), [(0.0, {}), (0.015, {}), (0.04, {"tea_box": 0.04})])
def test_what_hangs_above_what_is_said_to_carry_it_is_named(carrier: str, lift: float, expected: dict[str, float]):
    """A can of 4 cm under a box, between two, or in the tray, that nobody saw."""
    layout = Layout().put(carrier or "cereal_box", 0, 0, resting=1 if carrier == "cereal_box" else 0)
    layout.put("tea_box", 0 if carrier else 0.3, 0, on=carrier)
    layout.poses["tea_box"][2, 3] += lift
    graph = layout.graph()
    standing = [Standing.at(name, stances(name), T) for name, T in layout.poses.items()]
    assert gaps(standing, graph.assertions, Tolerances()) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(("x", "y"), [(-0.165, 0.0), (0.0, -0.1), (-0.165, -0.1)])
def test_what_overhangs_one_side_of_a_tray_hangs_above_its_floor(x: float, y: float):
    """The rim of one side, or of a corner, would not bear it: there must be something below."""
    layout = Layout().put("tray", 0, 0).put("sponge", x, y, on="tray")
    layout.poses["sponge"][2, 3] += 0.04
    standing = [Standing.at(name, stances(name), T) for name, T in layout.poses.items()]
    assert gaps(standing, layout.graph().assertions, Tolerances()) == pytest.approx({"sponge": 0.04}, abs=2e-3)


@pytest.mark.parametrize("upper", ["plate", "tray"])
def test_what_lies_on_the_rim_all_round_does_not_hang(upper: str):
    layout = Layout().put("bowl", 0, 0).put(upper, 0, 0, on="bowl")
    standing = [Standing.at(name, stances(name), T) for name, T in layout.poses.items()]
    layout.poses[upper][2, 3] += standing[0].z_top - standing[1].z_bottom
    standing = [Standing.at(name, stances(name), T) for name, T in layout.poses.items()]
    assert gaps(standing, layout.graph().assertions, Tolerances()) == {}


@pytest.mark.parametrize(
    ("lower", "upper", "sunk", "expected"),
    [
        ("sponge", "tea_box", 0.0, 0.0),
        ("tea_box", "tea_box_2", 0.037, 0.037),
        ("tray", "soup_can", 0.0, 0.0),
        ("cup", "salt_shaker", 0.02, 0.0),
    ],
)
def test_an_object_penetrates_another_one_unless_it_is_on_or_in_it(
    lower: str, upper: str, sunk: float, expected: float
):
    layout = Layout().put(lower, 0, 0).put(upper, 0, 0, on=lower)
    layout.poses[upper][2, 3] -= sunk
    a, b = (Standing.at(name, stances(name.removesuffix("_2")), T) for name, T in layout.poses.items())
    assert penetration(a, b, Tolerances()) == pytest.approx(expected, abs=2e-3)
    assert penetration(b, a, Tolerances()) == penetration(a, b, Tolerances())


def test_neighbours_penetrate_each_other_by_the_shortest_way_out():
    layout = Layout().put("soup_can", 0, 0).put("tea_box", 0, 0)
    a, b = (Standing.at(name, stances(name), T) for name, T in layout.poses.items())
    width = np.ptp(a.outline[:, 0])
    layout.poses["soup_can"][0, 3] = np.ptp(b.outline[:, 0]) / 2 + width / 2 - 0.03
    a = Standing.at("soup_can", stances("soup_can"), layout.poses["soup_can"])
    assert penetration(a, b, Tolerances()) == pytest.approx(0.03, abs=2e-3)
    layout.poses["soup_can"][0, 3] += 0.04
    assert penetration(Standing.at("soup_can", stances("soup_can"), layout.poses["soup_can"]), b, Tolerances()) == 0.0


@pytest.mark.parametrize(
    ("label", "x", "bottom", "top", "covered"),
    [
        ("tea_box", 0.0, 0.085, 0.12, True),
        ("tea_box", 0.0, 0.065, 0.12, True),
        ("tea_box", 0.0, 0.02, 0.12, False),  # Part of something on the table.
        ("tea_box", 0.0, 0.085, 0.1, False),  # The box, estimated too low.
        ("tea_box", 0.0, 0.2, 0.25, False),  # Hangs over it.
        ("tea_box", 0.03, 0.085, 0.12, False),  # Over the edge.
        ("bowl", 0.0, 0.02, 0.1, True),
        ("bowl", 0.0, 0.02, 0.06, False),  # The wall.
    ],
)
def test_what_no_object_explains_stands_on_what_it_is_clearly_above(
    label: str, x: float, bottom: float, top: float, covered: bool
) -> None:
    item = Standing.at(label, stances(label), Layout().put(label, 0.2, 0.1).poses[label])
    centre, extent = np.array([0.2 + x, 0.1, (bottom + top) / 2]), np.array([0.04, 0.04, top - bottom])
    thing = UnknownRegion(box=np.zeros(4), points=200, centre_table=centre, extent_table=extent)
    assert is_covered(item, (thing,), Tolerances()) == covered


@given(st.sampled_from(["tea_box", "mug", "tuna_can"]), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3, 3))
@settings(max_examples=60)
def test_objects_are_separated_as_far_as_there_is_a_gap_and_never_by_more(name: str, x: float, y: float, yaw: float):
    poses = Layout().put("sugar_box", 0.0, 0.0).put(name, x, y, yaw=yaw).poses
    a, b = (Standing.at(one, stances(one), T) for one, T in poses.items())
    gap = regions.gap(a.outline, b.outline)
    assert a.separation(b) == b.separation(a)
    assert gap >= a.separation(b) - 1e-12
    assert (gap > 1e-9) == (a.separation(b) > 1e-9)
