"""Colour: CIELAB, light removed, and verdicts between poses that look alike in depth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages.geometry.poses import exp_so3, pose
from stages.perception.refinement.colour import Contender, Paint, Verdict, cielab, distances, judge, surface_normals
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.scene.catalogue import Mesh
from tests.stages.perception.painted import painted
from tests.stages.perception.scenes import CATALOGUE

VIEW = View(500.0, 500.0, 79.5, 79.5, 160, 160)
CAN = CATALOGUE["soup_can"]
STANDING = pose(exp_so3(np.array([np.pi / 2 + 0.6, 0.0, 0.0])), np.array([0.0, 0.0, 0.6]))
TURNED = STANDING @ pose(exp_so3(np.array([np.pi, 0.0, 0.0])), np.zeros(3))
PAINT = Paint.of(CAN.mesh)


def verdict(rgb: np.ndarray, *, favourite: int, paint: Paint = PAINT) -> Verdict | None:
    """Standing is 0, turned is 1, whichever is depth's favourite."""
    layers = [inverse_depth(Soup.of(CAN.mesh), T, VIEW) for T in (STANDING, TURNED)]
    contenders = [Contender(T[:3], layer) for T, layer in zip((STANDING, TURNED), layers, strict=True)]
    order = [favourite, 1 - favourite]
    visible = np.logical_and.reduce([layer > 0 for layer in layers])
    symmetries = CAN.symmetries.transforms(np.deg2rad(30))
    found = judge(rgb, VIEW, visible, [contenders[k] for k in order], paint=paint, symmetries=symmetries)
    return None if found is None else Verdict(order[found.winner], found.distances[order])


def test_cielab_agrees_with_opencv() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (50, 1, 3)).astype(np.uint8)
    expected = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    assert cielab(rgb) == pytest.approx(expected, abs=0.4)
    assert cielab(np.array([255, 255, 255])) == pytest.approx([100, 0, 0], abs=1e-6)


def test_paint_is_interpolated_between_vertices() -> None:
    corners = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    mesh = Mesh(corners, np.array([[0, 1, 2]], np.int32), np.array([[0, 0, 0], [200, 200, 200], [0, 0, 0]], np.uint8))
    halfway = Paint.of(mesh).at(np.array([0.05, 0.001, 0.0]))
    assert halfway == pytest.approx(cielab(np.array([100, 100, 100])), abs=2.0)


@pytest.mark.parametrize("favourite", [0, 1])
@pytest.mark.parametrize("true", [0, 1])
def test_the_way_up_is_seen_by_its_colours(true: int, favourite: int) -> None:
    rgb = painted([(CAN.mesh, (STANDING, TURNED)[true])], VIEW)
    found = verdict(rgb, favourite=favourite)
    assert found is not None and found.winner == true
    assert found.distances[true] < found.distances[1 - true]


@pytest.mark.parametrize(
    ("gain", "offset", "ambient"), [(0.5, 0, 0.5), (1.25, 10, 0.8), (0.7, 50, 0.3), (1.6, -20, 0.5)]
)
def test_the_light_does_not_matter(gain: float, offset: float, ambient: float) -> None:
    rgb = painted([(CAN.mesh, STANDING)], VIEW, ambient=ambient)
    found = verdict((gain * rgb.astype(float) + offset).clip(0, 255).astype(np.uint8), favourite=1)
    assert found is not None and found.winner == 0


def test_gain_and_offset_of_lightness_leave_no_distance() -> None:
    rng = np.random.default_rng(1)
    paint = rng.uniform([20, -40, -40], [80, 40, 40], (300, 3))
    normals = np.tile([0.0, 0.0, -1.0], (300, 1))
    lit = paint * [0.8, 0.7, 0.7] + [12.0, 3.0, -4.0]
    same, lighter = distances(paint, np.stack([paint, paint]), normals)[0], distances(lit, paint[None], normals)[0]
    other = distances(lit, paint[None, ::-1], normals)[0]
    assert same.mean() < 0.05 and lighter.mean() < 0.3 and other.mean() > 10


def test_highlights_do_not_decide() -> None:
    rgb = painted([(CAN.mesh, STANDING)], VIEW)
    rgb[60:75, 70:80] = 255
    found = verdict(rgb, favourite=1)
    assert found is not None and found.winner == 0


@pytest.mark.parametrize("favourite", [0, 1])
def test_an_object_of_one_colour_stays_as_depth_has_it(favourite: int) -> None:
    plain = replace(CAN.mesh, colors=np.full_like(CAN.mesh.colors, (180, 40, 30)))
    found = verdict(painted([(plain, STANDING)], VIEW), favourite=favourite, paint=Paint.of(plain))
    assert found is not None and found.winner == favourite


@pytest.mark.parametrize("favourite", [0, 1])
def test_an_image_that_shows_nothing_decides_nothing(favourite: int) -> None:
    noise = np.random.default_rng(5).integers(0, 256, (VIEW.height, VIEW.width, 3)).astype(np.uint8)
    for rgb in (np.zeros_like(noise), noise):
        found = verdict(rgb, favourite=favourite)
        assert found is not None and found.winner == favourite


def test_a_few_pixels_decide_nothing() -> None:
    rgb = painted([(CAN.mesh, STANDING)], VIEW)
    layer = inverse_depth(Soup.of(CAN.mesh), STANDING, VIEW)
    few = np.zeros(layer.shape, bool)
    few[80:88, 80:88] = True
    contenders = [Contender(STANDING[:3], layer)] * 2
    assert judge(rgb, VIEW, few, contenders, paint=PAINT, symmetries=np.eye(4)[None]) is None


def test_normals_of_a_plane() -> None:
    n = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    layer = (VIEW.rays() @ n / 0.7).astype(np.float32)
    assert surface_normals(layer, VIEW)[5, 9] == pytest.approx(n, abs=1e-3)
