"""Candidates judged a second time: within the silhouette of the pose that a look at each alone found.

A region's outline is what edges of depth and colour made it; a silhouette is the object's, without what hides it. Where
the label is wrong, what lies within looks like no view of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.geometry.arrays import Floats
from stages.messages.digest import PATCH_STRIDE, DepthPatch
from stages.perception.detection.appearance import Bytes, Mask
from stages.perception.detection.labels import Judge
from stages.perception.detection.outline import HIDES
from stages.perception.detection.propose import confidences
from stages.perception.detection.regions import ImageRegion, elevation_of
from stages.perception.rendering.rasteriser import Float32s, View

_OUTLINE = 1.5
"""How clear a silhouette's outline is taken to be: that of an object."""
_SMALLEST = 60
"""Visible pixels below which nothing can be recognised."""
_ODDS = 1.6
_FIRST, _SECOND, _DEPTH, _BORDER, _PAINT = 0.5, 2.5, 11.4, -10.5, 5.7
EXPLAINED, FAINT, ALIKE = 0.8, 0.12, 0.6
"""Log-odds that an object is there with this label: the odds of both judgements, the share of the readings that it
covers which it explains, from this share on, the share of its outline that does not show, from that share on, and how
much the photograph looks as if it were there, from that likeness on. `python -m benchmarks.appraisal` fits it."""
_MOST_ALIKE = 1.5
"""Likeness beyond which an object could not look more as if it were there."""
_CERTAIN = 3.0
"""Log-odds beyond which a judgement is as good as any: look-alikes are never out of the question."""
_SUREST = 5.0
"""Log-odds that all of it leaves at most."""


@dataclass(frozen=True)
class Appraisal:
    """What is known of candidates once they were looked at."""

    confidences: Floats
    """N: that an object of this label is there."""
    shares: Floats
    """N: so much of the readings that it covers an object must explain to be believed, whatever else is there."""


def second_confidences(
    judge: Judge, rgb: Bytes, regions: Sequence[ImageRegion | None], labels: Sequence[int]
) -> Floats:
    """v(L | silhouette) of each candidate's label, 0 where hardly anything is visible (None); N."""
    seen = [region for region in regions if region is not None]
    found = np.zeros(len(regions))
    if seen:
        rows = np.flatnonzero([region is not None for region in regions])
        found[rows] = confidences(seen, judge.scores(seen, rgb))[np.arange(len(rows)), np.array(labels)[rows]]
    return found


def appraisal(first: Floats, second: Floats, explained: Floats, faint: Floats, alike: Floats) -> Appraisal:
    """Of confidences before and after the look, the shares of what objects cover that they explain, those of their
    outlines that do not show, and how much the photograph looks as if they were there (both NaN where that cannot be
    told); N each."""
    outline, paint = np.nan_to_num(faint - FAINT), np.nan_to_num(bounded_likeness(alike) - ALIKE)
    appearance = _ODDS + _FIRST * log_odds(first) + _SECOND * log_odds(second) + _BORDER * outline + _PAINT * paint
    odds = appearance + _DEPTH * (np.clip(explained, 0, 1) - EXPLAINED)
    return Appraisal(1 / (1 + np.exp(-np.clip(odds, -_SUREST, _SUREST))), EXPLAINED - appearance / _DEPTH)


def bounded_likeness(alike: Floats) -> Floats:
    """Likeness to the photograph as far as it counts."""
    return np.clip(alike, 0.0, _MOST_ALIKE)


def silhouette(glimpse: DepthPatch, depth: Float32s, view: View, T_camera_table: Floats) -> ImageRegion | None:
    """An object's silhouette as a region of the image; None where hardly anything of it is visible.

    ``depth`` is H x W metres, 0 where there is no reading.
    """
    left, top = PATCH_STRIDE * glimpse.left, PATCH_STRIDE * glimpse.top
    layer = glimpse.inverse.repeat(PATCH_STRIDE, 0).repeat(PATCH_STRIDE, 1)
    layer = layer[: view.height - top, : view.width - left]
    bottom, right = top + layer.shape[0], left + layer.shape[1]
    whole, read = layer > 0, depth[top:bottom, left:right]
    z = 1.0 / np.where(whole, layer, 1.0)
    mask = whole & ~((read > 0) & (z - read > HIDES))
    if mask.sum() < _SMALLEST:
        return None
    normal, origin = T_camera_table[:3, 2], T_camera_table[:3, 3]
    rays = view.sampled(left, top, right, bottom, 1).rays()
    height = (rays * normal).sum(-1) * z - (normal * origin).sum()
    metres = float(np.median(z[mask])) / view.fx
    return ImageRegion(
        box=np.array([left, top, right, bottom], float),
        mask=mask,
        objectness=_OUTLINE,
        hidden=min(left, top) < 3 or right > view.width - 3 or bottom > view.height - 3,
        extent=((right - left) * metres, (bottom - top) * metres),
        elevation=elevation_of(rays[rays.shape[0] // 2, rays.shape[1] // 2], normal),
        top=float(np.percentile(height[whole], 98)),
        whole=whole,
    )


def visible_mask(region: ImageRegion, view: View) -> Mask:
    """Where in the image a silhouette is seen, H x W."""
    shown = np.zeros((view.height, view.width), bool)
    x0, y0, x1, y1 = region.box.astype(int)
    shown[y0:y1, x0:x1] = region.mask
    return shown


def visible_box(region: ImageRegion) -> Floats:
    """The box of what is seen of a silhouette: x0, y0, x1, y1 in pixels."""
    rows, columns = np.flatnonzero(region.mask.any(1)), np.flatnonzero(region.mask.any(0))
    return np.tile(region.box[:2], 2) + np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])


def log_odds(confidence: Floats) -> Floats:
    """Natural log-odds, bounded."""
    with np.errstate(divide="ignore"):
        return np.clip(np.log(confidence) - np.log1p(-confidence), -_CERTAIN, _CERTAIN)
