"""Other ways to weigh particles, each as it is commonly done, for `python -m benchmarks.kernel` to time beside ours."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from stages.geometry.arrays import Floats
from stages.perception.filter.likelihood import CostForm, Window
from stages.perception.rendering.rasteriser import Float32s, View
from stages.scene.catalogue import Mesh

Costs = Callable[[Floats], Floats]
"""Poses P x 3 x 4 of the object -> its change of cost, P."""


@dataclass(frozen=True)
class Task:
    """A mesh and the window that its particles are weighed in."""

    mesh: Mesh
    window: Window
    form: CostForm

    def change(self, inverse: Floats | Float32s) -> float:
        """The change of cost of one rendered image of inverse depth, H x W."""
        form, window = self.form, self.window
        seen = (inverse > window.inverse_background) & (window.factor > 0)
        behind = window.factor[seen] * (1 / inverse[seen] - window.observed[seen])
        credit = window.credit[seen]
        costs = np.maximum(np.minimum(np.abs(behind), form.truncation) - np.abs(credit), np.minimum(-credit, 0))
        return float(np.where(behind > form.occluder_margin, form.occluder_cost, costs).sum())


def torch_edges(task: Task, *, batch: int = 64) -> Costs:
    """Edge functions in torch: every pixel of every triangle's rectangle at once, 64 particles at a time."""

    def costs(poses: Floats) -> Floats:
        images = [
            edge_functions(task.mesh, poses[i : i + batch], task.window.view) for i in range(0, len(poses), batch)
        ]
        return np.array([task.change(image) for part in images for image in part.numpy()])

    return costs


@torch.inference_mode()
def edge_functions(mesh: Mesh, poses: Floats, view: View) -> torch.Tensor:
    """Images of inverse depth, P x H x W, of a mesh at poses P x 3 x 4; edges inclusive, back faces culled."""
    T = torch.as_tensor(np.asarray(poses, np.float32))
    x, y, z = (torch.as_tensor(mesh.vertices).float() @ T[:, :, :3].mT + T[:, None, :, 3]).unbind(-1)
    points = torch.stack([x / z * view.fx + view.cx, y / z * view.fy + view.cy, 1 / z], -1)
    a, b, c = points[:, torch.as_tensor(mesh.faces.astype(np.int64))].unbind(2)
    low, high = torch.minimum(torch.minimum(a, b), c), torch.maximum(torch.maximum(a, b), c)
    x0, y0 = low[..., 0].ceil().clamp(min=0), low[..., 1].ceil().clamp(min=0)
    width = (high[..., 0].floor().clamp(max=view.width - 1) - x0 + 1).clamp(min=0)
    height = (high[..., 1].floor().clamp(max=view.height - 1) - y0 + 1).clamp(min=0)
    area = _cross(b - a, c - a)
    particle, triangle = ((area < 0) & (width * height > 0)).nonzero(as_tuple=True)
    at = (particle, triangle)
    width = width[at].long()
    pixels = width * height[at].long()
    one = torch.repeat_interleave(torch.arange(len(pixels)), pixels)
    offset = torch.arange(len(one)) - (pixels.cumsum(0) - pixels)[one]
    u, v = x0[at].long()[one] + offset % width[one], y0[at].long()[one] + offset // width[one]
    where = torch.stack([u.float(), v.float(), torch.zeros(len(one))], -1) - a[at][one]
    ab, ac = (b - a)[at][one], (c - a)[at][one]
    second, third = _cross(where, ac) / area[at][one], _cross(ab, where) / area[at][one]
    inside = (second >= 0) & (third >= 0) & (second + third <= 1)
    inverse = a[at][one][:, 2] + second * ab[:, 2] + third * ac[:, 2]
    images = torch.zeros(len(poses) * view.height * view.width)
    index = (particle[one] * view.height + v) * view.width + u
    images.scatter_reduce_(0, index[inside], inverse[inside], "amax")
    return images.view(len(poses), view.height, view.width)


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def pyrender_loop(task: Task) -> Costs:
    """OpenGL draws one particle after the other, NumPy weighs its depth image."""
    os.environ.setdefault("LP_NUM_THREADS", "0")
    from stages.perception.rendering.renderer import pyrender

    view = task.window.view
    scene: Any = pyrender.Scene()
    node = scene.add(pyrender.Mesh([pyrender.Primitive(task.mesh.vertices, indices=task.mesh.faces)]))
    camera = pyrender.IntrinsicsCamera(view.fx, view.fy, view.cx + 0.5, view.cy + 0.5, znear=0.05, zfar=10.0)
    scene.add(camera, pose=np.diag([1.0, -1.0, -1.0, 1.0]))
    renderer: Any = pyrender.OffscreenRenderer(view.width, view.height)

    def change(pose: Floats) -> float:
        scene.set_pose(node, np.vstack([pose, [0, 0, 0, 1]]))
        depth = renderer.render(scene, pyrender.RenderFlags.DEPTH_ONLY)
        return task.change(np.where(depth > 0, 1 / np.maximum(depth, 1e-3), 0))

    return lambda poses: np.array([change(pose) for pose in poses])


def ray_casting(task: Task) -> Costs:
    """Open3D casts rays, moved into the object's frame, through the pixels of each particle's rectangle.

    Raises:
        ModuleNotFoundError: Open3D is not installed.
    """
    import open3d  # pyright: ignore[reportMissingImports]

    scene: Any = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(task.mesh.vertices.astype(np.float32), task.mesh.faces.astype(np.uint32))
    view, rays = task.window.view, task.window.view.rays()

    def change(pose: Floats) -> float:
        pixels = view.project(task.mesh.vertices @ pose[:, :3].T + pose[:, 3])
        low = np.maximum(np.ceil(pixels.min(0)), 0).astype(int)
        high = np.minimum(np.floor(pixels.max(0)), [view.width - 1, view.height - 1]).astype(int) + 1
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        directions = rays[part] @ pose[:, :3]
        origin = np.broadcast_to(-pose[:, 3] @ pose[:, :3], directions.shape)
        depth = scene.cast_rays(np.concatenate([origin, directions], -1).astype(np.float32), nthreads=1)[
            "t_hit"
        ].numpy()
        inverse = np.zeros((view.height, view.width))
        inverse[part] = 1 / depth
        return task.change(inverse)

    return lambda poses: np.array([change(pose) for pose in poses])
