"""Small rendered scenes on a table, with exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.masks import box_of
from stages.geometry.poses import exp_so3, pose
from stages.perception.filter.likelihood import ObservedScene
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.scene.catalogue import Catalogue
from stages.scene.scoring import label_of

CATALOGUE_FILE = Path(__file__).parents[3] / "stages" / "scene" / "catalogue.yaml"
CATALOGUE = Catalogue.load(CATALOGUE_FILE)
VIEW = View(260.0, 260.0, 159.5, 119.5, 320, 240)
K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
DATA = Path(__file__).parents[4] / "shared" / "data"


@dataclass(frozen=True)
class Rendered:
    """A depth image and what is in it."""

    scene: ObservedScene
    poses: dict[str, Floats]
    boxes: dict[str, Floats]


def camera(*, distance: float = 0.8, pitch: float = 0.7) -> Floats:
    """T_camera_table of a camera that looks down at the table's origin, ``pitch`` radians below the horizon."""
    R = exp_so3(np.array([np.pi / 2 + pitch, 0.0, 0.0]))
    return pose(R, np.array([0.0, 0.0, distance]))


def upright(label: str, x: float, y: float, yaw: float) -> Floats:
    """T_table_object of an object that stands on the table."""
    height = -CATALOGUE[label].bounds[0, 2]
    return pose(exp_so3(np.array([0.0, 0.0, yaw])), np.array([x, y, height]))


def render(placed: dict[str, Floats], *, noise: float = 0.0015, seed: int = 0) -> Rendered:
    """Depth of objects (name -> T_table_object) on a table with Gaussian noise (metres) and 2 % holes."""
    rng = np.random.default_rng(seed)
    T_camera_table = camera()
    blank = np.ones((VIEW.height, VIEW.width), np.float32)
    plane = ObservedScene.of(blank, blank > 0, K, T_camera_table).plane_inverse
    poses = {label: T_camera_table @ T for label, T in placed.items()}
    layers = {
        name: inverse_depth(Soup.of(CATALOGUE[label_of(name, CATALOGUE)].mesh), T, VIEW) for name, T in poses.items()
    }
    nearest = np.maximum.reduce([plane, *layers.values()])
    depth = np.where(nearest > 0, 1 / np.maximum(nearest, 1e-6), 0) + rng.normal(0, noise, nearest.shape)
    depth = np.where((nearest > 0.3) & (rng.random(nearest.shape) > 0.02), depth, 0).astype(np.float32)
    boxes = {label: box_of((layer > 0) & (layer >= nearest)) for label, layer in layers.items()}
    foreground = (nearest > plane) & (depth > 0)
    return Rendered(ObservedScene.of(depth, foreground, K, T_camera_table), poses, boxes)
