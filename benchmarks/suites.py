"""Draws the scenes of a suite: `python -m benchmarks.suites NAME SEED... [--sheet PNG]`.

Prints how many draws were rejected, and why; the sheet has a goal and a start image per seed, as the camera sees them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

from runner.testing import run_stage
from stages.camera import SimulatedCamera
from stages.devices.suites import kinds
from stages.messages import Arrangement, Frame, LookRequest
from stages.scene.catalogue import BUILT_IN
from stages.world import World

TILE = 480, 360


def frames(suite: str, seed: int, camera: SimulatedCamera) -> list[Frame]:
    """The first look at the goal and at the start scene."""
    given = [message for kind in ("goal", "start") for message in (Arrangement(kind=kind), LookRequest(purpose=kind))]
    world = World(World.Config(suite=suite, seed=seed))
    shown = run_stage(world, given, log=lambda text, _: print(f"{suite} {seed}: {text}", flush=True))
    return run_stage(camera, shown[1::2])


def sheet(rows: list[list[Frame]]) -> Image.Image:
    """A row per seed."""
    whole = Image.new("RGB", (2 * TILE[0], len(rows) * TILE[1]))
    for y, row in enumerate(rows):
        for x, frame in enumerate(row):
            whole.paste(Image.fromarray(frame.rgb).resize(TILE, Image.Resampling.LANCZOS), (x * TILE[0], y * TILE[1]))
    return whole


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=kinds.NAMES)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--sheet", type=Path, help="PNG to write")
    options = parser.parse_args()
    camera = SimulatedCamera(SimulatedCamera.Config(catalogue=BUILT_IN))
    rows = [frames(options.suite, seed, camera) for seed in options.seeds]
    camera.close()
    if options.sheet:
        sheet(rows).quantize(128, dither=Image.Dither.NONE).save(options.sheet, optimize=True)


if __name__ == "__main__":
    main()
