"""Multi-start ICP: point-to-plane from 12 yaws of 6 resting faces in each box, best by rendered-depth agreement.

The starts put the middle of the side that the object shows at the median depth of the box, at the third quartile (what
hides an object lies in front of it) and where the object touches the plane (Besl and McKay 1992; Chen and Medioni 1992
for the distance to the plane). The gate of ICP falls from 10 cm to 1.5 cm while points of the model seek readings, then
to 6 mm while readings seek the model. Every start is refined to the end before one is chosen.
"""

from __future__ import annotations

import numpy as np

from benchmarks.comparison.baselines.common import Box, PerBox, untrained
from benchmarks.comparison.baselines.observed import Crop
from benchmarks.comparison.baselines.registration import (
    Grid,
    Model,
    directions,
    model_to_readings,
    readings_to_model,
    thinned,
)
from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3

_YAWS = 12
_DEPTHS = (50, 75)
"""Percentiles of the readings in the box."""
_COARSE = np.linspace(0.1, 0.015, 24)
_FINE = np.linspace(0.015, 0.006, 20)
"""Gates, metres."""
_SOUGHT = 3000
_SEEKING = 1000
"""Readings and model points of the coarse iterations."""
_READINGS = 1500
"""Readings of the fine iterations."""


def poses(box: Box, trained: None = None) -> Floats:
    """Poses of one candidate, best first, K x 4 x 4; empty where the box holds hardly any readings."""
    del trained
    return best(box, starts(box)) if len(box.observed.inside(box.candidate)) >= 10 else np.zeros((0, 4, 4))


def best(box: Box, begin: Floats) -> Floats:
    """Starts (P x 4 x 4) after coarse and fine ICP, best first by rendered-depth agreement."""
    return refined(box, coarse(box, begin))


def coarse(box: Box, begin: Floats) -> Floats:
    """Starts (P x 4 x 4) after coarse ICP, in the same order."""
    readings = box.observed.inside(box.candidate)
    # What lies a diameter in front of the middle or behind it belongs to no object in the box.
    near = np.abs(readings[:, 2] - np.median(readings[:, 2])) < box.model.diameter
    scene = Grid.of(thinned(readings[near], _SOUGHT), voxel=0.008, margin=0.05)
    basis = directions(box.dof, box.observed.T_camera_table)
    return model_to_readings(box.model, scene, begin, _COARSE, basis, count=_SEEKING)


def refined(box: Box, begin: Floats) -> Floats:
    """Poses that are nearly right (P x 4 x 4) after fine ICP, best first, without those that left the box."""
    readings = thinned(box.observed.inside(box.candidate), _READINGS)
    basis = directions(box.dof, box.observed.T_camera_table)
    fine = readings_to_model(box.model, readings, begin, _FINE, basis)
    crop = Crop.around(box.observed, box.candidate, 2)
    # What is not rendered contradicts nothing: it would be better than a pose that explains part of the box badly.
    return crop.ranked(box.model.soup, fine[crop.holds(fine[:, :3, :3] @ box.model.centre + fine[:, :3, 3])])


def starts(box: Box) -> Floats:
    """Every yaw of every face the object may rest on, at each depth, P x 4 x 4."""
    view, T_camera_table = box.observed.view, box.observed.T_camera_table
    middle = (box.candidate.box[:2] + box.candidate.box[2:]) / 2
    ray = np.array([(middle[0] - view.cx) / view.fx, (middle[1] - view.cy) / view.fy, 1.0])
    turns = rotations(T_camera_table, box.dof, _YAWS)
    shown = np.stack([R @ _shown(box.model, ray @ R) for R in turns])
    measured = np.percentile(box.observed.inside(box.candidate)[:, 2], _DEPTHS)
    depths = np.stack([*(np.full(len(turns), depth) for depth in measured), _resting(box, turns, shown, ray)])
    begin = np.tile(np.eye(4), (*depths.shape, 1, 1))
    begin[..., :3, :3] = turns
    begin[..., :3, 3] = depths[..., None] * ray - shown
    begin = begin.reshape(-1, 4, 4)
    return on_plane(begin, box.model, T_camera_table) if box.dof == 3 else begin


def _resting(box: Box, turns: Floats, shown: Floats, ray: Floats) -> Floats:
    """Depth of ``shown`` (P x 3, from the object's origin) along ``ray`` where an object so turned is on the plane."""
    normal, origin = box.observed.T_camera_table[:3, 2], box.observed.T_camera_table[:3, 3]
    lowest = np.array([(box.model.points @ (normal @ R)).min() for R in turns])
    return (normal @ origin + shown @ normal - lowest) / (normal @ ray)


def rotations(T_camera_table: Floats, dof: int, yaws: int) -> Floats:
    """Orientations of an object on one of its six faces (upright with fewer than 6 degrees of freedom), P x 3 x 3."""
    tips = np.deg2rad([[0, 0, 0], [180, 0, 0], [90, 0, 0], [-90, 0, 0], [0, 90, 0], [0, -90, 0]])
    faces = exp_so3(tips[: 1 if dof < 6 else 6])
    turns = exp_so3(np.outer(np.linspace(0, 2 * np.pi, yaws, endpoint=False), [0.0, 0.0, 1.0]).astype(np.float64))
    return np.concatenate([T_camera_table[:3, :3] @ turns @ face for face in faces])


def on_plane(begin: Floats, model: Model, T_camera_table: Floats) -> Floats:
    """Poses (P x 4 x 4) moved along the plane's normal until their lowest points touch it."""
    normal, origin = T_camera_table[:3, 2], T_camera_table[:3, 3]
    put = begin.copy()
    for T in put:
        lowest = (model.points @ (normal @ T[:3, :3])).min()
        T[:3, 3] -= normal * (lowest + normal @ (T[:3, 3] - origin))
    return put


def _shown(model: Model, ray: Floats) -> Floats:
    """Middle of the surface that faces a camera which looks along ``ray``; object frame."""
    facing = model.normals @ ray < 0
    return model.points[facing].mean(0) if facing.any() else model.centre


estimate = PerBox(poses, untrained)
