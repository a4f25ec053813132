"""Generates Clutter-15: `python -m benchmarks.clutter OUT_FOLDER [--scenes 20] [--seed 0]`."""

from __future__ import annotations

import argparse
from pathlib import Path

from stages.devices.clutter import write_clutter
from stages.scene.catalogue import Catalogue

_CATALOGUE = Path(__file__).parents[1] / "stages" / "scene" / "catalogue.yaml"


def main() -> None:
    """Writes the data set; each seed gives scenes of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the data set, in BOP form")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    write_clutter(options.out, Catalogue.load(_CATALOGUE), scenes=options.scenes, seed=options.seed)
    print(f"{options.scenes} scenes in {options.out}")


if __name__ == "__main__":
    main()
