"""What is on the table in a photograph: ``python examples/photograph.py DATASET SCENE OUT.jpg``.

DATASET is a folder in BOP form with boxes in ``detections_exact.json``; the first image of SCENE, a number, is read.
"""

import sys
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from stages.devices.bop import read_dataset
from stages.devices.bop_detections import read_detections
from stages.estimate import Box, EstimatedScene, estimate_scene
from stages.perception.rendering.renderer import Camera, Item, Light, Lighting, Renderer
from stages.scene.catalogue import Catalogue

HEADLIGHT = Lighting((Light("directional", (0.25, 0.4, 1.0), 2.8),), (0.45, 0.45, 0.45))
COLOURS = ((255, 176, 0), (100, 143, 255), (254, 97, 0), (120, 200, 80), (220, 80, 160))
UNKNOWN = (255, 90, 255)


def picture(rgb: np.ndarray, K: np.ndarray, models: Path, scene: EstimatedScene) -> np.ndarray:
    """The photograph with outlines and names, and beside it the estimate, rendered."""
    catalogue, seen = Catalogue.shared(models), rgb.copy()
    renderer, camera = Renderer(rgb.shape[1], rgb.shape[0]), Camera(K, np.eye(4))
    items = [Item(catalogue[each.label].mesh, each.T_camera_object) for each in scene.objects]
    texts: list[tuple[str, np.ndarray]] = []
    for region in scene.unknown:
        x0, y0, x1, y1 = map(int, region.box)
        cv2.rectangle(seen, (x0, y0), (x1, y1), UNKNOWN, 1)
        texts.append(("unknown", np.array([(x0 + x1) / 2, y1 - 8])))
    for item, each, colour in zip(items, scene.objects, cycle(COLOURS), strict=False):
        mask = renderer.depth([item], camera) > 0
        outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(seen, outline, -1, colour, 2)
        texts.append((f"{each.name} {each.probability:.2f}", np.argwhere(mask).mean(0)[::-1]))
    rendered = renderer.color(items, camera, lighting=HEADLIGHT, background=(246, 246, 248))
    renderer.close()
    return np.hstack([written(seen, texts), rendered])


def written(image: np.ndarray, texts: Sequence[tuple[str, np.ndarray]]) -> np.ndarray:
    """The image with texts about their places, as far as these are in the image."""
    written = Image.fromarray(image)
    draw, font = ImageDraw.Draw(written), ImageFont.load_default(15)
    for text, (x, y) in texts:
        left = min(max(x, draw.textlength(text, font) / 2 + 4), image.shape[1] - draw.textlength(text, font) / 2 - 4)
        draw.text((left, y), text, (255, 255, 255), font, anchor="mm", stroke_width=2, stroke_fill=(30, 30, 30))
    return np.array(written)


def main(dataset: Path, scene: int, out: Path) -> None:
    """Estimates, prints, draws."""
    (image,) = (image for image in read_dataset(dataset) if (image.scene_id, image.image_id) == (scene, 0))
    names = {item.label: name for name, item in Catalogue.shared(dataset / "models").objects.items()}
    detections = read_detections(dataset / "detections_exact.json", names)
    boxes: list[Box] = [(each.label, each.box.tolist(), each.score) for each in detections if each.scene_id == scene]
    rgb, depth = image.read()
    found = estimate_scene(rgb, depth, image.K, dataset / "models", boxes=boxes)
    for item in found.objects:
        x, y, z = 100 * item.T_camera_object[:3, 3]
        others = ", ".join(f"{other.probability:.2f}" for other in item.alternatives)
        print(f"{item.name} {item.probability:.2f} at {x:.1f}, {y:.1f}, {z:.1f} cm; other poses: {others or 'none'}")
    print(*found.relations, sep=", ")
    print(f"unknown regions: {[region.box.tolist() for region in found.unknown]}")
    small = cv2.resize(picture(rgb, image.K, dataset / "models", found), (1120, 420), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(out), small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
