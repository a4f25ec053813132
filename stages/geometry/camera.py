"""The pinhole camera: pixels to rays and points, points to pixels, intrinsics of scaled and cropped images.

The convention is OpenCV's: x right, y down, z forward, pixel centres at integer coordinates.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.poses import is_pose
from stages.messages.arrays import Depth, Intrinsics, Pose

_SKEWED = 1e-3
"""Pixels by which an entry of K may be off where a pinhole camera has 0 or 1."""
_AWAY = 100.0
"""Metres from the base beyond which a camera is said to be in millimetres."""
_NEAREST, _FARTHEST = 0.05, 20.0
"""Metres between which the median reading of what looks at a table lies."""


def intrinsics(focal: float, width: int, height: int) -> Intrinsics:
    """K (3 x 3) of an ideal camera whose axis passes through the middle of the image."""
    return np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])


def checked_intrinsics(K: Floats) -> Intrinsics:
    """K (3 x 3) as it is given.

    Raises:
        ValueError: it has skew, a last row other than 0 0 1, or no focal length.
    """
    pinhole = np.array([[K[0, 0], 0.0, K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]])
    if not (np.abs(K - pinhole).max() < _SKEWED and pinhole.diagonal().min() > 0):
        raise ValueError(f"K = {K.tolist()}: must be fx 0 cx, 0 fy cy, 0 0 1 with fx and fy above 0 and without skew")
    return K


def checked_camera_pose(T: Floats) -> Pose:
    """T_base_camera (4 x 4) as it is given.

    Raises:
        ValueError: it is no pose, or cannot be metres.
    """
    if T.shape != (4, 4) or not is_pose(T):
        raise ValueError(f"{T.tolist()} is no pose; 4 x 4, a rotation and metres above 0 0 0 1, is")
    if (away := float(np.linalg.norm(T[:3, 3]))) > _AWAY:
        raise ValueError(f"the camera is {away:g} m away; metres are expected, {_AWAY:g} at most")
    return T


def checked_depth(depth: Depth) -> Depth:
    """Depth (H x W) as it is given; where it is 0 or not finite there is no reading.

    Raises:
        ValueError: it cannot be metres.
    """
    readings = depth[np.isfinite(depth) & (depth > 0)]
    if len(readings) and not _NEAREST <= (median := float(np.median(readings))) <= _FARTHEST:
        raise ValueError(f"median depth is {median:g} m; metres are expected, {_NEAREST:g} to {_FARTHEST:g}")
    return depth


def rays(K: Intrinsics, height: int, width: int) -> Floats:
    """The point on each pixel's ray at z = 1, H x W x 3."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    y = (v - K[1, 2]) / K[1, 1]
    x = (u - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def ray_factors(K: Intrinsics, height: int, width: int) -> Floats:
    """Metres along each pixel's ray per metre of depth, H x W.

    Two points on one pixel's ray are ``|z_a - z_b| * factor`` apart.
    """
    return np.linalg.norm(rays(K, height, width), axis=-1)


def back_project(depth: Depth, K: Intrinsics) -> Floats:
    """Points in the camera frame, H x W x 3, metres; the origin where there is no reading."""
    return rays(K, *depth.shape) * depth[..., None].astype(np.float64)


def project(points: Floats, K: Intrinsics) -> Floats:
    """Pixel coordinates (u, v) of points in the camera frame, ... x 3 to ... x 2; z must not be 0."""
    homogeneous = points @ K.T
    return homogeneous[..., :2] / homogeneous[..., 2:]


def scaled(K: Intrinsics, factor: float) -> Intrinsics:
    """K of the image resized by ``factor``: the image's corners lie at -0.5, half a pixel from the first centre."""
    result = K.astype(np.float64)
    result[:2] *= factor
    result[:2, 2] += 0.5 * factor - 0.5
    return result


def cropped(K: Intrinsics, x0: float, y0: float) -> Intrinsics:
    """K of the image whose first pixel is (x0, y0) of the original."""
    result = K.astype(np.float64)
    result[:2, 2] -= (x0, y0)
    return result
