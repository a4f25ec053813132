"""What the camera can see of a place: lines of sight past other objects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.scene.stance import Standing

_HEIGHTS = np.array([0.1, 0.5, 0.9])
"""Shares of an object's height at which its outline is looked at."""


def hidden_share(item: Standing, others: Sequence[Standing], eye: Floats) -> float:
    """Share of points of an object that others hide from a camera at ``eye`` (3, the table's frame), 0 to 1.

    Every object counts as the prism over its outline, from its bottom to its top.
    """
    outline = np.concatenate([item.outline, item.outline.mean(0)[None]])
    heights = item.z_bottom + _HEIGHTS * (item.z_top - item.z_bottom)
    points = np.concatenate([np.column_stack([outline, np.full(len(outline), z)]) for z in heights])
    hidden = [_behind(points, other, eye) for other in others]
    return float(np.logical_or.reduce([np.zeros(len(points), bool), *hidden]).mean())


def _behind(points: Floats, other: Standing, eye: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which lines from the eye to N points pass through an object's prism, N.

    Each side of the prism bounds the part of a line, from 0 at the eye to 1 at the point, that is inside it.
    """
    along = regions.edges(other.outline)
    outward = np.column_stack([along[:, 1], -along[:, 0], np.zeros(len(along))])
    normals = np.vstack([outward, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    limits = np.append((outward[:, :2] * other.outline).sum(1), [other.z_top, -other.z_bottom])
    room = limits - normals @ eye
    rate = (points - eye) @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = room / rate
    enters = np.where(rate < 0, crossing, -np.inf).max(1)
    leaves = np.where(rate > 0, crossing, np.inf).min(1)
    outside = ((rate == 0) & (room < 0)).any(1)
    return (np.maximum(enters, 0.0) < np.minimum(leaves, 1.0)) & ~outside
