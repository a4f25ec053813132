"""What went wrong, object by object: `python -m benchmarks.failures DATASET CSV OUT.png`.

A row for each object that is not within 2 cm and 15 degrees, without any symmetry where the data set knows how the
label faces: what was observed, the estimate and the truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image as Picture
from PIL import ImageDraw

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, detections_file, images
from benchmarks.comparison.accuracy import Score, described, failed, score
from stages.devices.bop_results import Result, read_results
from stages.geometry.arrays import Floats
from stages.perception.rendering.renderer import Camera, Item, Light, Lighting, Renderer
from stages.scene.catalogue import Catalogue

_TILE = 240
_CAPTION = 34
_GAP = 6
_COLUMNS = 2
"""Failures side by side."""
_LEAST = 90
"""Pixels of the image that a tile shows at least."""
_PAPER = (246, 246, 248)
_INK = (40, 40, 46)
_WRONG, _RIGHT = (213, 94, 0), (0, 114, 178)
"""Outlines of estimate and truth; distinct for any colour vision."""
_HEADLIGHT = Lighting((Light("directional", (0.25, 0.4, 1.0), 2.8),), (0.45, 0.45, 0.45))
"""Shines from the camera into the scene."""


class Sheet:
    """Draws failures of a data set."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._items = {item.label: item for item in catalogue.objects.values()}
        self._renderers: dict[tuple[int, int], Renderer] = {}

    def draw(self, failures: Sequence[tuple[Image, Score]], results: Sequence[Result]) -> Picture.Image:
        """All failures; ``results`` are drawn around the one in question."""
        columns = min(_COLUMNS, max(1, len(failures)))
        rows = -(-len(failures) // columns)
        width, height = 3 * (_TILE + _GAP) + _GAP, _TILE + _CAPTION + _GAP
        sheet = Picture.new("RGB", (columns * width, max(1, rows) * height), _PAPER)
        for number, (image, one) in enumerate(failures):
            corner = number % columns * width, number // columns * height
            sheet.paste(self._row(image, one, results, (width, height)), corner)
        return sheet

    def _row(self, image: Image, one: Score, results: Sequence[Result], size: tuple[int, int]) -> Picture.Image:
        row = Picture.new("RGB", size, _PAPER)
        draw = ImageDraw.Draw(row)
        name = self._items[one.truth.label].name
        draw.text((_GAP, _GAP), f"{image.id[0]}/{image.id[1]} {name}: {described(one)}", fill=_INK)
        for column, (title, picture) in enumerate(self._pictures(image, one, results)):
            x = _GAP + column * (_TILE + _GAP)
            draw.text((x, _GAP + 14), title, fill=(110, 110, 118))
            row.paste(picture, (x, _CAPTION))
        return row

    def _pictures(self, image: Image, one: Score, results: Sequence[Result]) -> list[tuple[str, Picture.Image]]:
        """Observation, estimate and truth, cut out around the object."""
        mine = [result for result in results if (result.scene_id, result.image_id) == image.id]
        estimated = [(result.label, result.T_camera_object) for result in mine]
        truths = [(truth.label, truth.T_camera_object) for truth in image.truths]
        window = self._window(image, one)
        seen = image.rgb.copy()
        estimate = self._rendered(image, estimated)
        truth = self._rendered(image, truths)
        for picture in (seen, estimate, truth):
            self._outline(picture, image, (one.truth.label, one.truth.T_camera_object), _RIGHT)
            if one.result is not None:
                self._outline(picture, image, (one.result.label, one.result.T_camera_object), _WRONG)
        return [(title, _cut(picture, window)) for title, picture in
                (("observed", seen), ("estimate (orange)", estimate), ("truth (blue)", truth))]  # fmt: skip

    def _rendered(self, image: Image, placed: Sequence[tuple[int, Floats]]) -> np.ndarray:
        items = [Item(self._items[label].mesh, T) for label, T in placed]
        return self._of(image).color(items, _camera(image), lighting=_HEADLIGHT, background=_PAPER).copy()

    def _outline(
        self, picture: np.ndarray, image: Image, placed: tuple[int, Floats], color: tuple[int, int, int]
    ) -> None:
        """The silhouette's border, painted into the picture."""
        label, T = placed
        mask = self._of(image).depth([Item(self._items[label].mesh, T)], _camera(image)) > 0
        inner = mask.copy()
        for axis in (0, 1):
            for shift in (-1, 1):
                inner &= np.roll(mask, shift, axis)
        picture[mask & ~inner] = color

    def _window(self, image: Image, one: Score) -> tuple[int, int, int, int]:
        """A square around truth and estimate: x0, y0, x1, y1."""
        poses = [one.truth.T_camera_object, *([] if one.result is None else [one.result.T_camera_object])]
        vertices = self._items[one.truth.label].mesh.vertices
        pixels = np.concatenate([_projected(vertices @ T[:3, :3].T + T[:3, 3], image.K) for T in poses])
        middle = (pixels.min(0) + pixels.max(0)) / 2
        half = min(max(_LEAST, 1.4 * float(np.ptp(pixels, axis=0).max())), 480.0) / 2
        x0, y0 = np.round(middle - half).astype(int)
        return int(x0), int(y0), int(x0 + 2 * half), int(y0 + 2 * half)

    def _of(self, image: Image) -> Renderer:
        """A renderer of the image's size; a data set has few sizes."""
        height, width = image.depth.shape
        if (width, height) not in self._renderers:
            self._renderers[width, height] = Renderer(width, height)
        return self._renderers[width, height]


def _camera(image: Image) -> Camera:
    return Camera(image.K, np.eye(4))


def _projected(points: Floats, K: Floats) -> Floats:
    return (points @ K.T)[:, :2] / np.maximum(points[:, 2:], 1e-3)


def _cut(picture: np.ndarray, window: tuple[int, int, int, int]) -> Picture.Image:
    return Picture.fromarray(picture).crop(window).resize((_TILE, _TILE), Picture.Resampling.LANCZOS)


def sheet(dataset: Path, csv: Path) -> tuple[Picture.Image, int]:
    """The picture and how many failures it shows."""
    catalogue, results = Catalogue.load(dataset / "models"), read_results(csv)
    covered = {(result.scene_id, result.image_id) for result in results}
    chosen = [image for image in images(dataset, detections_file(dataset, "exact")) if image.id in covered]
    by_id = {image.id: image for image in chosen}
    scores = score([truth for image in chosen for truth in image.truths], results, catalogue)
    wrong = [(by_id[one.truth.image], one) for one in failed(scores)]
    return Sheet(catalogue).draw(wrong, results), len(wrong)


@command
def main() -> int:
    """Draws the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="BOP data set folder")
    parser.add_argument("csv", type=Path, help="results in BOP format")
    parser.add_argument("out", type=Path, help="PNG")
    options = parser.parse_args()
    picture, count = sheet(options.dataset, options.csv)
    picture.save(options.out)
    print(f"{count} objects are not within 2 cm and 15 degrees: {options.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
