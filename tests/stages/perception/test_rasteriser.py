"""The fast kernel against the exact rasteriser."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.perception.poses import exp_so3, pose
from stages.perception.rasteriser import Soup, View, inverse_depth
from tests.stages.perception import oracle
from tests.stages.perception.scenes import CATALOGUE

VIEW = View(110.0, 112.0, 39.2, 30.7, 80, 60)


@given(
    label=st.sampled_from(["mug", "cereal_box", "bowl", "sauce_bottle"]),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.floats(0.35, 1.0)),
)
@settings(max_examples=30, deadline=None)
def test_kernel_agrees_with_the_oracle(label: str, turn: tuple[float, ...], shift: tuple[float, ...]) -> None:
    mesh = CATALOGUE[label].simplified(200)
    T = pose(exp_so3(np.array(turn)), np.array(shift))
    exact = oracle.inverse_depth(mesh, T, VIEW)
    fast = inverse_depth(Soup.of(mesh), T, VIEW)
    both = (exact > 0) & (fast > 0)
    # A pixel centre within rounding of an edge may fall on either side of it.
    assert ((exact > 0) != (fast > 0)).sum() <= 2 + 0.002 * both.sum()
    differs = np.abs(fast[both] / np.maximum(exact[both], 1e-9) - 1) > 1e-3
    assert differs.sum() <= 2 + 0.01 * both.sum()


def test_what_reaches_into_the_camera_is_not_rendered() -> None:
    soup = Soup.of(CATALOGUE["mug"].mesh)
    assert not inverse_depth(soup, pose(np.eye(3), np.array([0.0, 0.0, 0.02])), VIEW).any()


def test_a_sampled_view_sees_every_second_pixel() -> None:
    soup = Soup.of(CATALOGUE["cereal_box"].mesh)
    T = pose(exp_so3(np.array([0.4, 0.3, 0.2])), np.array([0.0, 0.0, 0.7]))
    full = inverse_depth(soup, T, VIEW)
    part = inverse_depth(soup, T, VIEW.sampled(10, 6, 70, 51, 2))
    assert part.shape == (23, 30)
    assert np.isclose(part, full[6:51:2, 10:70:2], rtol=1e-4).mean() > 0.99


def test_projection_meets_rays() -> None:
    points = VIEW.rays()[7, 31] * 0.8
    assert VIEW.project(points) == pytest.approx([31, 7])
