"""What the camera saw of episodes: `python -m benchmarks.pictures RECORDING... --out SHEET.webp`.

Draws a row for each recording: the goal as it was shown, the start, the look in the middle, and the end.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw

from runner.graph.reading import graph_from_json
from runner.message.codec import open_envelope
from runner.recording.recording import Recording
from stages.messages import Frame
from stages.messages.arrays import Rgb

_WIDTH = 320
"""Of one picture, pixels."""
QUALITY = 80


def main() -> None:
    """Writes the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rows = [[(f"{_scene(path)}: {when}", rgb) for when, rgb in views(path).items()] for path in options.recordings]
    sheet(rows).save(options.out, quality=QUALITY)


def _scene(path: Path) -> str:
    world = graph_from_json(Recording(path).run["graph"], str(path)).nodes["world"].config
    return f"{world.suite} {world.seed}"


def views(path: Path) -> dict[str, Rgb]:
    """What the camera saw of the goal, of the start, in the middle and at the end, H x W x 3 each."""
    corrected = (each for each in Recording(path).envelopes() if each.id.startswith("corrector.frame#"))
    frames = [open_envelope(Frame, envelope) for envelope in corrected]
    later = [frame for frame in frames if not frame.name.startswith("goal")]
    shown = {"goal": frames[0], "start": later[0], "middle": later[len(later) // 2], "end": later[-1]}
    return {when: frame.rgb for when, frame in shown.items()}


def sheet(rows: Sequence[Sequence[tuple[str, Rgb]]]) -> Image.Image:
    """Titled pictures of one size, in rows of one length."""
    height, width = rows[0][0][1].shape[:2]
    size = _WIDTH, _WIDTH * height // width
    found = Image.new("RGB", (len(rows[0]) * size[0], len(rows) * size[1]))
    draw = ImageDraw.Draw(found)
    for i, row in enumerate(rows):
        for j, (title, rgb) in enumerate(row):
            corner = j * size[0], i * size[1]
            found.paste(Image.fromarray(rgb).resize(size, Image.Resampling.LANCZOS), corner)
            draw.text((corner[0] + 6, corner[1] + 4), title, fill="white", stroke_width=2, stroke_fill="black")
    return found


if __name__ == "__main__":
    main()
