"""Draws all objects of a catalogue: ``python -m stages.perception.rendering.contact_sheet CATALOGUE PNG``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.perception.rendering.renderer import Camera, Item, Lighting, Renderer
from stages.scene.catalogue import Catalogue, CatalogueObject

TILE = (230, 210)
COLUMNS = 5
_VIEW = np.array([0.75, -0.45, 0.55])
_BACKGROUND = (232, 234, 236)
_CAPTION = 34


def contact_sheet(catalogue: Catalogue) -> Image.Image:
    """One tile per object, seen from the front and above, with its name and its dimensions in millimetres."""
    renderer = Renderer(TILE[0], TILE[1] - _CAPTION)
    rows = -(-len(catalogue.objects) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * TILE[0], rows * TILE[1]), _BACKGROUND)
    for index, item in enumerate(catalogue.objects.values()):
        corner = (index % COLUMNS * TILE[0], index // COLUMNS * TILE[1])
        sheet.paste(_tile(item, renderer), corner)
    renderer.close()
    return sheet


def _tile(item: CatalogueObject, renderer: Renderer) -> Image.Image:
    tile = Image.new("RGB", TILE, _BACKGROUND)
    image = renderer.color([Item(item.mesh, np.eye(4))], _camera(item), lighting=Lighting(), background=_BACKGROUND)
    tile.paste(Image.fromarray(image))
    size = " x ".join(f"{1000 * extent:.0f}" for extent in item.dimensions)
    for line, text in enumerate((item.name, f"{size} mm")):
        place = (TILE[0] // 2, TILE[1] - _CAPTION + 4 + 13 * line)
        ImageDraw.Draw(tile).text(place, text, fill=(40, 40, 44), anchor="ma")
    return tile


def _camera(item: CatalogueObject) -> Camera:
    """Looks at the object's centre from far enough to see all of it."""
    width, height = TILE[0], TILE[1] - _CAPTION
    focal = 2.4 * height
    K = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])
    distance = 1.08 * focal / height * float(np.linalg.norm(item.dimensions))
    eye = item.bounds.mean(0) + distance * _VIEW / np.linalg.norm(_VIEW)
    return Camera(K, looking_at(eye, item.bounds.mean(0)))


def looking_at(eye: Floats, target: Floats) -> Floats:
    """T_world_camera (4 x 4) of an optical frame at ``eye`` that sees ``target`` in its middle and +z upwards."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), eye
    return T


def main(arguments: list[str]) -> int:
    """Writes the sheet of the catalogue ``arguments[0]`` to the file ``arguments[1]``."""
    if len(arguments) != 2:
        print("usage: python -m stages.perception.rendering.contact_sheet CATALOGUE PNG", file=sys.stderr)
        return 2
    try:
        contact_sheet(Catalogue.load(Path(arguments[0]))).save(arguments[1], optimize=True)
    except Refused as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
