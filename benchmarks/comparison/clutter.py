"""Generates Clutter-15: `python -m benchmarks.clutter OUT_FOLDER [--scenes 20] [--seed 0] [--sheet PNG]`."""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

from stages.devices.bop import read_dataset
from stages.devices.clutter import SIZE, write_clutter
from stages.scene.catalogue import Catalogue

_CATALOGUE = Path(__file__).parents[2] / "stages" / "scene" / "catalogue.yaml"
_COLUMNS, _GAP = 5, 4
_CROP = 340, 260
"""Pixels in the middle of each image; the camera looks at the pile."""
_TILE = 255, 195


def sheet(dataset: Path) -> Image.Image:
    """The middle of every colour image, side by side."""
    pictures = [Image.fromarray(image.read()[0]) for image in read_dataset(dataset)]
    rows = -(-len(pictures) // _COLUMNS)
    size = _COLUMNS * (_TILE[0] + _GAP) - _GAP, rows * (_TILE[1] + _GAP) - _GAP
    whole = Image.new("RGB", size, (255, 255, 255))
    x, y = (SIZE[0] - _CROP[0]) // 2, (SIZE[1] - _CROP[1]) // 2
    for number, picture in enumerate(pictures):
        tile = picture.crop((x, y, x + _CROP[0], y + _CROP[1])).resize(_TILE, Image.Resampling.LANCZOS)
        whole.paste(tile, (number % _COLUMNS * (_TILE[0] + _GAP), number // _COLUMNS * (_TILE[1] + _GAP)))
    return whole


def main() -> None:
    """Writes the data set; each seed gives scenes of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the data set, in BOP form")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sheet", type=Path, default=None, help="draws all images on one sheet, PNG")
    options = parser.parse_args()
    write_clutter(options.out, Catalogue.load(_CATALOGUE), scenes=options.scenes, seed=options.seed)
    if options.sheet:
        sheet(options.out).quantize(128, dither=Image.Dither.NONE).save(options.sheet, optimize=True)
    print(f"{options.scenes} scenes in {options.out}")


if __name__ == "__main__":
    main()
