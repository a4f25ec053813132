"""What the robot's camera sees of what is laid out on the table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stages.geometry.arrays import Floats
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.robots import Robot
from stages.scene.catalogue import CatalogueObject

Layout = dict[str, Floats]
"""T_base_object (4 x 4) by name, supporters before what they support."""

HIDDEN = 0.5
"""Largest share of an object's image rectangle that the rectangle of an object in front may cover."""
_BORDER = 6.0
"""Pixels."""
_TRIANGLES = 500


def is_seen(robot: Robot, objects: Sequence[tuple[CatalogueObject, Floats]], hidden: float = HIDDEN) -> bool:
    """Every object (at its T_base_object) wholly in the camera's image and no more ``hidden`` by another one."""
    rectangles = [image_rectangle(robot, *each) for each in objects]
    if not all(is_inside_image(robot, rectangle) for rectangle in rectangles):
        return False
    low, high = np.array([r[0] for r in rectangles]), np.array([r[1] for r in rectangles])
    overlap = np.maximum(np.minimum(high[:, None], high) - np.maximum(low[:, None], low), 0).prod(-1)
    covered = overlap / (high - low).prod(-1)[:, None]
    # An object in front reaches lower in the image; what is stacked is not in front of what carries it.
    places = np.array([T[:2, 3] for _, T in objects])
    stacked = np.linalg.norm(places[:, None] - places, axis=2) < 0.03
    behind = (high[:, None, 1] < high[None, :, 1]) & ~stacked
    return bool((covered[behind] <= hidden).all())


def least_shown(robot: Robot, objects: Sequence[tuple[CatalogueObject, Floats]]) -> float:
    """The smallest share of an object's silhouette (at its T_base_object) that none of the others hides."""
    view = View.of(robot.camera.K, *robot.camera.size)
    layers = [
        inverse_depth(Soup.of(entry.simplified(_TRIANGLES)), robot.T_camera_base @ T, view) for entry, T in objects
    ]
    nearest = np.maximum.reduce(layers)
    return min(float((layer >= nearest)[layer > 0].mean()) for layer in layers)


def is_inside_image(robot: Robot, rectangle: Floats) -> bool:
    """Whether a rectangle of pixels (2 x 2) lies in the camera's image, away from its border."""
    return bool((rectangle[0] >= _BORDER).all() and (rectangle[1] <= np.array(robot.camera.size) - _BORDER).all())


def image_rectangle(robot: Robot, entry: CatalogueObject, T_base_object: Floats) -> Floats:
    """2 x 2: lowest and highest pixel coordinates of the enclosing box, seen while the robot is at home."""
    corners = np.array(
        [[entry.bounds[i, 0], entry.bounds[j, 1], entry.bounds[k, 2]] for i, j, k in np.ndindex(2, 2, 2)]
    )
    T = robot.T_camera_base @ T_base_object
    points = corners @ T[:3, :3].T + T[:3, 3]
    pixels = points[:, :2] / points[:, 2:] * robot.camera.focal + np.array(robot.camera.size) / 2
    return np.stack([pixels.min(0), pixels.max(0)])
