"""Three objects of the built-in catalogue: their views, and photographs of them that no view repeats."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.masks import box_of
from stages.messages import Frame
from stages.perception.detection.views import Views
from stages.perception.rendering.contact_sheet import looking_at
from stages.perception.rendering.rasteriser import Float32s, View
from stages.perception.rendering.renderer import Camera, Item, Renderer
from stages.scene.catalogue import Catalogue, Mesh
from tests.stages.perception.scenes import CATALOGUE, upright

NAMES = ("bowl", "cereal_box", "sauce_bottle")
OBJECTS = Catalogue({name: CATALOGUE[name] for name in NAMES})
K = np.array([[420.0, 0.0, 159.5], [0.0, 420.0, 119.5], [0.0, 0.0, 1.0]])
VIEW = View.of(K, 320, 240)
T_TABLE_CAMERA = looking_at(np.array([0.15, -0.75, 0.55]), np.array([0.0, 0.0, 0.03]))
_TABLE = Mesh(
    vertices=np.array([[-4.0, -4.0, 0.0], [4.0, -4.0, 0.0], [4.0, 4.0, 0.0], [-4.0, 4.0, 0.0]]),
    faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    colors=np.full((4, 3), (150, 140, 125), np.uint8),
)
PLACED = {"cereal_box": (-0.16, 0.06, 0.4), "bowl": (0.05, -0.05, 1.0), "sauce_bottle": (0.2, 0.02, 0.5)}
"""x, y (metres) and yaw of each object on the table."""


@dataclass(frozen=True)
class Photograph:
    """An image with its depth, and the box of what is seen of each object."""

    rgb: np.ndarray
    depth: Float32s
    boxes: dict[str, Floats]

    def frame(self) -> Frame:
        """The image as a camera would send it that does not know where it is."""
        return Frame(rgb=self.rgb, depth=self.depth, K=K, T_base_camera=None, robot_mask=None, name="test", index=0,
                     total=1)  # fmt: skip


@cache
def views() -> Views:
    """Half the views that a user would have of the three objects: they take seconds."""
    return Views.learn(OBJECTS, azimuths=3)


@cache
def photograph(*names: str) -> Photograph:
    """The named objects, each at its place on the table, with the noise of a camera."""
    renderer = Renderer(VIEW.width, VIEW.height)
    items = [Item(_TABLE, np.eye(4)), *(Item(CATALOGUE[name].mesh, upright(name, *PLACED[name])) for name in names)]
    camera = Camera(K, T_TABLE_CAMERA)
    rgb, (shown, depth) = renderer.color(items, camera), renderer.instances(items, camera)
    renderer.close()
    rng = np.random.default_rng(0)
    rgb = np.clip(rgb + rng.normal(0, 4, rgb.shape), 0, 255).astype(np.uint8)
    depth = depth + rng.normal(0, 0.001, depth.shape)
    depth = np.where((shown >= 0) & (rng.random(depth.shape) > 0.02), depth, 0).astype(np.float32)
    return Photograph(rgb, depth, {name: box_of(shown == index) for index, name in enumerate(names, 1)})
