"""The edges of objects in the image that they were seen in, and from above."""

from __future__ import annotations

import cv2
import numpy as np

from runner.page.story import Outline, Surety
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages import ObjectPose, SceneEstimate, SceneGraph
from stages.messages.scene import UnknownRegion
from stages.scene.catalogue import Catalogue, CatalogueObject, Mesh
from stages.scene.doubts import SURE, UNSURE
from stages.scene.naming import region_name
from stages.story.words import Words

TRIANGLES = 400
"""Of an object, for its edge."""
MARGIN = 0.2
"""Metres of ground about the objects, where nobody knows how far it goes."""
COARSE_PIXELS = 1.0
"""How far a drawn edge may be off."""


def outlines(estimate: SceneEstimate, catalogue: Catalogue, size: tuple[int, int], words: Words) -> tuple[Outline, ...]:
    """Every object of an estimate, the farthest first, and what no object explains; ``size`` is H, W."""
    objects = sorted(estimate.objects, key=lambda item: -item.T_camera_object[2, 3])
    found = [
        Outline(item.name, words.bare(item.name), surety(item), how_sure(item, words), points)
        for item in objects
        if (points := _edge(catalogue[item.label].simplified(TRIANGLES), item.T_camera_object, estimate.K, size))
    ]
    unknown = words.say("unknown_label")
    regions = (
        Outline(region_name(number), unknown, "unknown", unknown, _corners(region))
        for number, region in enumerate(estimate.unknown)
    )
    return (*found, *regions)


def surety(item: ObjectPose) -> Surety:
    """Whether an object's pose can be relied on; nobody knows that of one that was not judged."""
    if item.contradicted:
        return "doubtful"
    if item.probability is None or UNSURE <= item.probability < SURE:
        return "unsure"
    return "sure" if item.probability >= SURE else "doubtful"


def how_sure(item: ObjectPose, words: Words) -> str:
    """The same in words."""
    if item.probability is None and not item.contradicted:
        return words.say("unjudged")
    return words.say(surety(item), percent=round(100 * (item.probability or 0.0)))


def footprint(entry: CatalogueObject, T_base_object: Floats) -> tuple[tuple[float, float], ...]:
    """What an object covers seen from above, x and y in metres: its convex hull."""
    mesh = entry.simplified(TRIANGLES)
    points = (mesh.vertices @ T_base_object[:3, :3].T + T_base_object[:3, 3])[:, :2]
    return _pairs(np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], np.float64))


def ground(scene: SceneGraph) -> tuple[tuple[float, float], ...]:
    """The support surface as far as it was seen; where nobody knows, what surrounds the objects."""
    if scene.support is not None:
        T = scene.T_base_table
        return _pairs(scene.support @ T[:2, :2].T + T[:2, 3])
    points = np.array([item.T_base_object[:2, 3] for item in scene.objects])
    (x0, y0), (x1, y1) = points.min(0) - MARGIN, points.max(0) + MARGIN
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def pixel(point: Floats, T_base_camera: Floats, K: Floats) -> tuple[int, int]:
    """Where a point of the base frame is in the image."""
    x, y, depth = K @ (inverse(T_base_camera) @ [*point, 1.0])[:3]
    return round(float(x / depth)), round(float(y / depth))


def _pairs(points: Floats) -> tuple[tuple[float, float], ...]:
    """To the millimetre."""
    return tuple((round(float(x), 3), round(float(y), 3)) for x, y in points)


def _edge(mesh: Mesh, T: Floats, K: Floats, size: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """The outer edge of a mesh's largest part in sight; nothing where it is behind the camera or beside the image."""
    points = mesh.vertices @ T[:3, :3].T + T[:3, 3]
    if (points[:, 2] <= 0).any():
        return ()
    pixels = (points @ K.T)[:, :2] / points[:, 2:]
    mask = np.zeros(size, np.uint8)
    for corners in pixels[mesh.faces].round().astype(np.int32):
        cv2.fillConvexPoly(mask, corners, 1)
    edges, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not edges:
        return ()
    largest = max(edges, key=cv2.contourArea)
    return tuple((int(x), int(y)) for x, y in cv2.approxPolyDP(largest, COARSE_PIXELS, closed=True)[:, 0])


def _corners(region: UnknownRegion) -> tuple[tuple[int, int], ...]:
    x0, y0, x1, y1 = (round(float(edge)) for edge in region.box)
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
