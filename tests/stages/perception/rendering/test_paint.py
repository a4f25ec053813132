"""Objects drawn in the colours of their surface."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.poses import exp_so3, pose
from stages.perception.rendering.paint import Paint
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.scene.catalogue import Mesh
from tests.stages.perception.scenes import CATALOGUE

VIEW = View(500.0, 500.0, 79.5, 79.5, 160, 160)


def test_it_is_where_depth_has_it() -> None:
    mesh = CATALOGUE["mug"].mesh
    T = pose(exp_so3(np.array([1.9, 0.3, 0.0])), np.array([0.01, 0.0, 0.5]))
    colors, covered = Paint.of(mesh).drawn(T, VIEW)
    assert np.array_equal(covered, inverse_depth(Soup.of(mesh), T, VIEW) > 0)
    assert not colors[~covered].any() and colors[covered].any(-1).all()


def test_colours_are_interpolated_between_corners_and_the_nearer_triangle_hides_the_other() -> None:
    corners = np.array([[0.0, 0, 0], [0, 0.1, 0], [0.1, 0, 0], [0, 0, 0.1], [0, 0.1, 0.1], [0.1, 0, 0.1]])
    colors = np.array([[0, 0, 0], [0, 200, 0], [200, 0, 0], *[[0, 0, 255]] * 3], np.uint8)
    mesh = Mesh(corners, np.array([[0, 1, 2], [3, 4, 5]], np.int32), colors)
    image, covered = Paint.of(mesh).drawn(pose(np.eye(3), np.array([0.0, 0.0, 0.5])), VIEW)
    u, v = VIEW.project(np.array([0.03, 0.05, 0.5])).round().astype(int)
    assert covered[v, u]
    assert image[v, u] == pytest.approx([60, 100, 0], abs=2)
