"""The renderer against geometry that can be computed by hand."""

from collections.abc import Iterator

import numpy as np
import pytest
import trimesh

from stages.perception.rendering.renderer import Camera, Item, Renderer, crease_normals
from stages.scene.catalogue import Mesh

WIDTH, HEIGHT = 160, 120
K = np.array([[150.0, 0, 81.3], [0, 152.0, 57.6], [0, 0, 1]])


def box(*extents: float, color: tuple[int, int, int] = (200, 60, 40)) -> Mesh:
    shape = trimesh.creation.box(extents)
    colors = np.tile(np.array(color, np.uint8), (len(shape.vertices), 1))
    return Mesh(np.asarray(shape.vertices), np.asarray(shape.faces, np.int32), colors)


def looking_at_origin(distance: float, pitch: float) -> Camera:
    """A camera that looks down at the origin by ``pitch`` radians, along world +y."""
    forward = np.array([0, np.cos(pitch), -np.sin(pitch)])
    right = np.array([1.0, 0, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = -distance * forward
    return Camera(K, pose)


def at(x: float, y: float, z: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def plane_depth(camera: Camera, height: float) -> np.ndarray:
    """Depth of the plane z = height at every pixel centre, H x W."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ camera.T_world_camera[:3, :3].T
    return (height - camera.T_world_camera[2, 3]) / rays[..., 2]


@pytest.fixture(scope="module")
def renderer() -> Iterator[Renderer]:
    renderer = Renderer(WIDTH, HEIGHT, capacity=2)
    yield renderer
    renderer.close()


def test_depth_of_a_slanted_plane_is_exact_at_pixel_centres(renderer: Renderer) -> None:
    camera = looking_at_origin(1.1, np.deg2rad(50))
    depth = renderer.depth([Item(box(8, 8, 0.02), at(0, 0, -0.01))], camera)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, plane_depth(camera, 0.0), atol=1e-4)


def test_silhouette_of_a_box_is_where_the_pinhole_model_puts_it(renderer: Renderer) -> None:
    camera = Camera(K, np.eye(4))
    identity, depth = renderer.instances([Item(box(0.2, 0.1, 0.2), at(0.03, -0.02, 1.1))], camera)
    rows, columns = np.nonzero(identity == 0)
    left, right = K[0, 2] + K[0, 0] * (0.03 - 0.1), K[0, 2] + K[0, 0] * (0.03 + 0.1)
    top, bottom = K[1, 2] + K[1, 1] * (-0.02 - 0.05), K[1, 2] + K[1, 1] * (-0.02 + 0.05)
    assert (columns.min(), columns.max()) == (np.ceil(left), np.floor(right))
    assert (rows.min(), rows.max()) == (np.ceil(top), np.floor(bottom))
    np.testing.assert_allclose(depth[identity == 0], 1.0, atol=1e-4)
    assert (depth[identity < 0] == 0).all()


def test_nearer_items_hide_farther_ones_and_copies_keep_their_index(renderer: Renderer) -> None:
    mesh = box(0.2, 0.2, 0.2)
    identity, _ = renderer.instances(
        [Item(mesh, at(0, 0, 1.5)), Item(mesh, at(0, 0, 1.0)), Item(mesh, at(0.3, 0, 1.0))], Camera(K, np.eye(4))
    )
    assert identity[58, 81] == 1
    assert set(np.unique(identity)) == {-1, 1, 2}


def test_forgotten_meshes_can_be_rendered_again(renderer: Renderer) -> None:
    camera = Camera(K, np.eye(4))
    meshes = [box(0.1 * k, 0.1, 0.1) for k in range(1, 6)]
    first = [renderer.depth([Item(mesh, at(0, 0, 1))], camera) for mesh in meshes]
    again = [renderer.depth([Item(mesh, at(0, 0, 1))], camera) for mesh in meshes]
    np.testing.assert_array_equal(first, again)


def test_closing_one_renderer_leaves_the_others_alone(renderer: Renderer) -> None:
    items, camera = [Item(box(0.2, 0.2, 0.2), at(0, 0, 1))], Camera(K, np.eye(4))
    before = renderer.depth(items, camera)
    other = Renderer(40, 30)
    other.depth(items, camera)
    other.close()
    np.testing.assert_array_equal(renderer.depth(items, camera), before)


def test_an_empty_scene_is_background(renderer: Renderer) -> None:
    camera = Camera(K, np.eye(4))
    assert (renderer.color([], camera, background=(10, 120, 250)) == (10, 120, 250)).all()
    assert (renderer.depth([], camera) == 0).all()


def test_colour_image_shows_the_vertex_colour_and_repeats_exactly(renderer: Renderer) -> None:
    camera = looking_at_origin(1.0, np.deg2rad(60))
    items = [Item(box(0.3, 0.3, 0.1, color=(30, 60, 200)), at(0, 0, 0))]
    rgb = renderer.color(items, camera)
    red, green, blue = rgb[58, 81]
    assert blue > 120 and blue > 2 * red and green > red
    np.testing.assert_array_equal(rgb, renderer.color(items, camera))


def test_normals_are_sharp_on_a_box_and_smooth_on_a_cylinder() -> None:
    cube = box(1, 1, 1)
    axes = np.abs(crease_normals(cube))
    np.testing.assert_allclose(np.sort(axes, axis=1), np.tile((0, 0, 1), (len(axes), 1)), atol=1e-9)

    shape = trimesh.creation.cylinder(radius=1.0, height=2.0, sections=24)
    cylinder = Mesh(
        np.asarray(shape.vertices), np.asarray(shape.faces, np.int32), np.zeros_like(shape.vertices, np.uint8)
    )
    corners = cylinder.vertices[cylinder.faces.reshape(-1)]
    normals = crease_normals(cylinder)
    side = np.abs(normals[:, 2]) < 0.5
    np.testing.assert_allclose(normals[side, :2], corners[side, :2], atol=0.05)
