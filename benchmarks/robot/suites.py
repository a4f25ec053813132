"""Draws the scenes of a suite: `python -m benchmarks.suites NAME SEED... [--sheet PNG]`.

Prints how many draws were rejected, and why, for each scene and for all; the sheet has a goal and a start image per
seed, as the camera sees them.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from PIL import Image

from runner.graph.reading import load_graph
from runner.testing import run_stage
from stages.camera import SimulatedCamera
from stages.devices.suites import kinds
from stages.messages import Arrangement, Frame, LookRequest, Snapshot
from stages.scene.catalogue import BUILT_IN
from stages.world import World

ROOT = Path(__file__).parents[2]
TILE = 480, 360


def looks(suite: str, seeds: Sequence[int], said: list[str] | None = None) -> Iterator[tuple[int, Snapshot, Frame]]:
    """The first look at the goal and at the start scene of each seed, with the truth; ``said`` gets what is printed."""
    camera = SimulatedCamera(SimulatedCamera.Config(catalogue=BUILT_IN))
    asked = [message for kind in ("goal", "start") for message in (Arrangement(kind=kind), LookRequest(purpose=kind))]
    for seed in seeds:
        told = partial(_say, f"{suite} {seed}", [] if said is None else said)
        shown = run_stage(World(world_config(suite, seed)), asked, log=told)
        for snapshot in shown[1::2]:
            assert isinstance(snapshot, Snapshot)
            (frame,) = run_stage(camera, [snapshot])
            assert isinstance(frame, Frame)
            yield seed, snapshot, frame
    camera.close()


def world_config(suite: str, seed: int) -> World.Config:
    """The world of the default graph."""
    return load_graph(ROOT / "graph.yaml", (f"world.suite={suite}", f"world.seed={seed}")).nodes["world"].config


def _say(name: str, said: list[str], text: str, level: str) -> None:
    print(f"{name}: {text}", flush=True)
    said.append(text)


def rejections(said: Sequence[str]) -> str:
    """What share of all draws was rejected, and why, of the lines that say what was laid out."""
    why: Counter[str] = Counter()
    for line in said:
        if found := re.search(r"draws rejected: (.*)", line):
            why.update({reason: int(count) for reason, count in re.findall(r"([^,]+?) (\d+)(?:, |$)", found[1])})
    draws = why.total() + sum("scene laid out" in line for line in said)
    because = ", ".join(f"{reason} {count}" for reason, count in why.most_common())
    share = f"{why.total()} of {draws} draws rejected, {why.total() / draws:.0%}"
    return f"{share}: {because}" if because else share


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
    said: list[str] = []
    frames = [frame for _, _, frame in looks(options.suite, options.seeds, said)]
    print(rejections(said))
    rows = [frames[k : k + 2] for k in range(0, len(frames), 2)]
    if options.sheet:
        sheet(rows).quantize(128, dither=Image.Dither.NONE).save(options.sheet, optimize=True)


if __name__ == "__main__":
    main()
