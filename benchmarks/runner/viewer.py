"""Whether watching slows the graph: `python -m benchmarks.viewer DATASET [--rounds 3]`.

Runs ``graphs/bop.yaml`` over a data set, without and with ``--view`` in turns, and prints the ratio of the medians of
the time from its first image to its last. Start-up, which loads the viewer beside everything else, is not counted.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from stages.devices.bop_results import read_results

_GRAPH = Path(__file__).parents[2] / "graphs" / "bop.yaml"


def seconds(dataset: Path, folder: Path, settings: Sequence[str], *, view: bool) -> float:
    """Wall time from the first image of a run to its last."""
    out = folder / "results.csv"
    assignments = (f"camera.dataset={dataset}", f"detector.detections={dataset}/detections_exact.json",
                   f"results.path={out}", *settings)  # fmt: skip
    command = [sys.executable, "-m", "runner.cli", "up", str(_GRAPH), *(["--view"] if view else [])]
    command += [part for item in assignments for part in ("--set", item)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder)
    # Every object of an image carries the image's time; the first image, whose time is not known, has -1.
    times = {(result.scene_id, result.image_id): result.seconds for result in read_results(out)}
    return sum(time for time in times.values() if time > 0)


def main() -> None:
    """Prints seconds per run and the ratio of the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="BOP data set folder")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE")
    options = parser.parse_args()
    found: dict[bool, list[float]] = {False: [], True: []}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(2 * options.rounds):
            # Every second pair begins with the other one, so that a drift of the machine's speed favours neither.
            view = (number % 2 == 1) != (number // 2 % 2 == 1)
            found[view].append(seconds(options.dataset.resolve(), Path(folder), options.set, view=view))
            print(f"{'with' if view else 'without'} the viewer: {found[view][-1]:6.2f} s", flush=True)
    print(f"ratio of medians {median(found[True]) / median(found[False]):.3f}")


if __name__ == "__main__":
    main()
