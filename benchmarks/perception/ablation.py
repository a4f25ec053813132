"""What each improvement over the paper is worth: `python -m benchmarks.ablation DATASET[:DOF]...`.

Exact boxes. Every variant sees the same images and random numbers, so the difference to the default is a paired one;
its interval is a bootstrap over images, because the objects of an image are not independent of one another.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.common.command import command
from benchmarks.common.datasets import detections_file, images
from benchmarks.comparison.accuracy import Score, score
from benchmarks.comparison.estimate import Settings, estimates, results
from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.perception.filter.settings import IMPROVEMENTS
from stages.scene.catalogue import Catalogue

_BOUNDS = ((0.01, 10.0), (0.02, 15.0))
"""Metres and degrees."""
_RESAMPLES = 10_000
_Z = 1.959964
DEFAULT, PAPER = "default", "the paper's plain form"


@dataclass(frozen=True)
class Source:
    """A data set and how its objects lie."""

    folder: Path
    dof: Literal[3, 6] = 6

    @staticmethod
    def parsed(text: str) -> Source:
        """``FOLDER`` or ``FOLDER:3`` for upright objects.

        Raises:
            Refused: the number after the colon is neither 3 nor 6.
        """
        folder, colon, dof = text.rpartition(":")
        if colon and dof not in ("3", "6"):
            raise Refused(f"'{text}': '{dof}' degrees of freedom; choose 3 or 6")
        return Source(Path(folder), 3 if dof == "3" else 6) if colon else Source(Path(text))


@dataclass(frozen=True)
class Outcome:
    """How one variant did, image by image."""

    name: str
    scores: tuple[tuple[Score, ...], ...]
    cpu_seconds: float

    @property
    def objects(self) -> int:
        return sum(len(image) for image in self.scores)

    def hits(self, metres: float, degrees: float) -> Floats:
        """Objects within the bounds in each image."""
        return np.array([sum(one.within(metres, degrees) for one in image) for image in self.scores], float)

    def medians(self) -> tuple[float, float]:
        """Median position and rotation error, metres and radians; objects that were not found count as infinite."""
        flat = [one for image in self.scores for one in image]
        return float(np.median([one.metres for one in flat])), float(np.median([one.radians for one in flat]))


def wilson(hits: float, count: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson, 1927)."""
    share, spread = hits / count, _Z**2 / count
    half = _Z * np.sqrt(share * (1 - share) / count + spread / (4 * count))
    middle = share + spread / 2
    return float((middle - half) / (1 + spread)), float((middle + half) / (1 + spread))


def difference(hits: Floats, reference: Floats, objects: Floats, *, seed: int = 0) -> tuple[float, float, float]:
    """Difference of two shares and its 95 % interval: a bootstrap over images, both variants resampled together.

    All arrays have one number per image.
    """
    drawn = np.random.default_rng(seed).integers(len(objects), size=(_RESAMPLES, len(objects)))
    resampled = (hits - reference)[drawn].sum(1) / objects[drawn].sum(1)
    low, high = np.percentile(resampled, [2.5, 97.5])
    return float((hits - reference).sum() / objects.sum()), float(low), float(high)


def variant(name: str) -> Settings:
    """The settings of a row of the table."""
    if name == DEFAULT:
        return Settings()
    return Settings(form="paper") if name == PAPER else Settings(without=(name,))


def run(name: str, sources: Sequence[Source], *, limit: int | None, processes: int) -> Outcome:
    """Estimates and scores all images of all sources with one variant."""
    settings = replace(variant(name), processes=processes)
    scored: list[tuple[Score, ...]] = []
    seconds = 0.0
    for source in sources:
        catalogue = Catalogue.load(source.folder / "models")
        chosen = list(images(source.folder, detections_file(source.folder, "exact"), limit))
        done = estimates(source.folder, chosen, replace(settings, dof=source.dof))
        for image, found in zip(chosen, done, strict=True):
            scored.append(tuple(score(list(image.truths), results(found, catalogue), catalogue)))
            seconds += found.cpu_seconds
    return Outcome(name, tuple(scored), seconds)


def row(outcome: Outcome, default: Outcome) -> str:
    """A line of the table."""
    objects = np.array([len(image) for image in outcome.scores], float)
    cells = [f"{outcome.name:24s}"]
    for metres, degrees in _BOUNDS:
        hits = outcome.hits(metres, degrees)
        low, high = wilson(float(hits.sum()), outcome.objects)
        cells.append(f"{100 * hits.sum() / outcome.objects:5.1f} [{100 * low:5.1f}, {100 * high:5.1f}]")
        change = difference(hits, default.hits(metres, degrees), objects)
        cells.append("" if outcome is default else "{:+5.1f} [{:+5.1f}, {:+5.1f}]".format(*(100 * x for x in change)))
    metres, radians = outcome.medians()
    cells += [f"{1000 * metres:5.2f} mm {np.rad2deg(radians):5.2f}", f"{outcome.cpu_seconds / outcome.objects:6.2f}"]
    return "| " + " | ".join(f"{cell:20s}" for cell in cells) + " |"


def heading(objects: int) -> str:
    """The head of the table."""
    titles = ["without"]
    for metres, degrees in _BOUNDS:
        titles += [f"{100 * metres:.0f} cm, {degrees:.0f} deg, %", "difference"]
    titles += ["median, degrees", "CPU s an object"]
    line = "| " + " | ".join(f"{title:{24 if title == 'without' else 20}s}" for title in titles) + " |"
    return f"{objects} objects, 95 % intervals in brackets\n\n{line}\n|" + "---|" * len(titles)


@command
def main() -> int:
    """Prints the table."""
    options = _options()
    sources = [Source.parsed(text) for text in options.datasets]
    default = run(DEFAULT, sources, limit=options.images, processes=options.processes)
    print(heading(default.objects), row(default, default), sep="\n", flush=True)
    for name in chosen(options.only):
        print(row(run(name, sources, limit=options.images, processes=options.processes), default), flush=True)
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", metavar="DATASET[:DOF]", help="BOP folders; :3 for upright objects")
    parser.add_argument("--images", type=int, default=None, help="only the first N images of each data set")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="only these variants")
    parser.add_argument("--processes", type=int, default=2)
    return parser.parse_args()


def chosen(only: Sequence[str]) -> tuple[str, ...]:
    """The variants beside the default.

    Raises:
        Refused: a name is no variant; names those that are.
    """
    known = (*IMPROVEMENTS, PAPER)
    for name in only:
        if name not in known:
            raise Refused(f"--only {name}: no such variant; choose {', '.join(known)}")
    return tuple(name for name in known if not only or name in only)


if __name__ == "__main__":
    raise SystemExit(main())
