"""The exact rasteriser that the fast kernel is measured against: every triangle at every pixel, in torch float64."""

from __future__ import annotations

import numpy as np
import torch

from stages.geometry.arrays import Floats
from stages.perception.rendering.rasteriser import View
from stages.scene.catalogue import Mesh

# Images this small only lose time to threads, the more the busier the machine.
torch.set_num_threads(1)


def inverse_depth(mesh: Mesh, T_camera_object: Floats, view: View) -> Floats:
    """H x W image of 1/z, 0 where nothing is: edge functions, inclusive edges, back faces culled."""
    T = torch.as_tensor(np.asarray(T_camera_object, np.float64))
    corners = torch.as_tensor(mesh.vertices)[torch.as_tensor(mesh.faces.astype(np.int64))]
    x, y, z = (corners @ T[:3, :3].T + T[:3, 3]).unbind(-1)
    u, v, q = x / z * view.fx + view.cx, y / z * view.fy + view.cy, 1 / z
    pixels_v, pixels_u = torch.meshgrid(
        torch.arange(view.height, dtype=torch.float64), torch.arange(view.width, dtype=torch.float64), indexing="ij"
    )
    area = _cross(u[:, 1] - u[:, 0], v[:, 1] - v[:, 0], u[:, 2] - u[:, 0], v[:, 2] - v[:, 0])
    image = torch.zeros(view.height, view.width, dtype=torch.float64)
    for k in torch.nonzero(area < 0)[:, 0].tolist():
        weights = torch.stack([_edge(u[k], v[k], i, pixels_u, pixels_v) for i in range(3)]) / area[k]
        covered = (weights >= 0).all(0)
        image = torch.where(covered, torch.maximum(image, (weights * q[k, :, None, None]).sum(0)), image)
    return image.numpy()


def _edge(u: torch.Tensor, v: torch.Tensor, i: int, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Twice the signed area between the edge opposite corner ``i`` and each pixel."""
    a, b = (i + 1) % 3, (i + 2) % 3
    return _cross(u[b] - u[a], v[b] - v[a], x - u[a], y - v[a])


def _cross(ax: torch.Tensor, ay: torch.Tensor, bx: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    return ax * by - ay * bx
