"""Draws objects in the colours of their surface, without light: what a photograph is compared with."""

# ruff: noqa: PLR0917
# pyright: reportMissingParameterType=false
# Kernels take plain arrays by position.

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.perception.rendering.pixel_math import KERNEL, screen_matrix, triangle_setup
from stages.perception.rendering.rasteriser import Float32s, View, kernel_pose
from stages.scene.catalogue import Mesh

_f = np.float32


@dataclass(frozen=True)
class Paint:
    """A mesh's triangles and their colours."""

    corners: Float32s
    """F x 9, metres."""
    colors: Float32s
    """F x 9, sRGB of the three corners, 0 to 255."""

    @staticmethod
    def of(mesh: Mesh) -> Paint:
        """Lays out a mesh for the kernel."""
        return Paint(*(each[mesh.faces].reshape(-1, 9).astype(np.float32) for each in (mesh.vertices, mesh.colors)))

    def drawn(self, T_camera_object: Floats, view: View) -> tuple[Float32s, NDArray[np.bool_]]:
        """The colours in sight at a pose, H x W x 3 (0 to 255, black where there is nothing), and where it is.

        The object must lie in front of the camera.
        """
        image = np.zeros((view.height, view.width, 3), np.float32)
        inverse = np.zeros((view.height, view.width), np.float32)
        _draw(self.corners, self.colors, kernel_pose(T_camera_object), view.numbers, inverse, image)
        return image, inverse > 0


@numba.njit(**KERNEL)
def _draw(corners, colors, pose, view, inverse, image):
    """The nearest triangle at each pixel, its colours interpolated between its corners along the screen."""
    m = screen_matrix(pose, view)
    right, bottom = view[4] - _f(1), view[5] - _f(1)
    for k in range(len(corners)):
        t, c = corners[k], colors[k]
        width, height, x0, y0, wb, wd, q, bx, by, dx, dy, qx, qy = triangle_setup(
            t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7], t[8], m, _f(0), right, _f(0), bottom
        )
        if width <= 0:
            continue
        for j in range(int(height)):
            for i in range(int(width)):
                b, d = wb + i * bx + j * by, wd + i * dx + j * dy
                if b >= 0 and d >= 0 and b + d <= 1:
                    x, y, z = int(x0) + i, int(y0) + j, q + i * qx + j * qy
                    if z > inverse[y, x]:
                        inverse[y, x] = z
                        for channel in range(3):
                            first, second, third = c[channel], c[3 + channel], c[6 + channel]
                            image[y, x, channel] = first + b * (second - first) + d * (third - first)
