"""Normals of readings, and what methods that find poses by matching features have in common."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from benchmarks.comparison.baselines.common import Box
from benchmarks.comparison.baselines.icp import coarse, on_plane, refined
from stages.geometry.arrays import Floats

_NEIGHBOURS = 20


def normals(points: Floats) -> Floats:
    """Unit normals of readings towards the camera from their 20 nearest, N x 3; least direction of their spread."""
    _, near = KDTree(points).query(points, min(_NEIGHBOURS, len(points)))
    offsets = points[near] - points[near].mean(1, keepdims=True)
    spread = (offsets[:, :, :, None] * offsets[:, :, None, :]).sum(1)
    found = np.linalg.eigh(spread)[1][:, :, 0]
    return np.where(((found * points).sum(1) > 0)[:, None], -found, found)


def voxel_thinned(points: Floats, voxel: float) -> Floats:
    """One point of each voxel of ``voxel`` metres, the first, N x 3."""
    _, first = np.unique(np.floor(points / voxel).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def polished(box: Box, found: Floats) -> Floats:
    """Poses found by features (P x 4 x 4) after the ICP of the multi-start baseline, best agreement first.

    Fine ICP is enough for them as found. With fewer than six degrees of freedom each keeps its yaw and is set upright
    before, with three on the plane; as that moves it, it is refined after coarse ICP too.
    """
    if not len(found):
        return found
    if box.dof < 6:
        put = _upright(box, found)
        found = np.concatenate([put, coarse(box, put)])
    return refined(box, found)


def _upright(box: Box, found: Floats) -> Floats:
    T_camera_table = box.observed.T_camera_table
    put = found.copy()
    for T in put:
        R_table_object = T_camera_table[:3, :3].T @ T[:3, :3]
        yaw = np.arctan2(R_table_object[1, 0] - R_table_object[0, 1], R_table_object[0, 0] + R_table_object[1, 1])
        c, s = np.cos(yaw), np.sin(yaw)
        centre = T[:3, :3] @ box.model.centre + T[:3, 3]
        T[:3, :3] = T_camera_table[:3, :3] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        T[:3, 3] = centre - T[:3, :3] @ box.model.centre
    return on_plane(put, box.model, T_camera_table) if box.dof == 3 else put
