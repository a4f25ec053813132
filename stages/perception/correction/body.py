"""The robot as its own depth camera should see it: what the description and the encoders say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.robots import Robot

_MARGIN = 2
"""Pixels at the edge of a shape that are left out: readings there are of something else as often as not."""
_BEND = 0.02
"""Share by which inverse depth changes from the slope on one side of a pixel to that on the other, at an edge."""
_GRAZING = 0.3
"""Cosine between a ray and the surface's normal below which readings are poor."""


@dataclass(frozen=True)
class Surface:
    """Where the robot's surface is in a depth image, at N pixels away from its edges; camera frame, metres."""

    pixels: NDArray[np.intp]
    """N, indices into the flat image."""
    points: Floats
    """N x 3."""
    normals: Floats
    """N x 3, unit length, towards the camera."""


class RobotSurface:
    """Renders a robot to the surface that a camera reads."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._shapes = [(link, Soup.of(mesh)) for link, mesh in robot.body.meshes]

    def seen(self, joint_names: Sequence[str], positions: Floats, T_base_camera: Floats, view: View) -> Surface:
        """What a camera at ``T_base_camera`` sees of the robot at these joint positions."""
        T_base_links = self._robot.body.link_poses(joint_names, positions)
        T_camera_base = inverse(T_base_camera)
        nearest = np.zeros((view.height, view.width), np.float32)
        for link, shape in self._shapes:
            np.maximum(nearest, inverse_depth(shape, T_camera_base @ T_base_links[link], view), out=nearest)
        return _surface(nearest.astype(np.float64), view)


def _surface(q: Floats, view: View) -> Surface:
    """Points and normals of an image of inverse depth ``q`` (H x W), which is linear on the screen where it is flat.

    A plane n . P = 1 is q = n . ray, so that the slopes of q give n.
    """
    slope_x, slope_y = cv2.Sobel(q, cv2.CV_64F, 1, 0, scale=1 / 8), cv2.Sobel(q, cv2.CV_64F, 0, 1, scale=1 / 8)
    bend = np.abs(cv2.Laplacian(q, cv2.CV_64F, ksize=1))
    flat = ((q > 0) & (bend < _BEND * q)).astype(np.uint8)
    inner = cv2.erode(flat, np.ones((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.uint8), borderValue=0).astype(bool)
    rays = view.rays()[inner]
    nx, ny = slope_x[inner] * view.fx, slope_y[inner] * view.fy
    normals = -np.stack([nx, ny, q[inner] - rays[:, 0] * nx - rays[:, 1] * ny], 1)
    normals /= np.sqrt((normals**2).sum(1, keepdims=True))
    points = rays / q[inner][:, None]
    cosine = -(points * normals).sum(1) / np.sqrt((points**2).sum(1))
    kept = cosine > _GRAZING
    return Surface(np.flatnonzero(inner)[kept], points[kept], normals[kept])
