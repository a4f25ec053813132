"""What may hide an object that is not seen."""

import numpy as np

from stages.geometry import regions
from stages.planning.hiding import hiders, uncovers
from stages.planning.placements import Scene
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
    heights = {"sponge": 0.0, "milk_carton": 0.0}
    assert hiders([stances("tuna_can")], seen, MOVABLE, heights) == ["milk_carton"]
    assert hiders([stances("tuna_can")], seen, MOVABLE - {"milk_carton"}, heights) == []


def test_what_hangs_in_the_air_is_looked_under_first_and_a_stack_from_its_top() -> None:
    layout = Layout().put("sponge", 0.0, -0.2).put("milk_carton", 0.0, 0.2)
    seen = scene(layout, {"sponge": "table", "milk_carton": "table"})
    found = hiders([stances("tuna_can")], seen, MOVABLE, {"sponge": 0.035, "milk_carton": 0.0})
    assert found == ["sponge", "milk_carton"]
    stacked = scene(
        layout.put("tuna_can", 0.0, -0.2), {"sponge": "table", "milk_carton": "table", "tuna_can": "sponge"}
    )
    heights = {"sponge": 0.035, "milk_carton": 0.0, "tuna_can": 0.07}
    assert hiders([stances("salt_shaker")], stacked, MOVABLE, heights)[0] == "tuna_can"


def test_what_is_put_aside_uncovers_what_was_behind_it() -> None:
    def at(x: float, y: float) -> Standing:
        return Standing.at(
            "milk_carton", stances("milk_carton"), Layout().put("milk_carton", x, y).poses["milk_carton"]
        )

    assert uncovers(at(0.0, 0.0), at(0.0, 0.25), EYE)
    assert not uncovers(at(0.0, 0.0), at(-0.2, 0.0), EYE)
    assert not uncovers(at(0.0, 0.0), at(0.1, 0.02), EYE)
