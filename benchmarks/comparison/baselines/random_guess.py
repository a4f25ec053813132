"""Random guess: any orientation (any yaw with 3 degrees of freedom), the centre at a random reading in the box."""

from __future__ import annotations

import numpy as np

from benchmarks.comparison.baselines.common import Box, PerBox, untrained
from benchmarks.comparison.baselines.icp import on_plane
from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, random_rotations


def poses(box: Box, trained: None = None) -> Floats:
    """One pose, 1 x 4 x 4; none where the box holds no reading."""
    del trained
    readings = box.observed.inside(box.candidate)
    if not len(readings):
        return np.zeros((0, 4, 4))
    T = np.eye(4)
    yaw = exp_so3(box.rng.uniform(-np.pi, np.pi) * np.array([0.0, 0.0, 1.0]))
    T[:3, :3] = box.observed.T_camera_table[:3, :3] @ yaw if box.dof < 6 else random_rotations(1, box.rng)[0]
    T[:3, 3] = readings[box.rng.integers(len(readings))] - T[:3, :3] @ box.model.centre
    return on_plane(T[None], box.model, box.observed.T_camera_table) if box.dof == 3 else T[None]


estimate = PerBox(poses, untrained)
