"""From a frame to the observation that particles are compared with: crop, robot mask, support plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.messages.digest import Candidate, Observation
from stages.messages.sensing import Frame
from stages.perception.observation.plane import find_plane, height_above, stands_out, support_region
from stages.perception.rendering.rasteriser import Float32s, View

_MARGIN = 0.5
"""The working area reaches beyond the candidates' boxes by this share of their common extent."""


def preprocess(
    frame: Frame, candidates: Sequence[Candidate], rng: np.random.Generator, *, max_height: float
) -> Observation:
    """Cuts a frame down to the working area around the candidates and finds its support plane.

    Raises:
        Refused: there are hardly any readings, or no plane among them.
    """
    measured = np.isfinite(frame.depth) & (frame.depth > 0)
    area, whole = working_area(frame, candidates), _without_robot(frame, measured)
    depth = np.where(area, whole, np.float32(0))
    view = View.of(frame.K, depth.shape[1], depth.shape[0])
    up = None if frame.T_base_camera is None else frame.T_base_camera[2, :3]
    T_camera_table = find_plane(depth, view, rng, objects=_spheres(depth, view, _surest(candidates)), up=up)
    if T_camera_table is None:
        raise Refused(_no_plane(frame, depth))
    height = height_above(depth, view, T_camera_table)
    foreground = (depth > 0) & stands_out(height, depth) & (height < max_height)
    return Observation(
        depth=depth,
        rgb=frame.rgb,
        foreground=foreground,
        K=frame.K,
        T_camera_table=T_camera_table,
        T_base_camera=frame.T_base_camera,
        scene_id=frame.scene_id,
        image_id=frame.image_id,
        name=frame.name,
        support=support_region(whole, view, T_camera_table),
        beyond=np.where(area, np.float32(0), whole),
    )


def _without_robot(frame: Frame, measured: NDArray[np.bool_]) -> Float32s:
    """All readings of the frame, 0 where there is none or the robot is."""
    seen = measured if frame.robot_mask is None else measured & ~frame.robot_mask
    return np.where(seen, frame.depth, np.float32(0))


def _no_plane(frame: Frame, depth: Float32s) -> str:
    around = int((depth > 0).sum())
    level = "" if frame.T_base_camera is None else " that is level"
    return (
        f"{frame.name}: no support plane{level}; the depth image has {int((frame.depth > 0).sum())} readings, {around} "
        "of them around the candidates, and a support plane needs 100 and a tenth of those near the objects"
    )


def _surest(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Those at least half as confident as the most confident one: many unsure ones may lie on the floor."""
    highest = max((candidate.confidence for candidate in candidates), default=0.0)
    return [candidate for candidate in candidates if candidate.confidence >= highest / 2]


def _spheres(depth: Float32s, view: View, candidates: Sequence[Candidate]) -> Floats:
    """Where the candidates are, C x 4 metres in the camera frame: the median reading in the inner half of each box,
    and half the extent of the box at that depth."""
    points = view.rays() * depth[..., None]
    found: list[Floats] = []
    for candidate in candidates:
        x0, y0, x1, y1 = candidate.box
        quarter_x, quarter_y = (x1 - x0) / 4, (y1 - y0) / 4
        rows = slice(max(0, int(y0 + quarter_y)), max(0, int(y1 - quarter_y)) + 1)
        columns = slice(max(0, int(x0 + quarter_x)), max(0, int(x1 - quarter_x)) + 1)
        inside = points[rows, columns][depth[rows, columns] > 0]
        if len(inside):
            middle = np.median(inside, axis=0)
            found.append(np.append(middle, max(x1 - x0, y1 - y0) / 2 / view.fx * middle[2]))
    return np.array(found, float).reshape(-1, 4)


def working_area(frame: Frame, candidates: Sequence[Candidate]) -> NDArray[np.bool_]:
    """Pixels around the candidates that do not show the robot, H x W; the whole image without candidates."""
    area = np.ones(frame.depth.shape, bool)
    if candidates:
        boxes = np.stack([candidate.box for candidate in candidates])
        low, high = boxes[:, :2].min(0), boxes[:, 2:].max(0)
        reach = _MARGIN * (high - low).max()
        x0, y0 = np.maximum(np.floor(low - reach), 0).astype(int)
        x1, y1 = np.maximum(np.ceil(high + reach), 0).astype(int)
        area[:] = False
        area[y0:y1, x0:x1] = True
    return area if frame.robot_mask is None else area & ~frame.robot_mask
