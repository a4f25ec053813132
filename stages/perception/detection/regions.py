"""Pieces of a photograph that may be objects: what stands on a plane, split at edges of depth and colour."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stages.geometry.arrays import Floats
from stages.perception.detection.appearance import Bytes, Mask
from stages.perception.detection.boxes import survivors
from stages.perception.detection.merging import Labels, Pieces, components, merged
from stages.perception.detection.supports import Support, supports
from stages.perception.rendering.rasteriser import Float32s, View

_FARTHEST = 2.5
"""Metres beyond which depth cameras see too little of household objects."""
_TALLEST = 0.45
"""Metres above a plane."""
_LOWEST = (0.008, 0.016)
"""Metres above a plane at which objects begin: flat ones need the lower, bent planes the higher."""
_NOISE = 0.004
"""What is added to them per metre beyond half a metre."""
_JUMPS = (0.01, 0.025, 0.06)
"""Steps in depth at which objects are told apart, metres."""
_CONTACT = 0.012
"""Metres above a plane below which an object's outline is where it stands, which no step in depth shows."""
_STEP, _SLOPE = 0.02, 60.0
"""Edges: a step in depth, as a share of it, and Sobel's slope of CIELAB."""
_CHROMATIC = (0.4, 1.0, 1.0)
"""Shadows change lightness."""
_SUPERPIXELS = 700
_SMALLEST = 150
"""Pixels of a region."""
_SAME = 0.88
"""Overlap of boxes of one region."""
_HIDDEN = 0.08
"""Share of the outline that something nearer must have for a region to be partly hidden."""
_WHOLE = 0.3
"""What a piece that depth alone separates is ahead of others."""


@dataclass(frozen=True)
class ImageRegion:
    """A piece of the image."""

    box: Floats
    """x0, y0, x1, y1 in pixels, exclusive."""
    mask: Mask
    """Of the box' pixels those that belong to it and are seen."""
    objectness: float
    """How much of its outline lies on edges, 0 to 2.3."""
    hidden: bool
    """Whether some of it may be behind something else or beyond the image."""
    extent: tuple[float, float]
    """Width and height of the box, metres at the region's depth."""
    elevation: float
    """Degrees above its plane's horizon from which it is seen; NaN without a plane."""
    top: float
    """Metres above its plane; NaN without one."""
    whole: Mask | None = None
    """Of the box' pixels those that belong to it whether seen or not, where that is known; else as ``mask``."""


@dataclass(frozen=True)
class _Picture:
    """An image and what is computed from it once."""

    view: View
    lab: Float32s
    measured: Mask
    depth: Float32s
    """H x W without holes."""
    values: Floats
    """H x W x 9: colour with less weight on lightness, point and normal of every pixel."""
    edges: Mask
    """Edges of colour or depth."""
    jumps: Mask


def regions(
    rgb: Bytes, depth: Float32s, view: View, rng: np.random.Generator, *, up: Floats | None,
    sizes: tuple[float, float], most: int,
) -> list[ImageRegion]:  # fmt: skip
    """Up to ``most`` pieces, those with the clearest outline first.

    ``depth`` is H x W metres (0 no reading), ``up`` the direction against gravity (camera frame) where it is known, and
    ``sizes`` the smallest and largest extent of an object, metres.
    """
    picture = _picture(rgb, depth, view)
    if picture is None:
        return []
    found: list[tuple[Pieces, Support | None]] = []
    for support in supports(np.where(depth < _FARTHEST + 1, depth, 0), picture.depth, view, rng, up) or [None]:
        found += [(pieces, support) for pieces in _pieces(picture, support)]
    return _best(picture, found, sizes, most)


def _picture(rgb: Bytes, depth: Float32s, view: View) -> _Picture | None:
    measured = depth > 0
    if not measured.any():
        return None
    filled = _without_holes(depth, measured)
    smooth = cv2.GaussianBlur(rgb, (0, 0), 1).astype(np.float32) / 255
    lab = np.asarray(cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB), np.float32)
    points = view.rays() * filled[..., None]
    jumps = _range(filled, 5) > _STEP * filled
    slope = (cv2.Sobel(lab, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(lab, cv2.CV_32F, 0, 1) ** 2).sum(-1)
    values = np.asarray(np.concatenate([lab * _CHROMATIC, points, _normals(points)], -1), float)
    return _Picture(view, lab, measured, filled, values, jumps | (slope > _SLOPE**2), jumps)


def _without_holes(depth: Float32s, measured: Mask) -> Float32s:
    """Each missing reading as the nearest one."""
    missing = (~measured).astype(np.uint8)
    labels = cv2.distanceTransformWithLabels(missing, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    nearest = np.asarray(labels, np.int32)
    readings = np.zeros(int(nearest.max()) + 1, np.float32)
    readings[nearest[measured]] = depth[measured]
    return readings[nearest]


def _range(depth: Float32s, size: int) -> Float32s:
    """Difference of the farthest and the nearest reading about each pixel."""
    kernel = np.ones((size, size), np.uint8)
    return np.asarray(cv2.dilate(depth, kernel) - cv2.erode(depth, kernel), np.float32)


def _normals(points: Floats) -> Floats:
    """Unit normals towards the camera, H x W x 3."""
    smooth = cv2.GaussianBlur(points, (0, 0), 2)
    across, down = (np.roll(smooth, -4, axis) - np.roll(smooth, 4, axis) for axis in (1, 0))
    normals = np.cross(across, down)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12
    return np.where(normals[..., 2:] > 0, -normals, normals)


def _pieces(picture: _Picture, support: Support | None) -> Iterator[Pieces]:
    """All that stands on a plane: by depth alone at several thresholds, by superpixels, and where depth fails."""
    edges, jumps = picture.edges, picture.jumps
    if support is not None:
        contact = support.height < _CONTACT
        edges, jumps = edges | contact, jumps | contact
    for lowest in _LOWEST if support is not None else _LOWEST[:1]:
        zone = _zone(picture, support, lowest)
        for jump in _JUMPS:
            labels = _connected(zone & (_range(picture.depth, 3) <= jump))
            yield components(labels, picture.depth, edges, jumps)
        if lowest == _LOWEST[0] and zone.any():
            yield from merged(_superpixels(picture, zone), picture.values, edges, jumps)
    if support is not None:
        holes = support.over & _opened(~picture.measured, 3) & (support.height < 0.05)
        yield components(_connected(holes), picture.depth, edges, jumps)


def _zone(picture: _Picture, support: Support | None, lowest: float) -> Mask:
    """Pixels that may show an object on the plane."""
    near = picture.depth < _FARTHEST
    if support is None:
        return near
    height = support.height
    above = (height > lowest + _NOISE * np.maximum(picture.depth - 0.5, 0)) & (height < _TALLEST)
    return _opened(near & above & support.over, 2)


def _opened(mask: Mask, times: int) -> Mask:
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, cross, iterations=times) > 0


def _connected(mask: Mask) -> Labels:
    """Connected pixels, numbered from 1; small pieces are left out."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    kept = stats[:, cv2.CC_STAT_AREA] >= _SMALLEST
    kept[0] = False
    return np.where(kept, np.cumsum(kept), 0).astype(np.int32)[np.asarray(labels, np.int32)]


def _superpixels(picture: _Picture, zone: Mask) -> Labels:
    """The zone in small pieces of like colour and depth (SLIC), numbered from 1."""
    size = int(np.clip(np.sqrt(zone.sum() / _SUPERPIXELS), 5, 20))
    image = np.dstack([picture.lab, np.clip(150 * picture.depth, 0, 600)])
    slic = cv2.ximgproc.createSuperpixelSLIC(image, cv2.ximgproc.SLIC, size, 12.0)
    slic.iterate(5)
    slic.enforceLabelConnectivity(25)
    labels = np.where(zone, slic.getLabels() + 1, 0)
    _, numbered = np.unique(labels, return_inverse=True)
    return numbered.reshape(zone.shape).astype(np.int32) + int(labels.min() > 0)


def _best(
    picture: _Picture, found: Sequence[tuple[Pieces, Support | None]], sizes: tuple[float, float], most: int
) -> list[ImageRegion]:
    """The pieces of a fitting size with the clearest outlines, no two of them alike."""
    boxes = np.concatenate([pieces.boxes for pieces, _ in found])
    depth, pixels = (np.concatenate([getattr(p, name) for p, _ in found]) for name in ("depth", "pixels"))
    scores = np.concatenate([p.outline[:, :2].sum(1) + _WHOLE * p.whole for p, _ in found])
    origin = [(i, k) for i, (pieces, _) in enumerate(found) for k in range(len(pieces.boxes))]
    longest = (boxes[:, 2:] - boxes[:, :2]).max(1) * depth / picture.view.fx
    fitting = np.flatnonzero((pixels >= _SMALLEST) & (longest > sizes[0]) & (longest < sizes[1]))
    kept: list[ImageRegion] = []
    for index in survivors(boxes[fitting], scores[fitting], _SAME):
        i, k = origin[fitting[index]]
        region = _region(picture, *found[i], index=k, score=float(scores[fitting[index]]))
        if region is not None:
            kept.append(region)
        if len(kept) == most:
            break
    return kept


def _region(
    picture: _Picture, pieces: Pieces, support: Support | None, *, index: int, score: float
) -> ImageRegion | None:
    """One piece without ragged edges; None where too little is left."""
    x0, y0, x1, y1 = pieces.boxes[index].astype(int)
    chosen = np.zeros(int(pieces.labels.max()) + 1, bool)
    chosen[pieces.members[index]] = True
    mask = _tidy(chosen[pieces.labels[y0:y1, x0:x1]])
    if mask.sum() < _SMALLEST:
        return None
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    x0, x1, y0, y1 = x0 + columns[0], x0 + columns[-1] + 1, y0 + rows[0], y0 + rows[-1] + 1
    mask = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    window, view = np.s_[y0:y1, x0:x1], picture.view
    metres = float(np.median(picture.depth[window][mask])) / view.fx
    cut = min(x0, y0) < 3 or x1 > view.width - 3 or y1 > view.height - 3
    ray = np.array([((x0 + x1) / 2 - view.cx) / view.fx, ((y0 + y1) / 2 - view.cy) / view.fy, 1.0])
    return ImageRegion(
        box=np.array([x0, y0, x1, y1], float),
        mask=mask,
        objectness=score,
        hidden=bool(cut or pieces.outline[index, 2] > _HIDDEN),
        extent=((x1 - x0) * metres, (y1 - y0) * metres),
        elevation=np.nan if support is None else elevation_of(ray, support.normal),
        top=np.nan if support is None else float(np.percentile(support.height[window][mask], 98)),
    )


def elevation_of(ray: Floats, normal: Floats) -> float:
    """Degrees above the horizon of a plane from which the camera looks along a ray."""
    return float(np.rad2deg(np.arcsin(np.clip(-(ray * normal).sum() / np.sqrt((ray**2).sum()), -1, 1))))


def _tidy(mask: Mask) -> Mask:
    """Closed and opened, and of its pieces those that are a fifth as large as the largest."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    padded = np.pad(mask.astype(np.uint8), 4)
    smooth = cv2.morphologyEx(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel), cv2.MORPH_OPEN, kernel)[4:-4, 4:-4]
    _, labels, stats, _ = cv2.connectedComponentsWithStats(np.ascontiguousarray(smooth))
    areas = stats[:, cv2.CC_STAT_AREA]
    areas[0] = 0
    return ((areas > 0) & (areas >= 0.2 * areas.max()))[np.asarray(labels, np.int32)]
