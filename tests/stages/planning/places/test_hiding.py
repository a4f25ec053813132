"""What may hide an object that is not seen."""

from dataclasses import replace

import numpy as np
import pytest

from stages.geometry import regions
from stages.geometry.poses import raised
from stages.planning.places.hiding import hiders, uncovers
from stages.planning.places.placements import Scene
from stages.planning.symbolic.problem import TABLE
from stages.scene.stance import Standing
from tests.stages.layouts import Layout, stances

EYE = np.array([-0.6, 0.0, 0.4])
SURFACE = regions.rectangle([-0.2, -0.4], [0.3, 0.4])
MOVABLE = {"milk_carton", "sponge", "tuna_can"}


def scene(layout: Layout, supports: dict[str, str]) -> Scene:
    items = {name: Standing.at(name, stances(name), T) for name, T in layout.poses.items()}
    return Scene(items, supports, np.eye(4), SURFACE, EYE)


def test_what_is_tall_and_wide_is_looked_behind_first() -> None:
    seen = scene(
        Layout().put("sponge", 0.0, -0.2).put("milk_carton", 0.0, 0.2), {"sponge": "table", "milk_carton": "table"}
    )
    assert hiders([stances("tuna_can")], seen, MOVABLE) == ["milk_carton"]
    assert hiders([stances("tuna_can")], seen, MOVABLE - {"milk_carton"}) == []


def test_a_box_on_its_end_hides_a_can_in_the_strip_behind_it() -> None:
    """The scene of seed 389 of the suite hidden: an object of 5 by 12 cm, and a can where only it hides anything."""
    eye = np.array([0.088, -0.432, 0.686])
    box = Layout().put("cereal_box", 0.009, 0.012, yaw=-0.273)
    found = hiders([stances("tuna_can")], replace(scene(box, {"cereal_box": TABLE}), eye=eye), {"cereal_box"})
    assert found == ["cereal_box"]


def test_what_stands_in_a_tray_is_looked_behind() -> None:
    tray = Layout().put("tray", 0.1, 0.0).put("milk_carton", -0.05, 0.0, on="tray")
    seen = scene(tray, {"tray": TABLE, "milk_carton": "tray"})
    assert hiders([stances("salt_shaker")], seen, MOVABLE) == ["milk_carton"]


def test_what_hangs_in_the_air_is_looked_under_first_and_a_stack_from_its_top() -> None:
    layout = Layout().put("sponge", 0.0, -0.2).put("milk_carton", 0.0, 0.2)
    layout.poses["sponge"] = raised(layout.poses["sponge"], 0.035)
    assert hiders([stances("tuna_can")], scene(layout, dict.fromkeys(layout.poses, TABLE)), MOVABLE) == [
        "sponge",
        "milk_carton",
    ]
    layout.put("tuna_can", 0.0, 0.0, on="sponge")
    stacked = scene(layout, {"sponge": TABLE, "milk_carton": TABLE, "tuna_can": "sponge"})
    assert hiders([stances("salt_shaker")], stacked, MOVABLE)[0] == "tuna_can"


def test_what_hangs_in_the_air_stays_there_with_what_it_carries() -> None:
    layout = Layout().put("sponge", 0.0, -0.2).put("tuna_can", 0.0, 0.0, on="sponge").put("soup_can", 0.1, 0.2)
    height = Standing.at("tuna_can", stances("tuna_can"), layout.poses["tuna_can"]).z_bottom
    raised_by = {"sponge": 0.035, "tuna_can": 0.037, "soup_can": 0.005}
    lifted = Layout({name: raised(T, raised_by[name]) for name, T in layout.poses.items()})
    seen = Scene.of(lifted.graph(), {name: stances(name) for name in lifted.poses})
    assert seen.hangs("sponge") and not seen.hangs("tuna_can") and not seen.hangs("soup_can")
    assert seen.standing["tuna_can"].z_bottom == pytest.approx(height + 0.035)
    assert seen.standing["soup_can"].z_bottom == pytest.approx(0.0)


def test_what_is_put_aside_uncovers_what_was_behind_it() -> None:
    def at(x: float, y: float) -> Standing:
        return Standing.at(
            "milk_carton", stances("milk_carton"), Layout().put("milk_carton", x, y).poses["milk_carton"]
        )

    assert uncovers(at(0.0, 0.0), at(0.0, 0.25), EYE)
    assert not uncovers(at(0.0, 0.0), at(-0.2, 0.0), EYE)
    assert not uncovers(at(0.0, 0.0), at(0.1, 0.02), EYE)
