"""FPFH + RANSAC + ICP: matches fast point feature histograms (Rusu et al. 2009), samples triples, refines the best.

Parameters are those usual with Open3D, scaled to the object: voxels of a thirtieth of its diameter (3 to 8 mm),
histograms over five voxels, normals from 20 neighbours, edges of a triple alike within 0.9, inliers within 1.5
voxels, 200,000 triples. Open3D computes the histograms; the sampling is done here, for Open3D's is not the same twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from benchmarks.comparison.baselines.common import Box, PerBox
from benchmarks.comparison.baselines.features import normals, polished, voxel_thinned
from benchmarks.comparison.baselines.registration import Model
from runner.contract import Refused
from stages.geometry.arrays import Floats

_TRIPLES = 200_000
_ALIKE = 0.9
_INLIER = 1.5
"""Voxels."""
_LEADERS = 50
_JUDGED = 20_000
"""Triples with congruent edges whose inliers are counted."""
_MOST_READINGS = 4000


@dataclass(frozen=True)
class Described:
    """Points with a histogram each."""

    points: Floats
    histograms: Floats
    """N x 33."""
    voxel: float
    """Distance between points, metres."""

    @staticmethod
    def of_points(points: Floats, normals: Floats, voxel: float) -> Described:
        """Points (N x 3) with unit normals.

        Raises:
            Refused: Open3D is not installed.
        """
        return Described(points, _histograms(points, normals, voxel), voxel)


def described(model: Model) -> Described:
    """The histograms of a model."""
    voxel = float(np.clip(model.diameter / 30, 0.003, 0.008))
    points = voxel_thinned(model.points, voxel)
    _, index = KDTree(model.points).query(points)
    return Described.of_points(points, model.normals[index], voxel)


def poses(box: Box, trained: Described) -> Floats:
    """Poses of one candidate, best first, K x 4 x 4; empty where readings are few or nothing matches."""
    readings = voxel_thinned(box.observed.inside(box.candidate), trained.voxel)[:_MOST_READINGS]
    if len(readings) < 10:
        return np.zeros((0, 4, 4))
    seen = _histograms(readings, normals(readings), trained.voxel)
    _, match = KDTree(trained.histograms).query(seen)
    return polished(box, _ransac(trained.points[match], readings, trained.voxel, box.rng))


def _histograms(points: Floats, directions: Floats, voxel: float) -> Floats:
    o3d = _open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(directions)
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
    return np.asarray(o3d.pipelines.registration.compute_fpfh_feature(cloud, search).data).T.copy()


def _ransac(model: Floats, readings: Floats, voxel: float, rng: np.random.Generator) -> Floats:
    """Poses of the triples of matches (N x 3 each) with most inliers, P x 4 x 4, no two with the same inliers."""
    triples = rng.integers(len(readings), size=(_TRIPLES, 3))
    edges = [np.linalg.norm(side[triples] - side[np.roll(triples, 1, 1)], axis=2) for side in (model, readings)]
    shorter, longer = np.minimum(*edges), np.maximum(*edges)
    congruent = ((shorter > _ALIKE * longer) & (longer > 2 * voxel)).all(1)
    fits = _rigid(model[triples[congruent][:_JUDGED]], readings[triples[congruent][:_JUDGED]])
    inliers = np.array([_inliers(T, model, readings, _INLIER * voxel) for T in fits])
    if not len(inliers):
        return np.zeros((0, 4, 4))
    _, first = np.unique(inliers, axis=0, return_index=True)
    first = first[np.lexsort((first, -inliers[first].sum(1)))]
    return fits[first[:_LEADERS]]


def _inliers(T: Floats, model: Floats, readings: Floats, distance: float) -> Any:
    return ((model @ T[:3, :3].T + T[:3, 3] - readings) ** 2).sum(1) < distance**2


def _rigid(model: Floats, readings: Floats) -> Floats:
    """Least-squares poses that carry triples onto triples (Kabsch), B x 3 x 3 each -> B x 4 x 4."""
    a, b = model.mean(1, keepdims=True), readings.mean(1, keepdims=True)
    U, _, Vt = np.linalg.svd(np.einsum("bki,bkj->bij", readings - b, model - a))
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    T = np.tile(np.eye(4), (len(model), 1, 1))
    T[:, :3, :3] = U @ Vt
    T[:, :3, 3] = (b - a @ T[:, :3, :3].transpose(0, 2, 1))[:, 0]
    return T


def _open3d() -> Any:
    try:
        import open3d  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise Refused("fpfh needs Open3D: pip install '.[benchmarks]' -c constraints.txt") from error
    return open3d


estimate = PerBox(poses, described)
