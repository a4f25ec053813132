"""Which places other objects hide from the camera."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.geometry import regions
from stages.planning.places.sight import hidden_share
from stages.scene.stance import Standing
from tests.stages.layouts import Layout, stances

EYE = np.array([-0.6, 0.0, 0.4])


def standing(layout: Layout) -> dict[str, Standing]:
    return {name: Standing.at(name, stances(name), T) for name, T in layout.poses.items()}


def hidden(layout: Layout, name: str, eye: np.ndarray = EYE) -> float:
    items = standing(layout)
    return hidden_share(items.pop(name), list(items.values()), eye)


def test_a_shaker_behind_a_carton_is_hidden() -> None:
    carton = Layout().put("milk_carton", 0.0, 0.0)
    assert hidden(Layout(dict(carton.poses)).put("salt_shaker", 0.07, 0.0), "salt_shaker") == 1.0
    assert hidden(Layout(dict(carton.poses)).put("salt_shaker", -0.15, 0.0), "salt_shaker") == 0.0
    assert hidden(Layout(dict(carton.poses)).put("salt_shaker", 0.0, 0.3), "salt_shaker") == 0.0
    assert hidden(Layout(dict(carton.poses)).put("salt_shaker", 0.6, 0.0), "salt_shaker") == 0.0


def test_from_above_only_what_is_above_hides() -> None:
    layout = Layout().put("milk_carton", 0.0, 0.0).put("salt_shaker", 0.2, 0.0)
    assert hidden(layout, "salt_shaker", np.array([0.2, 0.0, 1.0])) == 0.0


def test_half_behind_is_half_hidden() -> None:
    layout = Layout().put("milk_carton", 0.0, 0.0).put("soup_can", 0.09, 0.05)
    assert 0.1 < hidden(layout, "soup_can") < 0.9


def test_nothing_hides_what_stands_alone() -> None:
    assert hidden(Layout().put("mug", 0.0, 0.0), "mug") == 0.0


@settings(max_examples=40)
@given(
    st.floats(-0.2, 0.3), st.floats(-0.2, 0.2), st.floats(-3, 3),
    st.tuples(st.floats(-1.0, -0.4), st.floats(-0.5, 0.5), st.floats(0.3, 1.2)),
)  # fmt: skip
def test_lines_of_sight_agree_with_points_along_them(
    x: float, y: float, yaw: float, eye: tuple[float, float, float]
) -> None:
    layout = Layout().put("tea_box", 0.0, 0.0, yaw=yaw).put("salt_shaker", x, y)
    items = standing(layout)
    box, shaker = items["tea_box"], items["salt_shaker"]
    share = hidden_share(shaker, [box], np.array(eye))
    steps = np.linspace(0, 1, 400)[:, None]
    count = 0
    outline = np.concatenate([shaker.outline, shaker.outline.mean(0)[None]])
    for z in shaker.z_bottom + np.array([0.1, 0.5, 0.9]) * (shaker.z_top - shaker.z_bottom):
        for corner in outline:
            line = np.array(eye) + steps * (np.append(corner, z) - np.array(eye))
            level = (line[:, 2] > box.z_bottom) & (line[:, 2] < box.z_top)
            count += bool((level & (regions.depth(box.outline, line[:, :2]) > 0)).any())
    assert share == pytest.approx(count / (3 * len(outline)), abs=0.1)
