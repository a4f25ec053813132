"""Point pair features (Drost et al. 2010) as OpenCV contrib implements them, then ICP.

The detector's usual parameters: model sampled and distances quantised at 0.05 of the diameter, 30 angles, every fifth
point of the scene a reference; readings are sampled at the model's step. Of the clusters with most votes the best 50
are refined by ICP and ranked by rendered-depth agreement.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from scipy.spatial import KDTree

from benchmarks.comparison.baselines.common import Box, PerBox
from benchmarks.comparison.baselines.features import normals, polished, voxel_thinned
from benchmarks.comparison.baselines.registration import Model
from stages.geometry.arrays import Floats

_STEP = 0.05
_ANGLES = 30
_REFERENCES = 1 / 5
_LEADERS = 50
_MILLIMETRES = 1000.0


def trained(model: Model) -> Any:
    """A detector that knows the model."""
    detector = cv2.ppf_match_3d.PPF3DDetector(_STEP, _STEP, _ANGLES)
    # OpenCV samples each axis of the enclosing box by its own extent; Drost asks for one distance in all of them.
    points = voxel_thinned(model.points, _STEP * model.diameter)
    _, index = KDTree(model.points).query(points)
    points = np.column_stack([_MILLIMETRES * points, model.normals[index]])
    detector.trainModel(points.astype(np.float32))
    return detector


def poses(box: Box, trained: Any) -> Floats:
    """Poses of one candidate, best first, K x 4 x 4; empty where readings are few or nothing matches."""
    readings = voxel_thinned(box.observed.inside(box.candidate), _STEP * box.model.diameter / 2)
    if len(readings) < 30:
        return np.zeros((0, 4, 4))
    points = np.column_stack([_MILLIMETRES * readings, normals(readings)]).astype(np.float32)
    clusters = trained.match(points, _REFERENCES, _STEP)
    found = np.array([cluster.pose for cluster in clusters], np.float64).reshape(-1, 4, 4)
    found[:, :3, 3] /= _MILLIMETRES
    votes = np.array([cluster.numVotes for cluster in clusters])
    return polished(box, found[np.lexsort((*found[:, :3, 3].T, -votes))][:_LEADERS])


estimate = PerBox(poses, trained)
