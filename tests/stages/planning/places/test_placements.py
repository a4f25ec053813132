"""How high objects come to rest at new places, and on which side."""

import pytest
from scipy.spatial.transform import Rotation

from stages.planning.places.placements import Placements, Scene
from stages.planning.symbolic.problem import TABLE
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
