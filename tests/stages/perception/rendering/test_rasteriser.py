"""The fast kernel against the exact rasteriser."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.geometry.poses import exp_so3, pose
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.scene.catalogue import Mesh
from tests.stages.perception import oracle
from tests.stages.perception.scenes import CATALOGUE

VIEW = View(110.0, 112.0, 39.2, 30.7, 80, 60)


@given(
    label=st.sampled_from(["mug", "cereal_box", "bowl", "sauce_bottle"]),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.floats(0.35, 1.0)),
)
@settings(max_examples=30)
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


@pytest.mark.parametrize("width, height", [(80, 60), (83, 61), (16, 3), (3, 2)])
@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.4), (0.13, 0.1, 0.4), (-0.14, 0.0, 0.4), (0.0, -0.12, 0.5)])
def test_what_the_image_cuts_off_does_not_appear_elsewhere(
    width: int, height: int, shift: tuple[float, float, float]
) -> None:
    mesh = CATALOGUE["cereal_box"].simplified(200)
    view = View(110.0, 112.0, width / 2, height / 2, width, height)
    T = pose(exp_so3(np.array([0.3, 0.4, 0.5])), np.array(shift))
    exact = oracle.inverse_depth(mesh, T, view)
    fast = inverse_depth(Soup.of(mesh), T, view)
    assert ((exact > 0) != (fast > 0)).sum() <= 2
    both = (exact > 0) & (fast > 0)
    assert fast[both] == pytest.approx(exact[both], rel=1e-3)


def triangle(*corners: tuple[float, float, float]) -> Mesh:
    """A mesh of one triangle with corners at u, v in pixels and depth in metres, whichever way round is its front."""
    points = np.array([[(u - VIEW.cx) / VIEW.fx * z, (v - VIEW.cy) / VIEW.fy * z, z] for u, v, z in corners])
    a, b = points[1] - points[0], points[2] - points[0]
    front = np.cross(a, b) @ points[0] < 0
    return Mesh(points, np.array([[0, 1, 2] if front else [0, 2, 1]], np.int32), np.zeros((3, 3), np.uint8))


def drawn(*corners: tuple[float, float, float]) -> np.ndarray:
    return inverse_depth(Soup.of(triangle(*corners)), np.eye(4), VIEW)


def test_a_triangle_around_one_pixel_centre_draws_that_pixel() -> None:
    image = drawn((9.7, 19.8, 0.5), (10.4, 19.8, 0.5), (10.0, 20.3, 0.5))
    assert np.argwhere(image).tolist() == [[20, 10]]
    assert image[20, 10] == pytest.approx(2.0)


def test_a_triangle_between_pixel_centres_draws_nothing() -> None:
    assert not drawn((9.1, 19.1, 0.5), (9.9, 19.1, 0.5), (9.5, 19.9, 0.5)).any()


def test_edges_are_inclusive() -> None:
    # A little outside, because corners are rounded when they are projected.
    out = 1e-3
    image = drawn((8 - out, 8 - out, 0.5), (16 + 2 * out, 8 - out, 0.5), (8 - out, 16 + 2 * out, 0.5))
    assert np.count_nonzero(image) == 9 * 10 // 2


@pytest.mark.parametrize("thickness", [0.0, 1e-9, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, 1.2, np.pi / 2])
def test_slivers_draw_nothing_beside_or_beyond_themselves(thickness: float, angle: float) -> None:
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    start = np.array([30.0, 20.0])
    ends = [start - 15 * along, start + 25 * along, start + thickness * across]
    image = drawn(*((u, v, z) for (u, v), z in zip(ends, (0.4, 0.6, 0.5), strict=True)))
    rows, columns = np.nonzero(image)
    away = np.stack([columns, rows], -1) - start
    assert (np.abs(away @ across) <= thickness + 1e-2).all()
    assert (np.abs(away @ along) <= 26).all()
    assert (image[rows, columns] < 1.05 / 0.4).all()


def test_back_faces_are_not_drawn() -> None:
    mesh = triangle((10.0, 10.0, 0.5), (30.0, 10.0, 0.5), (10.0, 30.0, 0.5))
    turned = Mesh(mesh.vertices, mesh.faces[:, ::-1].copy(), mesh.colors)
    assert inverse_depth(Soup.of(mesh), np.eye(4), VIEW).any()
    assert not inverse_depth(Soup.of(turned), np.eye(4), VIEW).any()


def test_the_nearer_of_two_triangles_is_seen_in_either_order() -> None:
    near = triangle((10.0, 10.0, 0.5), (30.0, 10.0, 0.5), (10.0, 30.0, 0.5))
    far = triangle((5.0, 5.0, 0.8), (45.0, 5.0, 0.8), (5.0, 45.0, 0.8))
    images = []
    for first, second in ((near, far), (far, near)):
        vertices = np.concatenate([first.vertices, second.vertices])
        both = Mesh(vertices, np.concatenate([first.faces, second.faces + 3]), np.zeros((6, 3), np.uint8))
        images.append(inverse_depth(Soup.of(both), np.eye(4), VIEW))
    assert images[0].tobytes() == images[1].tobytes()
    assert images[0][12, 12] == pytest.approx(2.0)
    assert images[0][7, 7] == pytest.approx(1.25)


@pytest.mark.parametrize("z", [-0.7, 0.0, 0.04])
def test_what_is_behind_the_camera_or_too_near_is_not_drawn(z: float) -> None:
    soup = Soup.of(CATALOGUE["cereal_box"].simplified(200))
    assert not inverse_depth(soup, pose(np.eye(3), np.array([0.02, 0.01, z])), VIEW).any()


@pytest.mark.parametrize("x", [-3.0, 3.0])
def test_what_is_beside_the_image_is_not_drawn(x: float) -> None:
    soup = Soup.of(CATALOGUE["cereal_box"].simplified(200))
    assert not inverse_depth(soup, pose(np.eye(3), np.array([x, 0.0, 0.7])), VIEW).any()


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
