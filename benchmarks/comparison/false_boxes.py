"""Accuracy against the number of false boxes an image: `python -m benchmarks.false_boxes DATASET`.

The paper's figure 7 shows that scenes survive false detections; this counts how many. Every image keeps its exact
boxes and gets up to eight false ones: every second lies on a true object and has another label, the others lie
anywhere. All confidences come from one distribution, so that a box's own says nothing. The number of objects is known.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, ImageId, detections_file, images, parse_wanted
from benchmarks.comparison.accuracy import interval
from benchmarks.comparison.compare import TITLES, parse_methods, run
from benchmarks.comparison.figures import Scored, line_style, sheet, tidy
from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.scene.catalogue import Catalogue

_MOST = 8
_SHIFT = 0.1
"""Of a box's size: how far a false box on an object is off it."""


@dataclass(frozen=True)
class Box:
    """One detection."""

    image: ImageId
    label: int
    """BOP's obj_id."""
    box: Floats
    """x0, y0, x1, y1 in pixels."""
    confidence: float

    def entry(self) -> dict[str, Any]:
        """As BOP's detection files have it."""
        x0, y0, x1, y1 = self.box.tolist()
        return {
            "scene_id": self.image[0], "image_id": self.image[1], "category_id": self.label,
            "bbox": [x0, y0, x1 - x0, y1 - y0], "score": self.confidence, "time": 0.0,
        }  # fmt: skip


def boxes(image: Image, catalogue: Catalogue, count: int, seed: int) -> list[Box]:
    """The exact boxes of an image and ``count`` false ones; those of a smaller count are among them."""
    rng = np.random.default_rng([seed, *image.id])
    true = [np.asarray(candidate.box) for candidate in image.boxes]
    labels = [catalogue[candidate.label].label for candidate in image.boxes]
    absent = sorted({item.label for item in catalogue.objects.values()} - set(labels))
    sure = rng.uniform(0.5, 1.0, len(true) + _MOST)
    size = image.depth.shape[::-1]
    wrong = [_false(true, size, on_object=i % 2 == 0, rng=rng) for i in range(_MOST)][:count]
    labels += rng.choice(absent, _MOST).tolist()[:count]
    return [Box(image.id, label, box, float(confidence))
            for label, box, confidence in zip(labels, [*true, *wrong], sure, strict=False)]  # fmt: skip


def _false(true: Sequence[Floats], size: tuple[int, int], *, on_object: bool, rng: np.random.Generator) -> Floats:
    """A box that frames nothing of its label, within an image of ``size`` (width, height)."""
    box = true[int(rng.integers(len(true)))]
    extent = box[2:] - box[:2]
    corner = box[:2] + rng.uniform(-_SHIFT, _SHIFT, 2) * extent
    if not on_object:
        corner = rng.uniform(0, np.maximum(np.array(size) - extent, 1))
    return np.clip(np.concatenate([corner, corner + extent]), 0, np.tile(size, 2))


@dataclass(frozen=True)
class Row:
    """One method over all counts of false boxes."""

    title: str
    right: Sequence[int]
    """Objects within 2 cm and 15 degrees."""
    objects: int

    def line(self) -> str:
        """Of the table."""
        return f"| {self.title} | " + " | ".join(f"{100 * each / self.objects:.1f}" for each in self.right) + " |"


@command
def main() -> int:
    """Runs, draws and prints; exits 1 where a method fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="BOP data set folder with detections_exact.json")
    parser.add_argument("--counts", default="0,2,4,8", help="false boxes an image")
    parser.add_argument("--methods", default="digest,paper,icp,ppf,perch")
    parser.add_argument("--dof", type=int, choices=(3, 6), default=6)
    parser.add_argument("--images", default=None, help="the first N, or ids such as 1/0,2/0")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=None, help="by default comparisons/DATASET-false-boxes")
    parser.add_argument("--keep", action="store_true", help="takes the results that are there already")
    return _run(parser.parse_args())


def _run(options: argparse.Namespace) -> int:
    counts, methods = _counts(options.counts), parse_methods(options.methods)
    exact = detections_file(options.dataset, "exact")
    chosen = list(images(options.dataset, exact, parse_wanted(options.images)))
    name = options.dataset.resolve().name
    folder: Path = options.out or Path("comparisons") / f"{name}-false-boxes"
    folder.mkdir(parents=True, exist_ok=True)
    catalogue = Catalogue.load(options.dataset / "models")
    right: dict[str, list[int]] = {method: [] for method in methods}
    for count in counts:
        detections = folder / f"detections_{count}.json"
        found = [box.entry() for image in chosen for box in boxes(image, catalogue, count, options.seed)]
        detections.write_text(json.dumps(found, indent=1) + "\n")
        options.detections = str(detections)
        files = {method: folder / f"{method}-{count}.csv" for method in methods}
        for method, out in files.items():
            if not (options.keep and out.exists()) and not run(method, options, out):
                return 1
        for method, scores in Scored.of(options.dataset, chosen, files).methods.items():
            right[method].append(sum(one.within(0.02, 15) for one in scores))
    objects = sum(image.n_objects for image in chosen)
    rows = [Row(TITLES[method], right[method], objects) for method in methods]
    draw(folder / "accuracy.png", f"{name}: {objects} objects in {len(chosen)} images", counts, rows)
    print(table(counts, rows))
    return 0


def _counts(text: str) -> list[int]:
    parts = text.split(",")
    for part in parts:
        if not (part.isdecimal() and int(part) <= _MOST):
            raise Refused(f"--counts: '{part}' is no whole number from 0 to {_MOST}")
    return [int(part) for part in parts]


def table(counts: Sequence[int], rows: Sequence[Row]) -> str:
    """Per cent of the objects within 2 cm and 15 degrees."""
    head = "| false boxes an image | " + " | ".join(map(str, counts)) + " |"
    return "\n".join([head, "|---" * (len(counts) + 1) + "|", *(row.line() for row in rows)])


def draw(path: Path, title: str, counts: Sequence[int], rows: Sequence[Row]) -> None:
    """A line for each method; the first one's 95 % interval is shaded."""
    figure = sheet(7.0, 4.6)
    panel: Any = figure.subplots()
    for number, row in enumerate(rows):
        style = line_style(number)
        if number == 0:
            band = 100 * np.array([interval(each, row.objects) for each in row.right])
            panel.fill_between(counts, band[:, 0], band[:, 1], color=style["color"], alpha=0.13, linewidth=0)
        panel.plot(counts, [100 * each / row.objects for each in row.right], label=row.title, marker="o", **style)
    tidy(panel)
    panel.set_xticks(counts)
    panel.set_xlabel("false boxes an image", color="#444444")
    panel.set_ylabel("within 2 cm and 15 degrees, % of objects", color="#444444")
    panel.set_title(title, loc="left", color="#222222")
    panel.legend(frameon=False)
    figure.savefig(path, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    raise SystemExit(main())
