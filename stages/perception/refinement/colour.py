"""Which of several poses a photograph shows, by what is painted on the object (docs/perception/colour.md).

The object is drawn into the photograph at every pose, all under one light. What the early layers of an ImageNet network
make of it is compared with what they make of the photograph itself, at the best common shift: colour is registered to
depth within a few pixels at best.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.perception.rendering.paint import Paint
from stages.perception.rendering.rasteriser import Float32s, View

Mask = NDArray[np.bool_]

_SIDE = 128
"""Pixels along the square to which the object and what is around it are scaled."""
_MARGIN = 4
"""Pixels around the object besides."""
_RIM = 2.5
"""Pixels along an outline that show what is behind as well."""
_RING = 6
"""Pixels around the object, whose median stands for what would be seen were it not there."""
_LEAST = 60
"""Pixels of the photograph below which nothing can be read."""
_GAIN = 2.0
"""Contrast of the photograph relative to the paint's, at most: what is more is no paint."""


@dataclass(frozen=True, kw_only=True)
class ColourSettings:
    """What a photograph's likeness to a drawn pose is worth."""

    nats: float = 30.0
    """For a unit of mean cosine, summed over the layers."""
    alike: float = 40.0
    """Grey levels (root of the sum over the channels) by which drawn poses must differ to be told apart: by more than
    the shades that were scanned with the paint, and light, print and camera, change equal colours."""
    reach: float = np.deg2rad(0.8)
    """Angle by which colour may lie beside depth: what wrong extrinsics and the parallax between two lenses leave."""


def load() -> None:
    """Reads the network, so that the first photograph does not wait for it."""
    # torch takes a second to load; whoever only reads a graph does without.
    from stages.perception.detection.backbone import Backbone

    Backbone.pretrained()


def log_odds(
    rgb: NDArray[np.uint8], view: View, shown: Mask, poses: Floats, *, paint: Paint, settings: ColourSettings
) -> Floats:
    """How much better the photograph suits one pose than another: nats up to a constant, P; all 0 where it cannot say.

    ``rgb`` is H x W x 3 (sRGB), ``shown`` H x W: where the object would be seen at any pose, nothing in front of it;
    ``poses`` are P x 3 x 4 rows of T_camera_object.
    """
    if len(poses) < 2:
        return np.zeros(len(poses))
    found = _compared(rgb, view, shown, poses, paint=paint, settings=settings)
    return np.zeros(len(poses)) if found is None else settings.nats * found.told_apart * found.likeness


def likeness(
    rgb: NDArray[np.uint8], view: View, shown: Mask, poses: Floats, *, paint: Paint, settings: ColourSettings
) -> float:
    """How much the photograph looks as if the object were there, at the best of poses that differ in what is painted.

    The mean cosine of features, summed over the three layers: 3 for what is equal, about 0 for what has nothing in
    common; NaN where it cannot be said. Otherwise as :func:`log_odds`.
    """
    found = _compared(rgb, view, shown, poses, paint=paint, settings=settings)
    return np.nan if found is None else float(found.likeness.max())


class _Compared(NamedTuple):
    likeness: Floats
    """Of the photograph to each drawn pose, P."""
    told_apart: float
    """How much the drawn poses differ in what is painted, 0 to 1."""


def _compared(
    rgb: NDArray[np.uint8], view: View, shown: Mask, poses: Floats, *, paint: Paint, settings: ColourSettings
) -> _Compared | None:
    if shown.sum() < _LEAST:
        return None
    reach = settings.reach * view.fx
    crop = _Crop.around(shown, view, int(reach) + _MARGIN)
    drawn, covers = zip(*(paint.drawn(T, crop.view) for T in poses), strict=True)
    covered: Mask = np.stack(covers) & (crop.cut(shown.astype(np.float32)) > 0.5)
    any_pose: Mask = np.logical_or.reduce(covered)
    common = _shrunk(np.logical_and.reduce(covered), crop.scale)
    if common.sum() < _LEAST * crop.scale**2:
        return None
    photograph = crop.cut(rgb.astype(np.float32))
    around = (cv2.dilate(any_pose.astype(np.uint8), _square(_RING * crop.scale)) > 0) & ~any_pose
    empty = np.where(any_pose[..., None], np.median(photograph[around], 0), photograph)
    pasted = np.repeat(empty[None], len(poses), 0)
    _light(pasted, np.stack(drawn), covered, photograph, common)
    inner = _shrunk(any_pose, crop.scale)
    told_apart = _told_apart(pasted[:, inner], settings.alike)
    return _Compared(_likeness(photograph, pasted, inner, reach * crop.scale), told_apart)


@dataclass(frozen=True)
class _Crop:
    """A square part of an image, scaled to _SIDE pixels."""

    left: int
    top: int
    side: int
    view: View

    @staticmethod
    def around(mask: Mask, view: View, margin: int) -> _Crop:
        """A mask that is not empty, and at least so many pixels around it."""
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        low, high = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]])
        side = int((high - low).max()) + 1 + 2 * margin
        left, top = ((low + high + 1 - side) // 2).tolist()
        scale = _SIDE / side
        cx, cy = (view.cx - left + 0.5) * scale - 0.5, (view.cy - top + 0.5) * scale - 0.5
        return _Crop(left, top, side, View(view.fx * scale, view.fy * scale, cx, cy, _SIDE, _SIDE))

    @property
    def scale(self) -> float:
        """Pixels of the square for one of the image."""
        return _SIDE / self.side

    def cut(self, image: Float32s) -> Float32s:
        """That part of an image (H x W or H x W x 3), whose edges go on beyond it."""
        rows, columns = (np.arange(first, first + self.side) for first in (self.top, self.left))
        part = image[np.clip(rows, 0, image.shape[0] - 1)[:, None], np.clip(columns, 0, image.shape[1] - 1)]
        way = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(part, (_SIDE, _SIDE), interpolation=way), np.float32)


def _shrunk(mask: Mask, scale: float) -> Mask:
    """A mask without its rim, whose pixels show what is behind as well."""
    return cv2.erode(mask.astype(np.uint8), _square(_RIM * scale)) > 0


def _square(reach: float) -> NDArray[np.uint8]:
    """All that is so many pixels away, along rows and columns."""
    return np.ones((2 * int(reach) + 1,) * 2, np.uint8)


def _light(images: Float32s, paints: Float32s, covered: Mask, photograph: Float32s, common: Mask) -> None:
    """Puts paints (P x S x S x 3), where they cover (P x S x S), into images in the photograph's light: mean of each
    channel, and contrast, where all poses have paint.

    One light for all poses: were each free to choose its own, a black lid in bright light would be a white one.
    """
    seen, paint = photograph[common], paints[:, common]
    gain = min(float(seen.std()) / max(float(paint.std()), 1.0), _GAIN)
    dark, bright = paint.mean((0, 1)), seen.mean(0)
    for image, drawn, where in zip(images, paints, covered, strict=True):
        image[where] = (drawn[where] - dark) * gain + bright


def _told_apart(colors: Float32s, alike: float) -> float:
    """How much of a difference between poses is paint, 0 to 1; of colours P x K x 3.

    What looks alike at all poses, for it has one colour, differs by noise and by shading.
    """
    spread = float(((colors - colors.mean(0)) ** 2).sum(-1).mean())
    return spread / (spread + alike**2)


def _likeness(photograph: Float32s, pasted: Float32s, inner: Mask, reach: float) -> Floats:
    """Mean cosine between features of S x S x 3 and of each of P x S x S x 3, summed over the layers, P.

    Features are standardised over all images; ``reach`` is the largest shift, pixels of the square.
    """
    from stages.perception.detection.backbone import Backbone

    images = np.clip(np.concatenate([photograph[None], pasted]), 0, 255)
    return np.sum([_layer_likeness(layer, inner, reach) for layer in Backbone.pretrained().early(images)], 0)


def _layer_likeness(layer: Float32s, inner: Mask, reach: float) -> Floats:
    """The same of one layer's features, (1 + P) x s x s x C."""
    size = layer.shape[1]
    share = cv2.resize(inner.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    cells = share > min(0.6, 0.9 * float(share.max()))
    drawn = layer[:, cells]
    mean, deviation = drawn.mean((0, 1)), drawn.std((0, 1)) + 1e-3
    most = max(1, round(reach * size / _SIDE))
    seen = np.pad(_directions(layer[0], mean, deviation), ((most, most), (most, most), (0, 0)), mode="edge")
    shifts = [(y, x) for y in range(2 * most + 1) for x in range(2 * most + 1)]
    shifted = np.stack([seen[y : y + size, x : x + size][cells].ravel() for y, x in shifts])
    # A matrix product may add up in another order where BLAS has more threads.
    fits = np.einsum("pk,sk->ps", _directions(drawn[1:], mean, deviation).reshape(len(layer) - 1, -1), shifted)
    return fits.max(1).astype(np.float64) / drawn.shape[1]


def _directions(features: Float32s, mean: Float32s, deviation: Float32s) -> Float32s:
    """Standardised features (... x C) at unit length."""
    result = (features - mean) / deviation
    return result / np.sqrt((result**2).sum(-1, keepdims=True))
