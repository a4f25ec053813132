"""Tells apart, by colour, poses that look alike in depth (docs/perception/colour.md).

Such poses show the same surface at every pixel, painted differently. Both paints are compared with the image in CIELAB
after the light has been fitted: it scales lightness and chroma, and it changes lightness with the surface's normal,
which the poses share. What remains is a robust distance per pixel. Another pose than depth's favourite wins only where
its mean distance is smaller by several standard errors, taken over patches of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from stages.geometry.arrays import Floats, distinct_rows
from stages.perception.rendering.rasteriser import Float32s, View
from stages.scene.catalogue import Mesh

_SPACING = 0.002
"""Metres between samples of a painted surface."""
_PIXELS = 900
"""Pixels compared at most, and how many choose among a pose's exact symmetries."""
_SCOUTS = 150
_TILE = 4
"""Side of a patch in compared pixels: neighbours err together."""
_LEAST_TILES = 6
_SURE = 2.0
"""Standard errors by which a pose's colours must fit better than the favourite's."""
_LEAST = 0.3
"""Mean distance, CIELAB units, below which no difference counts."""
_SHARE = 0.1
"""Share of the better distance by which it must be smaller: what no paint explains also errs in favour of one."""
_XYZ_FROM_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_WHITE = _XYZ_FROM_RGB.sum(1)
"""D65."""
_Prior = tuple[tuple[float, float], ...]
_LIGHTNESS: _Prior = ((1.0, 0.5), (0.0, 30.0), (0.0, 12.0), (0.0, 12.0), (0.0, 12.0))
"""Mean and deviation between images: the gain of L*, its offset, its slopes with the three parts of the normal."""
_CHROMA: _Prior = ((1.0, 0.5), (0.0, 10.0), (0.0, 10.0))
"""The gain of a* and b*, and their offsets."""
_NOISE = 8.0
_EVIDENCE = 10.0
"""The priors weigh as much as so many pixels of that noise."""
_LIGHTNESS_WEIGHT = 0.6
"""Of squared differences in L*, which shadows change most."""
_HUBER = 10.0
"""Distance from which a pixel (a highlight, a shadow) counts in proportion rather than squared."""
_FITS = 4


@dataclass(frozen=True)
class Paint:
    """The colours of a mesh's surface."""

    tree: KDTree
    lab: Floats
    """N x 3, CIELAB of the samples that the tree holds."""

    @staticmethod
    def of(mesh: Mesh) -> Paint:
        """Samples every triangle about every 2 mm; colours are interpolated between its corners."""
        points, colors = _samples(mesh)
        first, _ = distinct_rows(np.round(points / (0.5 * _SPACING)).astype(np.int64))
        return Paint(KDTree(points[first]), cielab(colors[first]))

    def at(self, points: Floats) -> Floats:
        """CIELAB of the surface nearest to each point of the object frame, ... x 3 metres -> ... x 3."""
        _, nearest = self.tree.query(points)
        return self.lab[nearest]


@dataclass(frozen=True)
class Contender:
    """A pose that depth allows."""

    T_camera_object: Floats
    """3 x 4."""
    layer: Float32s
    """H x W inverse depth of the object alone at that pose."""


@dataclass(frozen=True)
class Verdict:
    """What colour says of some contenders."""

    winner: int
    distances: Floats
    """Mean distance of each contender's colours from the image, CIELAB units."""


def judge(
    rgb: NDArray[np.uint8],
    view: View,
    visible: NDArray[np.bool_],
    contenders: Sequence[Contender],
    *,
    paint: Paint,
    symmetries: Floats,
) -> Verdict | None:
    """Which contender's colours the image shows; None where too little of the object is seen.

    ``rgb`` is H x W x 3 (sRGB), ``visible`` H x W: where all contenders can be seen. Each is compared at the best of
    its exact ``symmetries`` (S x 4 x 4), of which depth knows nothing. The first, depth's favourite, stays where colour
    is not sure.
    """
    rows, columns, stride = _compared(visible)
    if len(np.unique(_tiles(rows, columns, stride))) < _LEAST_TILES:
        return None
    image = smoothed_lab(rgb, stride)[rows, columns]
    normals = surface_normals(contenders[0].layer, view)[rows, columns]
    rays = view.rays()[rows, columns]
    painted = np.stack([
        _best_painted(paint, symmetries, _object_points(each, rays, rows, columns), image, normals)
        for each in contenders
    ])  # fmt: skip
    fits = distances(image, painted, normals)
    means = fits.mean(-1)
    best = int(np.argmin(means))
    sure = _is_sure(fits[0] - fits[best], _tiles(rows, columns, stride)) and means[0] > (1 + _SHARE) * means[best]
    return Verdict(best if sure else 0, means)


def cielab(rgb: NDArray[Any]) -> Floats:
    """CIELAB (CIE 15:2004, D65) of sRGB (IEC 61966-2-1, 0 to 255), ... x 3."""
    encoded = np.asarray(rgb, np.float64) / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    t = (linear[..., None, :] * _XYZ_FROM_RGB).sum(-1) / _WHITE
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1)


def smoothed_lab(rgb: NDArray[np.uint8], pixels: int) -> Floats:
    """CIELAB of an image averaged over squares of ``pixels`` pixels, at least two, H x W x 3."""
    side = max(2, pixels)
    return cielab(cv2.blur(rgb.astype(np.float32), (side, side)))


def surface_normals(layer: Float32s, view: View) -> Floats:
    """Unit normals of a rendered surface, camera frame, H x W x 3; inverse depth is linear on a plane."""
    down, right = np.gradient(layer.astype(np.float64))
    rays = view.rays()
    x, y = right * view.fx, down * view.fy
    normals = np.stack([x, y, layer - rays[..., 0] * x - rays[..., 1] * y], -1)
    return normals / np.maximum(np.sqrt((normals**2).sum(-1, keepdims=True)), 1e-12)


def distances(observed: Floats, painted: Floats, normals: Floats) -> Floats:
    """Robust distance of each pixel's colour from each paint under the light that suits that paint best, C x P.

    ``observed`` is P x 3 CIELAB, ``painted`` C x P x 3, ``normals`` P x 3 unit vectors. The light is found by
    iteratively reweighted least squares with the pseudo-Huber loss.
    """
    one = np.ones((*painted.shape[:2], 1))
    zero = np.zeros_like(one)
    shades = np.broadcast_to(normals, painted.shape)
    L = np.concatenate([painted[..., :1], one, shades], -1)
    a = np.concatenate([painted[..., 1:2], one, zero], -1)
    b = np.concatenate([painted[..., 2:], zero, one], -1)
    squared = np.zeros(painted.shape[:2])
    for _ in range(_FITS):
        weights = 1 / np.sqrt(1 + squared / _HUBER**2)
        (miss_L,) = _misses([(L, observed[:, 0])], weights, _LIGHTNESS)
        miss_a, miss_b = _misses([(a, observed[:, 1]), (b, observed[:, 2])], weights, _CHROMA)
        squared = _LIGHTNESS_WEIGHT * miss_L**2 + miss_a**2 + miss_b**2
    return _HUBER * (np.sqrt(1 + squared / _HUBER**2) - 1)


def _misses(channels: Sequence[tuple[Floats, Floats]], weights: Floats, prior: _Prior) -> list[Floats]:
    """What a linear model leaves of each channel, C x P; all channels are fitted at once, by ridge regression."""
    mean, deviation = np.array(prior).T
    ridge = (_NOISE / deviation) ** 2 / _EVIDENCE
    share = weights / weights.sum(-1, keepdims=True)
    A = np.tile(np.diag(ridge), (len(weights), 1, 1))
    rhs = np.tile(ridge * mean, (len(weights), 1))
    for X, y in channels:
        for j in range(len(mean)):
            column = share * X[..., j]
            rhs[:, j] += (column * y).sum(-1)
            for k in range(len(mean)):
                A[:, j, k] += (column * X[..., k]).sum(-1)
    beta = np.linalg.solve(A, rhs[..., None])[..., 0]
    return [y - (X * beta[:, None, :]).sum(-1) for X, y in channels]


def _compared(visible: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp], int]:
    """Rows and columns of the compared pixels, away from the outline, and the step between them."""
    inner = cv2.erode(visible.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    stride = max(1, int(np.sqrt(inner.sum() / _PIXELS)))
    rows, columns = np.nonzero(inner[::stride, ::stride])
    return rows * stride, columns * stride, stride


def _tiles(rows: NDArray[np.intp], columns: NDArray[np.intp], stride: int) -> NDArray[np.intp]:
    """The patch that each compared pixel belongs to."""
    side = _TILE * stride
    return (rows // side) * 100000 + columns // side


def _object_points(each: Contender, rays: Floats, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Floats:
    """Where the contender's surface is at the compared pixels, object frame, P x 3."""
    R, t = each.T_camera_object[:, :3], each.T_camera_object[:, 3]
    points = rays / each.layer[rows, columns].astype(np.float64)[:, None] - t
    return (points[:, :, None] * R).sum(1)


def _best_painted(paint: Paint, symmetries: Floats, points: Floats, image: Floats, normals: Floats) -> Floats:
    """The colours of an object's points, turned by the symmetry that suits a sample of the image best, P x 3."""
    scouts = np.s_[:: max(1, len(points) // _SCOUTS)]
    turned = _turned_back(symmetries, points[scouts])
    fits = distances(image[scouts], paint.at(turned), normals[scouts]).mean(-1)
    best = symmetries[[int(np.argmin(fits))]]
    return paint.at(_turned_back(best, points))[0]


def _turned_back(symmetries: Floats, points: Floats) -> Floats:
    """The points of the object frame that the symmetries bring to ``points``, S x P x 3."""
    moved = points - symmetries[:, None, :3, 3]
    return (moved[..., None] * symmetries[:, None, :3, :3]).sum(-2)


def _is_sure(gains: Floats, tiles: NDArray[np.intp]) -> bool:
    """Whether the mean of ``gains`` (P) exceeds its standard error over the patches several times."""
    _, patch, counts = np.unique(tiles, return_inverse=True, return_counts=True)
    mean = gains.mean()
    deviations = np.bincount(patch, gains) - counts * mean
    error = np.sqrt((deviations**2).sum() * len(counts) / (len(counts) - 1)) / len(gains)
    return bool(mean > max(_SURE * error, _LEAST))


def _samples(mesh: Mesh) -> tuple[Floats, Floats]:
    """Points on all triangles and their interpolated colours, N x 3 each."""
    corners = mesh.vertices[mesh.faces]
    colors = mesh.colors[mesh.faces].astype(np.float64)
    longest = np.sqrt(((corners - np.roll(corners, 1, 1)) ** 2).sum(-1)).max(1)
    parts = np.clip(np.ceil(longest / _SPACING), 1, 24).astype(int)
    points: list[Floats] = []
    paints: list[Floats] = []
    for n in np.unique(parts):
        weights, chosen = _barycentric(int(n)), parts == n
        points.append(_interpolated(weights, corners[chosen]))
        paints.append(_interpolated(weights, colors[chosen]))
    return np.concatenate(points), np.concatenate(paints)


def _interpolated(weights: Floats, corners: Floats) -> Floats:
    """Means of three corners' values (F x 3 x 3) with each of the weights (N x 3), F N x 3."""
    first, second, third = (weights[:, k, None] * corners[:, None, k] for k in range(3))
    return (first + second + third).reshape(-1, 3)


def _barycentric(n: int) -> Floats:
    """Weights of the centres of the small triangles that point upwards in one divided n times, N x 3."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    inside = i + j < n
    u, v = (i[inside] + 1 / 3) / n, (j[inside] + 1 / 3) / n
    return np.stack([u, v, 1 - u - v], -1)
