"""How high objects come to rest at new places, and on which side."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages.geometry import regions
from stages.planning.places.placements import Placements, Scene
from stages.planning.symbolic.problem import TABLE
from stages.planning.symbolic.search import Step
from stages.scene.stance import Standing
from tests.stages.layouts import Layout, stances


def tilted(name: str, degrees: float) -> Standing:
    """An object above a sponge, its z axis tilted towards the table's y."""
    T = Layout().put("sponge", 0.0, 0.0).put(name, 0.0, 0.0, on="sponge").poses[name]
    T[:3, :3] = Rotation.from_euler("x", -degrees, degrees=True).as_matrix() @ T[:3, :3]
    return Standing.at(name, stances(name), T)


def seen() -> Scene:
    return Scene.of(Layout().put("sponge", 0.0, 0.0).graph(), {"sponge": stances("sponge")})


@pytest.mark.parametrize("support", [TABLE, "sponge"])
@pytest.mark.parametrize("degrees", [0, 10, 20, 45])
def test_what_leans_rests_on_its_lowest_point(degrees: float, support: str) -> None:
    scene = seen()
    surface = 0.0 if support == TABLE else scene.standing[support].z_top
    assert scene.rested(tilted("soup_can", degrees), support).z_bottom == pytest.approx(surface, abs=1e-9)


@pytest.mark.parametrize(("degrees", "lies"), [(0, 0), (20, 0), (40, 0), (50, 90), (70, 90), (90, 90)])
def test_what_leans_is_set_down_on_the_side_that_it_is_nearest_to(degrees: float, lies: float) -> None:
    placements = Placements(Layout().graph(), {"soup_can": stances("soup_can")}, Layout().graph())
    settled = placements.settled(tilted("soup_can", degrees))
    assert settled.stance.aligned
    assert settled.T_table_object[:, 2:] == pytest.approx(tilted("soup_can", lies).T_table_object[:, 2:], abs=1e-6)


@settings(max_examples=20)
@given(yaw=st.floats(-3, 3), margin=st.sampled_from([0.005, 0.0, None]), name=st.sampled_from(["sponge", "soup_can"]))
def test_places_over_a_surface_are_those_of_which_the_bottom_lies_there(yaw: float, margin: float | None, name: str):
    goal = Layout().put("tray", 0.0, 0.0).put(name, 0.05, 0.03, yaw=yaw, on="tray").graph()
    start = Layout().put("tray", 0.1, 0.0, yaw=yaw).put(name, -0.3, 0.3).graph()
    known = {label: stances(label) for label in ("tray", name)}
    scene = Scene.of(start, known)
    floor, every = scene.standing["tray"].floor, Placements(goal, known, goal).of(Step(name, TABLE, "tray"), scene)
    kept = [
        placement
        for placement in every
        if regions.inside(placement.standing.bottom, floor, margin=margin or 0.0)
        or (margin is None and regions.inside(regions.centroid(placement.standing.bottom)[None], floor))
    ]
    found = list(every.over(floor, margin))
    assert 0 < len(found) < len(list(every))
    assert [one.cost for one in found] == [one.cost for one in kept]
    assert all((a.standing.T_table_stance == b.standing.T_table_stance).all() for a, b in zip(found, kept, strict=True))
