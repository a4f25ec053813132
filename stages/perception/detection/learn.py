"""Learns a catalogue's objects from their meshes: ``python -m stages.perception.detection.learn CATALOGUE OUT``."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import torch

from runner.contract import Refused
from stages.perception.detection.views import Views
from stages.scene.catalogue import Catalogue


def main() -> int:
    """Writes the views of a catalogue to a file; 1 where the catalogue is refused."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("catalogue", type=Path, help="a BOP models folder or a catalogue YAML file")
    parser.add_argument("out", type=Path, help="safetensors file to write")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    began = time.monotonic()
    try:
        views = Views.learn(Catalogue.load(arguments.catalogue))
    except Refused as refusal:
        print(refusal, file=sys.stderr)
        return 1
    views.save(arguments.out)
    size, seconds = arguments.out.stat().st_size / 1e6, time.monotonic() - began
    print(f"{len(views.labels)} objects, {len(views.label)} views, {size:.1f} MB, {seconds:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
