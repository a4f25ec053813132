"""What a structured-light camera makes of a perfect depth image: noise, steps, shadows, ragged edges and holes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.geometry.camera import back_project
from stages.messages.arrays import Depth, Intrinsics, Mask, Rgb


@dataclass(frozen=True)
class StructuredLight:
    """A sensor that matches a projected pattern; the defaults are those of a PrimeSense camera.

    Axial noise after Khoshelham and Elberink (2012): disparity noise of constant size makes depth noise that
    grows with z^2. Lateral noise after Nguyen, Izadi and Lovell (2012): about half a pixel.
    """

    baseline: float = 0.075
    """Metres between camera and projector."""
    disparity_sigma: float = 0.04
    """Pixels."""
    disparity_step: float = 0.125
    """Pixels; disparities are multiples of it."""
    lateral_sigma: float = 0.5
    """Pixels by which a reading is taken beside its pixel's centre."""
    edge_step: float = 0.02
    """Relative depth difference between neighbours that makes an edge."""
    edge_dropout: float = 0.35
    """Share of pixels at edges without a reading."""
    flying: float = 0.15
    """Share of pixels at edges that read a depth between the two surfaces."""
    grazing: float = 80.0
    """Degrees between ray and normal beyond which half of the readings are missing."""
    holes: float = 0.002
    """Share of pixels inside random holes."""
    near: float = 0.35
    far: float = 4.0
    """Metres between which there are readings."""


def structured_light(
    depth: Depth, K: Intrinsics, rng: np.random.Generator, sensor: StructuredLight | None = None
) -> Depth:
    """The depth image (H x W, metres, 0 = no reading) that ``sensor`` would deliver of the perfect ``depth``."""
    sensor = sensor or StructuredLight()
    edges = _edges(depth, sensor.edge_step)
    lost = _shadows(depth, float(K[0, 0]) * sensor.baseline) | _grazing(depth, K, rng, sensor.grazing)
    lost |= _holes(depth.shape, rng, sensor.holes) | (edges & (rng.random(depth.shape) < sensor.edge_dropout))
    ragged = _jitter(depth, rng, sensor.lateral_sigma)
    ragged = _fly(ragged, edges & (rng.random(depth.shape) < sensor.flying), rng)
    measured = _match(ragged, float(K[0, 0]) * sensor.baseline, rng, sensor)
    lost |= (depth <= 0) | (measured < sensor.near) | (measured > sensor.far)
    return np.where(lost, 0.0, measured).astype(np.float32)


def color_noise(rgb: Rgb, rng: np.random.Generator, sigma: float = 2.0) -> Rgb:
    """The image with independent Gaussian noise of ``sigma`` grey levels."""
    noisy = rgb + rng.normal(0.0, sigma, rgb.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def _match(depth: Floats, focal_baseline: float, rng: np.random.Generator, sensor: StructuredLight) -> Floats:
    """Depth from noisy disparities in steps; noise is shared by neighbours, whose matching windows overlap."""
    disparity = focal_baseline / np.maximum(depth, 1e-6)
    white = rng.normal(0.0, 1.0, depth.shape)
    smooth = cv2.GaussianBlur(white, (5, 5), 0.8)
    noisy = disparity + sensor.disparity_sigma * smooth / smooth.std()
    steps = np.maximum(np.round(noisy / sensor.disparity_step), 1.0)
    return focal_baseline / (steps * sensor.disparity_step)


def _jitter(depth: Depth, rng: np.random.Generator, sigma: float) -> Floats:
    """Takes each reading beside its pixel, from that surface, so that edges fray and planes stay planes."""
    rows, columns = np.indices(depth.shape)
    shift = np.round(rng.normal(0.0, sigma, (2, *depth.shape))).astype(np.int64)
    rows = np.clip(rows + shift[0], 0, depth.shape[0] - 1)
    columns = np.clip(columns + shift[1], 0, depth.shape[1] - 1)
    taken = depth[rows, columns].astype(np.float64)
    other_surface = np.abs(taken - depth) > 0.02 * depth
    return np.where(other_surface & (taken > 0), taken, depth)


def _fly(depth: Floats, where: Mask, rng: np.random.Generator) -> Floats:
    """Readings between the nearest and the farthest surface around an edge pixel."""
    near, far = _extremes(depth)
    share = rng.random(depth.shape)
    return np.where(where & (near > 0), near + share * (far - near), depth)


def _extremes(depth: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Smallest and largest depth of each 3 x 3 neighbourhood."""
    kernel = np.ones((3, 3), np.uint8)
    values = depth.astype(np.float64)
    return cv2.erode(values, kernel).astype(np.float64), cv2.dilate(values, kernel).astype(np.float64)


def _edges(depth: Depth, relative_step: float) -> Mask:
    near, far = _extremes(depth)
    # A plane seen at an angle changes steadily: only a change of slope within the neighbourhood is a step.
    bend = np.abs(cv2.Laplacian(depth.astype(np.float64), cv2.CV_64F))
    return (far - near > relative_step * depth) & (bend > 0.5 * relative_step * depth)


def _shadows(depth: Depth, focal_baseline: float) -> Mask:
    """Pixels that the projector, at +x of the camera, does not light because something nearer is in its way.

    Along a row, the projector sees a pixel in column ``u - disparity``. Light reaches a surface only while these
    columns increase; a nearer surface further right that maps to the same column or before it is in the way.
    """
    columns = np.arange(depth.shape[1]) - focal_baseline / np.maximum(depth, 0.1)
    columns = np.where(depth > 0, columns, np.inf)
    ahead = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    shadow = np.zeros(depth.shape, bool)
    shadow[:, :-1] = (ahead[:, 1:] + 0.5 < columns[:, :-1]) & (depth[:, :-1] > 0)
    return shadow


def _grazing(depth: Depth, K: Intrinsics, rng: np.random.Generator, limit: float) -> Mask:
    """Misses readings of surfaces seen edge-on: never 10 degrees before ``limit``, always 10 degrees after it."""
    # Planes of coordinates, not points: these are large images.
    x, y, z = points = np.ascontiguousarray(np.moveaxis(back_project(depth, K), -1, 0))
    (ax, ay, az), (bx, by, bz) = _difference(points, 2), _difference(points, 1)
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    lengths = np.sqrt(nx * nx + ny * ny + nz * nz) * np.sqrt(x * x + y * y + z * z)
    cosine = np.abs(nx * x + ny * y + nz * z) / np.maximum(lengths, 1e-12)
    angle = np.rad2deg(np.arccos(np.clip(cosine, 0.0, 1.0)))
    return rng.random(depth.shape) < (angle - (limit - 10.0)) / 20.0


def _difference(points: Floats, axis: int) -> Floats:
    """To the next or from the previous point of 3 x H x W, whichever is nearer in depth: edges of objects keep their
    slope."""
    steps = np.diff(points, axis=axis)
    following = np.concatenate([steps, np.take(steps, [-1], axis)], axis)
    previous = np.concatenate([np.take(steps, [0], axis), steps], axis)
    return np.where(np.abs(following[2]) < np.abs(previous[2]), following, previous)


def _holes(shape: tuple[int, ...], rng: np.random.Generator, share: float) -> Mask:
    """Blobs a few pixels wide that cover ``share`` of the image."""
    field = cv2.GaussianBlur(rng.normal(0.0, 1.0, shape), (0, 0), 1.5)
    return field < np.quantile(field, share)
