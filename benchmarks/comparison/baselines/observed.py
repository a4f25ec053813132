"""What every baseline sees of an image: readings above the support plane, boxes, and how well rendered poses agree."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.datasets import Image
from stages.geometry.arrays import Floats
from stages.messages import Candidate
from stages.perception.filter.particle_filter import Rectangle
from stages.perception.observation.preprocessing import preprocess
from stages.perception.rendering.rasteriser import Float32s, Soup, View, inverse_depth

_MAX_HEIGHT = 0.6
"""Metres above the support plane; what the main job takes as well."""
_TOLERANCE = 0.01
"""Metres between rendered and observed depth within which a pixel agrees."""
_VIOLATION = 1.0
"""What a pixel takes away where the sensor looks through the rendered surface, or where that is below the table."""
_HIDDEN = 0.1
"""What a pixel takes away where an object in front hides the rendered surface."""
_STRAY = 0.5
"""What an agreeing pixel takes away outside the object's own box."""
_SLACK = 0.1
"""Share of its size by which a detector's box may be off."""
_MARGIN = 0.5
"""Poses are judged in the box and this share of its size around it."""


@dataclass(frozen=True)
class Observed:
    """A preprocessed image: the same support plane and foreground as the estimator gets."""

    depth: Float32s
    """H x W metres, 0 where there is no reading."""
    foreground: NDArray[np.bool_]
    view: View
    T_camera_table: Floats

    @staticmethod
    def of(image: Image, seed: int) -> Observed:
        """Preprocesses an image with all of its boxes."""
        rng = np.random.default_rng([seed, *image.id])
        seen = preprocess(image.frame, image.boxes, rng, max_height=_MAX_HEIGHT)
        height, width = seen.depth.shape
        view = View.of(seen.K, width, height)
        return Observed(seen.depth, seen.foreground & (seen.depth > 0), view, seen.T_camera_table)

    @cached_property
    def points(self) -> Floats:
        """H x W x 3 readings in the camera frame, metres."""
        return self.view.rays() * self.depth[..., None]

    @property
    def whole(self) -> Rectangle:
        """All of the image."""
        return 0, 0, self.view.width, self.view.height

    def region(self, box: Floats, margin: float = 0.0) -> Rectangle:
        """Pixels of a box and a share of its size around it, inside the image, at least one."""
        reach = margin * float((box[2:] - box[:2]).max())
        size = np.array([self.view.width, self.view.height])
        low = np.clip(np.floor(box[:2] - reach), 0, size - 1).astype(int)
        high = np.clip(np.ceil(box[2:] + reach), low + 1, size).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def inside(self, candidate: Candidate) -> Floats:
        """Readings above the plane inside a box, N x 3 metres in the camera frame."""
        x0, y0, x1, y1 = self.region(candidate.box)
        return self.points[y0:y1, x0:x1][self.foreground[y0:y1, x0:x1]]


@dataclass(frozen=True)
class Crop:
    """Part of an image, every ``stride``-th pixel: where rendered poses are compared with the readings."""

    view: View
    depth: Float32s
    gain: Floats
    """What a pixel that agrees is worth: 1 for foreground in the box, less outside, 0 for the table."""
    hiding: Floats
    """What a pixel that hides the rendered surface takes away: little for foreground, more for the table."""

    @staticmethod
    def whole(observed: Observed, stride: int) -> Crop:
        """The image with all its boxes."""
        return Crop._cut(observed, observed.whole, stride, observed.foreground.astype(float))

    @staticmethod
    def around(observed: Observed, candidate: Candidate, stride: int) -> Crop:
        """A box and half its size around it."""
        x0, y0, x1, y1 = observed.region(candidate.box, _SLACK)
        gain = np.where(observed.foreground, -_STRAY, 0.0)
        gain[y0:y1, x0:x1] = observed.foreground[y0:y1, x0:x1]
        return Crop._cut(observed, observed.region(candidate.box, _MARGIN), stride, gain)

    @staticmethod
    def _cut(observed: Observed, region: Rectangle, stride: int, gain: Floats) -> Crop:
        x0, y0, x1, y1 = region
        part = np.s_[y0:y1:stride, x0:x1:stride]
        hiding = np.where(observed.foreground[part], _HIDDEN, _VIOLATION)
        return Crop(observed.view.sampled(*region, stride), observed.depth[part], gain[part], hiding)

    def agreement(self, inverse: Float32s) -> float:
        """Rendered-depth agreement: pixels that agree with their reading, less those that contradict it.

        ``inverse`` is the rendered inverse depth. A pixel agrees by 1 - (d / 10 mm)^2; it contradicts fully where
        the reading lies behind the rendered surface or is of the table and lies in front, and a little where another
        object lies in front (it hides the surface).
        """
        shown = (inverse > 0) & (self.depth > 0)
        behind = self.depth[shown] - 1.0 / inverse[shown]
        near = (1.0 - (behind / _TOLERANCE) ** 2) * self.gain[shown]
        far = np.where(behind > 0, -_VIOLATION, -self.hiding[shown])
        return float(np.where(np.abs(behind) < _TOLERANCE, near, far).sum())

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Which points (N x 3 metres, camera frame) are seen in this part of the image."""
        seen = self.view.project(points)
        size = np.array([self.view.width, self.view.height])
        return (points[:, 2] > 0) & ((seen > -0.5) & (seen < size - 0.5)).all(1)

    def ranked(self, soup: Soup, poses: Floats) -> Floats:
        """P x 4 x 4 poses of one object, the one that agrees best first."""
        scores = np.array([self.agreement(inverse_depth(soup, T, self.view)) for T in poses])
        return poses[np.argsort(-scores, kind="stable")]
