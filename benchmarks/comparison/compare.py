"""All methods on the same images and boxes: `python -m benchmarks.compare DATASET --methods digest,icp`.

Writes results (CSV), the figure (PNG) and the table (Markdown) of every method into one folder.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.common.command import command as refusing
from benchmarks.common.datasets import detections_file, images, parse_wanted
from benchmarks.comparison.figures import Scored, behind, draw, markdown
from runner.contract import Refused
from runner.process.children import ENVIRONMENT

TITLES = {
    "digest": "DIGEST",
    "depth": "DIGEST without colour",
    "paper": "DIGEST as in the paper",
    "icp": "multi-start ICP",
    "fpfh": "FPFH + RANSAC + ICP",
    "ppf": "PPF",
    "perch": "PERCH-style search",
    "random": "random guess",
}
_DIGEST: dict[str, list[str]] = {"digest": [], "depth": ["--without", "colour"], "paper": ["--form", "paper"]}
"""Options of the estimator by method."""


def command(method: str, options: argparse.Namespace, out: Path) -> list[str]:
    """What runs one method; DIGEST as its graph would, its replicas dividing the hypotheses of each image."""
    run = [sys.executable, "-m"]
    if method in _DIGEST:
        share = ["--share", "hypotheses", "--processes", str(options.processes)]
        run += [
            "benchmarks.comparison.estimate",
            str(options.dataset),
            options.detections,
            str(out),
            *_DIGEST[method],
            *share,
        ]
    else:
        run += ["benchmarks.comparison.baselines", method, str(options.dataset), options.detections, str(out)]
    images_wanted = ["--images", options.images] if options.images else []
    return [*run, "--dof", str(options.dof), *images_wanted]


@refusing
def main() -> int:
    """Runs, draws and prints; exits 1 where a method fails."""
    options = _options()
    return _compare(parse_methods(options.methods), options)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="BOP data set folder")
    parser.add_argument("--detections", default="exact", help="exact, noisy or a file of detections")
    parser.add_argument("--methods", default=",".join(TITLES))
    parser.add_argument("--dof", type=int, choices=(3, 6), default=6)
    parser.add_argument("--images", default=None, help="the first N, or ids such as 1/0,2/0")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=None, help="by default comparisons/DATASET-DETECTIONS")
    parser.add_argument("--keep", action="store_true", help="takes the results that are there already")
    return parser.parse_args()


def parse_methods(text: str) -> list[str]:
    """The option ``--methods``.

    Raises:
        Refused: there is no method of that name.
    """
    methods = text.split(",")
    for method in methods:
        if method not in TITLES:
            raise Refused(f"--methods: '{method}' is none of {', '.join(TITLES)}")
    return methods


def _compare(methods: Sequence[str], options: argparse.Namespace) -> int:
    boxes = detections_file(options.dataset, options.detections)
    chosen = list(images(options.dataset, boxes, parse_wanted(options.images)))
    name = options.dataset.resolve().name
    folder: Path = options.out or Path("comparisons") / f"{name}-{boxes.stem.removeprefix('detections_')}"
    folder.mkdir(parents=True, exist_ok=True)
    files = {method: folder / f"{method}.csv" for method in methods}
    for method, out in files.items():
        if not (options.keep and out.exists()) and not run(method, options, out):
            return 1
    scored = Scored.of(options.dataset, chosen, {TITLES[method]: out for method, out in files.items()})
    kind = boxes.stem.removeprefix("detections_")
    objects = sum(image.n_objects for image in chosen)
    draw(folder / "accuracy.png", f"{name}, {kind} boxes: {objects} objects in {len(chosen)} images", scored.methods)
    text = f"{markdown(scored)}\n\n{behind(scored.methods)}"
    (folder / "accuracy.md").write_text(text + "\n")
    print(text)
    return 0


def run(method: str, options: argparse.Namespace, out: Path) -> bool:
    """Whether a method has written its results."""
    print(f"{TITLES[method]} ...", file=sys.stderr, flush=True)
    done = subprocess.run(
        command(method, options, out), env={**os.environ, **ENVIRONMENT}, stdout=subprocess.DEVNULL, check=False
    )
    if done.returncode:
        print(f"{TITLES[method]} failed with exit code {done.returncode}", file=sys.stderr)
    return done.returncode == 0


if __name__ == "__main__":
    raise SystemExit(main())
