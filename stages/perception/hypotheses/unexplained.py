"""What the estimated scene leaves open: readings that no object explains, surfaces that the camera looks through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.masks import Mask, dilated, eroded, opened, part_of
from stages.geometry.poses import along, rotate
from stages.perception.filter.likelihood import ObservedScene
from stages.perception.rendering.rasteriser import Float32s

_MARGIN = 0.012
"""Metres along the ray, at one metre, that no reading of a well-placed surface is off; grows with the square of depth
as the noise of triangulation does."""
_EDGE = 5
"""Pixels about a silhouette (at 640 pixels across) in which a reading may belong to either side."""
_HEIGHT = 0.015
"""Metres above the plane, at one metre, below which a reading may be the plane's own; grows likewise."""
_TOP = 0.025
"""Metres above the plane that a region reaches at least: a sensor's bias bends the plane it sees."""
_AREA = 4e-4
"""Square metres facing the camera that a region has at least: 2 cm by 2 cm."""
_POINTS = 40
"""Readings that a region has at least."""
_CONTRADICTED = 0.3
"""Share of an object's visible silhouette that the camera looks through if the object cannot be there."""
_ROOM = 1.4
"""Times the margin by which what is behind an object must be behind it for the camera to tell that it is gone."""
_GONE = 0.9
"""Share of such places that it looks through if a flat object is gone; of a tray that is 2 cm beside where it is taken
to be, up to 0.87."""
_SHOWN = 0.5
"""Share of the silhouette that must be in sight for that."""


@dataclass(frozen=True)
class UnexplainedRegion:
    """Connected readings above the plane that no object explains."""

    box: Floats
    """x0, y0, x1, y1 in pixels, x1 and y1 exclusive."""
    points: int
    centre_table: Floats
    """Centre of the readings' enclosing box in the table's frame, metres."""
    extent_table: Floats
    """Edges of that box, metres."""

    @property
    def size(self) -> float:
        """Diagonal of the box that encloses the readings, metres."""
        return float(np.linalg.norm(self.extent_table))

    def joined(self, other: UnexplainedRegion) -> UnexplainedRegion:
        """Both as one region."""
        low, high = (
            bound([each.centre_table + sign * each.extent_table / 2 for each in (self, other)], axis=0)
            for bound, sign in ((np.min, -1), (np.max, 1))
        )
        box = np.array([*np.minimum(self.box, other.box)[:2], *np.maximum(self.box, other.box)[2:]])
        return UnexplainedRegion(box, self.points + other.points, (low + high) / 2, high - low)


def unknown_regions(scene: ObservedScene, layers: Sequence[Float32s]) -> tuple[UnexplainedRegion, ...]:
    """Clusters what stands on the plane and belongs to no object, the largest first.

    ``layers`` are the objects' inverse depths, H x W each. Readings within a few pixels of a silhouette do not count:
    there they may be of either side, or of neither.
    """
    lonely = opened(unexplained(scene, layers, edge=_edge(scene)), 1 + _edge(scene) // 2)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(lonely.astype(np.uint8), connectivity=8)
    found = [
        _region(scene, labels[y : y + height, x : x + width] == number, x, y)
        for number, (x, y, width, height, _) in enumerate(boxes.tolist())
        if number > 0
    ]
    # How components are numbered may depend on the number of threads; their order here must not.
    return tuple(sorted(filter(None, found), key=lambda region: (-region.points, *region.box.tolist())))


def looked_through(scene: ObservedScene, layer: Float32s, others: Float32s) -> float:
    """Share of an object's visible silhouette, its rim apart, where the reading is clearly behind its surface.

    ``layer`` and ``others`` are H x W inverse depths of the object, and of the plane and all other objects. 0 where
    there are no readings: no evidence.
    """
    seen, through, _ = _against(scene, layer, others)
    return float(through.sum() / max(1, seen.sum()))


def is_seen_empty(scene: ObservedScene, layer: Float32s, others: Float32s) -> bool:
    """Whether an object that was there is not there any more; arguments as of :func:`looked_through`.

    Behind most of a flat one, such as a tray, the plane is too near to tell: where enough of it would show, it is gone
    if the camera looks through nearly all of what stands out.
    """
    seen, through, telling = _against(scene, layer, others)
    if is_contradicted(through.sum() / max(1, seen.sum())):
        return True
    shows = telling.sum() >= _POINTS and seen.sum() >= _SHOWN * (layer > 0).sum()
    return bool(shows and (telling & through).sum() > _GONE * telling.sum())


def is_contradicted(share: float) -> bool:
    """Whether an object that the camera looks through by this share of it cannot be there."""
    return share > _CONTRADICTED


def unexplained(scene: ObservedScene, layers: Sequence[Float32s], *, edge: int) -> Mask:
    """Readings above the plane that lie on no object, and not within ``edge`` pixels of a silhouette, H x W."""
    normal, offset = scene.plane[:3], scene.plane[3]
    above = (along(scene.view.rays(), normal.astype(float)) * scene.depth + offset) > _HEIGHT * _growth(scene.depth)
    open_readings = scene.foreground & above
    for layer in filter(np.any, layers):
        part = part_of(layer > 0, edge)
        shown, depth = layer[part] > 0, scene.depth[part]
        on_it = shown & (np.abs(1.0 / np.where(shown, layer[part], 1.0) - depth) < _margin(depth))
        rim = dilated(shown, edge) & ~eroded(shown, edge)
        open_readings[part] &= ~(on_it | rim)
    return open_readings


def _against(scene: ObservedScene, layer: Float32s, others: Float32s) -> tuple[Mask, Mask, Mask]:
    """Where readings are in an object's visible silhouette, its rim apart; where of these they are clearly behind its
    surface; and where they would be, with room for noise, if it was gone. In the smallest part of the image about it.
    """
    part = part_of(layer > 0)
    if not layer[part].size:
        nowhere = np.zeros((0, 0), bool)
        return nowhere, nowhere, nowhere
    layer, depth, others = layer[part], scene.depth[part], others[part]
    inner = eroded(layer > 0, max(1, _edge(scene) // 2))
    seen = inner & (layer >= others) & (scene.factor[part] > 0)
    surface = 1.0 / np.where(seen, layer, 1.0)
    behind = 1.0 / np.maximum(others, 1e-6)
    return (
        seen,
        seen & (depth - surface > _margin(depth)),
        seen & (behind - surface > _ROOM * _margin(depth)),
    )


def _region(scene: ObservedScene, part: Mask, left: int, top: int) -> UnexplainedRegion | None:
    """The readings of a part of the image that begins at a pixel; None where they are too few."""
    rows, columns = np.nonzero(part)
    rows, columns = rows + top, columns + left
    z = scene.depth[rows, columns].astype(np.float64)
    if len(rows) < _POINTS or float((z**2).sum()) / (scene.view.fx * scene.view.fy) < _AREA:
        return None
    T = scene.T_camera_table
    points = scene.view.rays()[rows, columns] * z[:, None] - T[:3, 3]
    low, high = np.percentile(rotate(T[:3, :3].T, points), [2, 98], axis=0)
    if high[2] < _TOP:
        return None
    box = np.array([left, top, left + part.shape[1], top + part.shape[0]], float)
    return UnexplainedRegion(box, len(rows), (low + high) / 2, high - low)


def _margin(depth: Float32s) -> Floats:
    return _MARGIN * _growth(depth)


def _growth(depth: Float32s) -> Floats:
    """How much larger a sensor's errors are than at one metre or less."""
    return np.maximum(depth.astype(np.float64), 1.0) ** 2


def _edge(scene: ObservedScene) -> int:
    return max(2, round(_EDGE * scene.view.width / 640))
