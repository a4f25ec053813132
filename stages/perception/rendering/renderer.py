"""Renders coloured meshes to RGB, depth and instance images with OpenGL, with or without a display."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
os.environ.setdefault("PYGLET_HEADLESS", "1")

import numpy as np
from numpy.typing import NDArray

if not hasattr(np, "infty"):
    # pyrender 0.1.45 still uses the name that numpy 2 removed.
    np.infty = np.inf

import pyrender
import trimesh
from pyrender.constants import RenderFlags
from scipy.spatial import KDTree

from stages.geometry.arrays import Floats
from stages.scene.catalogue import Mesh

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_GAMMA = 2.2  # The shader's output gamma; inverting it keeps a lit vertex colour what the catalogue says.
_CREASE = np.cos(np.deg2rad(40.0))


@dataclass(frozen=True)
class Item:
    """A mesh somewhere in the world."""

    mesh: Mesh
    T_world_item: Floats


@dataclass(frozen=True)
class Light:
    """A directional light (``vector`` is where it shines to) or a point light (where it stands, metres)."""

    kind: Literal["directional", "point"]
    vector: tuple[float, float, float]
    intensity: float
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Lighting:
    """Everything that brightens a scene; pyrender takes at most four lights of a kind."""

    lights: tuple[Light, ...] = (
        Light("directional", (0.35, 0.25, -1.0), 2.2),
        Light("directional", (0.45, -0.55, -0.6), 1.3),
    )
    ambient: tuple[float, float, float] = (0.38, 0.38, 0.38)


@dataclass(frozen=True)
class Camera:
    """Pinhole camera: OpenCV intrinsics (pixel centres at integer coordinates) and optical frame."""

    K: Floats
    T_world_camera: Floats
    near: float = 0.05
    far: float = 10.0


class Renderer:
    """An off-screen OpenGL context of fixed image size; meshes are uploaded once.

    Meshes are known by identity: render the same :class:`Mesh` instance again rather than a copy. One
    renderer per process and thread. At most ``capacity`` meshes stay uploaded.
    """

    def __init__(self, width: int, height: int, *, capacity: int = 256) -> None:
        self.width = width
        self.height = height
        self._capacity = capacity
        self._offscreen: Any = _Offscreen(width, height)
        self._scene = pyrender.Scene()
        self._camera = self._scene.add(pyrender.IntrinsicsCamera(1.0, 1.0, 0.0, 0.0))
        self._lights: list[Any] = []
        self._nodes: dict[int, list[Any]] = {}
        self._uploaded: dict[int, Mesh] = {}

    def color(
        self,
        items: Sequence[Item],
        camera: Camera,
        *,
        lighting: Lighting | None = None,
        background: tuple[int, int, int] = (0, 0, 0),
    ) -> NDArray[np.uint8]:
        """The anti-aliased, lit RGB image, H x W x 3, sRGB."""
        self._place(items, camera)
        self._light(lighting or Lighting())
        self._scene.bg_color = np.append(np.asarray(background) / 255.0, 1.0)
        rgb, _ = self._offscreen.render(self._scene, RenderFlags.NONE)
        return np.ascontiguousarray(rgb[..., :3])

    def instances(self, items: Sequence[Item], camera: Camera) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Which item each pixel shows, H x W (index into ``items``, -1 where none), and its depth, H x W.

        Depth is metres along the optical axis at pixel centres, 0 where there is nothing.
        """
        nodes = self._place(items, camera)
        codes = {node: ((i + 1) & 255, (i + 1) >> 8, 0) for i, node in enumerate(nodes)}
        # Without multisampling, unlike the lit image: a resolved sample lies off the pixel's centre.
        image, depth = self._offscreen.render(self._scene, RenderFlags.SEG, codes)
        identity = image[..., 0].astype(np.int32) + 256 * image[..., 1].astype(np.int32) - 1
        return identity, depth

    def depth(self, items: Sequence[Item], camera: Camera) -> NDArray[np.float32]:
        """Metres along the optical axis at pixel centres, H x W; 0 where there is nothing."""
        return self.instances(items, camera)[1] if items else np.zeros((self.height, self.width), np.float32)

    def close(self) -> None:
        """Frees what was uploaded; other renderers of the process go on."""
        self._offscreen.delete()

    def _place(self, items: Sequence[Item], camera: Camera) -> list[Any]:
        """Puts camera and items where they are told and hides every other mesh; one node per item."""
        self._aim(camera)
        used: dict[int, int] = {}
        nodes: list[Any] = []
        for item in items:
            copies = self._copies(item.mesh)
            position = used.get(id(item.mesh), 0)
            used[id(item.mesh)] = position + 1
            if position == len(copies):
                copies.append(self._scene.add(copies[0].mesh))
            self._scene.set_pose(copies[position], item.T_world_item)
            nodes.append(copies[position])
        self._hide_all_but(used)
        return nodes

    def _copies(self, mesh: Mesh) -> list[Any]:
        """The scene's nodes of a mesh, which is uploaded on first use."""
        if id(mesh) not in self._nodes:
            self._uploaded[id(mesh)] = mesh
            self._nodes[id(mesh)] = [self._scene.add(_shaded(mesh))]
        return self._nodes[id(mesh)]

    def _hide_all_but(self, used: dict[int, int]) -> None:
        """Drops surplus copies and the longest-known meshes over capacity; hides meshes out of use."""
        for key, copies in list(self._nodes.items()):
            wanted = max(used.get(key, 0), 1)
            if key not in used and len(self._nodes) > self._capacity:
                wanted = 0
                del self._nodes[key], self._uploaded[key]
            for node in copies[wanted:]:
                self._scene.remove_node(node)
            del copies[wanted:]
            if copies:
                # One hidden copy keeps the upload alive: pyrender frees meshes that left the scene.
                copies[0].mesh.is_visible = key in used

    def _aim(self, camera: Camera) -> None:
        K = camera.K
        # OpenGL counts pixel edges where the camera matrix counts pixel centres.
        self._camera.camera = pyrender.IntrinsicsCamera(
            K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, znear=camera.near, zfar=camera.far
        )
        self._scene.set_pose(self._camera, camera.T_world_camera @ _OPENGL_FROM_OPENCV)

    def _light(self, lighting: Lighting) -> None:
        for node in self._lights:
            self._scene.remove_node(node)
        self._lights = [_light_node(light) for light in lighting.lights]
        for node in self._lights:
            self._scene.add_node(node)
        self._scene.ambient_light = np.asarray(lighting.ambient)


class _Offscreen(pyrender.OffscreenRenderer):
    """pyrender's off-screen renderer, except that it leaves the process's EGL display alone.

    The original terminates the display when it is deleted, and with it every other renderer's context.
    """

    def delete(self) -> None:
        """Frees textures, buffers and shaders."""
        if self._platform is not None and self._renderer is not None:
            self._platform.make_current()
            self._renderer.delete()
            self._renderer = None


def _light_node(light: Light) -> Any:
    """The light as a node of pyrender's scene."""
    pose = np.eye(4)
    if light.kind == "point":
        pose[:3, 3] = light.vector
        return pyrender.Node(light=pyrender.PointLight(light.color, light.intensity), matrix=pose)
    # A directional light shines along its frame's -z.
    z = -np.asarray(light.vector) / np.linalg.norm(light.vector)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0), z)
    x /= np.linalg.norm(x)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return pyrender.Node(light=pyrender.DirectionalLight(light.color, light.intensity), matrix=pose)


def _shaded(mesh: Mesh) -> Any:
    """The mesh with smooth shading inside surfaces and sharp creases between them, ready to upload."""
    corners = mesh.faces.reshape(-1)
    positions, colors = mesh.vertices[corners], (mesh.colors[corners] / 255.0) ** _GAMMA
    rows = np.concatenate([positions, crease_normals(mesh), colors], axis=1).astype(np.float32)
    # Corners that agree in everything share a vertex again, which saves most of the work of drawing.
    first, indices = trimesh.grouping.unique_rows(rows, digits=6)
    vertices = rows[first].round(6)
    primitive = pyrender.Primitive(
        positions=vertices[:, :3],
        normals=vertices[:, 3:6],
        color_0=vertices[:, 6:],
        indices=indices.reshape(-1, 3),
        material=pyrender.MetallicRoughnessMaterial(
            baseColorFactor=(1.0, 1.0, 1.0, 1.0), metallicFactor=0.0, roughnessFactor=0.6, doubleSided=False
        ),
    )
    return pyrender.Mesh([primitive])


def crease_normals(mesh: Mesh) -> Floats:
    """A unit normal per face corner, 3F x 3: the mean over the faces at that point that bend less than 40 degrees."""
    triangles = mesh.vertices[mesh.faces]
    area_normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals = area_normals / np.maximum(np.linalg.norm(area_normals, axis=1, keepdims=True), 1e-12)
    # Vertices that a texture seam duplicated still belong to one surface, so corners meet by position.
    pairs = KDTree(triangles.reshape(-1, 3)).query_pairs(1e-6, output_type="ndarray")
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    faces = pairs // 3
    smooth = np.einsum("pi,pi->p", normals[faces[:, 0]], normals[faces[:, 1]]) > _CREASE
    total = np.repeat(area_normals, 3, axis=0)
    np.add.at(total, pairs[smooth, 0], area_normals[faces[smooth, 1]])
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
