"""Colour images of rendered scenes, without a graphics library."""

from __future__ import annotations

import numpy as np

from stages.geometry.arrays import Floats
from stages.perception.rendering.paint import Paint
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.scene.catalogue import Mesh

LIGHT = np.array([0.3, -0.5, -0.8])


def painted(objects: list[tuple[Mesh, Floats]], view: View, *, ambient: float = 0.5, noise: float = 3.0) -> np.ndarray:
    """H x W x 3 sRGB of meshes at T_camera_object on grey ground, lit from one side, with Gaussian noise."""
    rng = np.random.default_rng(3)
    image = np.full((view.height, view.width, 3), 120.0)
    nearest = np.zeros((view.height, view.width), np.float32)
    for mesh, T in objects:
        layer = inverse_depth(Soup.of(mesh), T, view)
        shown = layer > nearest
        colors, _ = Paint.of(mesh).drawn(T, view)
        # Gradients of inverse depth point away from the camera.
        shade = ambient + (1 - ambient) * np.clip(_normals(layer, view)[shown] @ -LIGHT, 0, 1)
        image[shown] = colors[shown] * shade[:, None]
        nearest = np.maximum(nearest, layer)
    return (image + rng.normal(0, noise, image.shape)).clip(0, 255).astype(np.uint8)


def _normals(layer: np.ndarray, view: View) -> np.ndarray:
    """Unit normals of a rendered surface, H x W x 3; inverse depth is linear on a plane."""
    down, right = np.gradient(layer.astype(np.float64))
    rays = view.rays()
    x, y = right * view.fx, down * view.fy
    normals = np.stack([x, y, layer - rays[..., 0] * x - rays[..., 1] * y], -1)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
