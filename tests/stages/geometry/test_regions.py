"""Convex regions against a dense grid of points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.geometry import regions
from stages.scene.stance import yawed

boxes = st.tuples(
    st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(0.02, 0.3), st.floats(0.02, 0.3), st.floats(-np.pi, np.pi)
)


def region(box: tuple[float, float, float, float, float]) -> regions.Region:
    x, y, w, h, yaw = box
    corners = regions.rectangle((-w / 2, -h / 2), (w / 2, h / 2))
    return regions.moved(corners, yawed(yaw, np.array([x, y, 0.0])))


@given(boxes, boxes)
@settings(max_examples=60)
def test_overlap_agrees_with_counted_points(a: tuple[float, ...], b: tuple[float, ...]):
    first, second = region(a), region(b)  # type: ignore[arg-type]
    axis = np.linspace(-0.5, 0.5, 200)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    inside = (regions.depth(first, points) >= 0) & (regions.depth(second, points) >= 0)
    assert regions.overlap_area(first, second) == pytest.approx(inside.mean() * 1.01, abs=6e-3)


@given(boxes, boxes)
@settings(max_examples=60)
def test_gap_is_symmetric_and_never_below_what_separates_along_a_normal(a: tuple[float, ...], b: tuple[float, ...]):
    first, second = region(a), region(b)  # type: ignore[arg-type]
    assert regions.gap(first, second) == pytest.approx(regions.gap(second, first), abs=1e-12)
    separation = max(regions.beyond(regions.sides(first), second), regions.beyond(regions.sides(second), first))
    assert regions.gap(first, second) >= separation - 1e-12
    assert (regions.gap(first, second) > 1e-9) == (separation > 1e-9)


def test_gap_of_diagonal_neighbours_is_between_corners():
    a, b = regions.rectangle((0, 0), (1, 1)), regions.rectangle((2, 2), (3, 3))
    assert regions.gap(a, b) == pytest.approx(np.sqrt(2))
    assert regions.beyond(regions.sides(a), b) == pytest.approx(1)


def test_nested_regions_overlap_by_the_inner_one():
    inner, outer = regions.rectangle((0, 0), (1, 1)), regions.rectangle((-1, -1), (2, 2))
    assert regions.overlap_area(inner, outer) == pytest.approx(1)
    assert regions.gap(inner, outer) == 0
    assert regions.inside(inner, outer, margin=0.99)
    assert not regions.inside(inner, outer, margin=1.01)


def test_points_on_a_line_span_no_region():
    assert len(regions.hull(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]))) == 0


def test_centroid_of_a_triangle():
    triangle = regions.hull(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]]))
    assert regions.centroid(triangle) == pytest.approx([1.0, 1.0])
    assert regions.area(triangle) == pytest.approx(4.5)
