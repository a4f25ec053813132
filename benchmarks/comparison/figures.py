"""The figures of the paper: `python -m benchmarks.figures OUT.png DATASET NAME=CSV ...`.

Accuracy against the allowed rotation error, one panel for each position bound.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, Truth, detections_file, images
from benchmarks.comparison.accuracy import BOUNDS, Score, interval, recalls, right_sets, score
from runner.contract import Refused
from stages.devices.bop_results import Result, read_results
from stages.geometry.arrays import Floats
from stages.scene.catalogue import Catalogue

POSITION_BOUNDS = (0.01, 0.05, 0.10, 0.20)
"""Metres: one panel each, as in the paper."""
_DEGREES = np.unique(np.concatenate([np.linspace(0, 15, 121), np.linspace(15, 180, 331)]))
_TICKS = (0, 5, 15, 45, 90, 180)
# Okabe and Ito's palette, which people with any colour vision can tell apart; line styles differ as well.
_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#0072B2", "linewidth": 2.6},
    {"color": "#56B4E9", "linestyle": (0, (5, 1.5))},
    {"color": "#D55E00", "linestyle": (0, (4, 1, 1, 1))},
    {"color": "#009E73", "linestyle": (0, (1, 1))},
    {"color": "#CC79A7", "linestyle": (0, (3, 1, 1, 1, 1, 1))},
    {"color": "#E69F00", "linestyle": (0, (2, 1.5))},
    {"color": "#555555", "linestyle": (0, (1, 2.5))},
    {"color": "#8B6F00", "linestyle": (0, (7, 2))},
)


def sheet(width: float, height: float) -> Any:
    """An empty figure of matplotlib's, inches.

    Raises:
        Refused: matplotlib is missing. It is an optional extra; tables work without it.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise Refused("figures need matplotlib; pip install -e '.[benchmarks]'") from None
    figure: Any = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def draw(path: Path, title: str, methods: Mapping[str, Sequence[Score]]) -> None:
    """One panel for each position bound, one line for each method; the first method's 95 % interval is shaded."""
    figure = sheet(10.0, 7.6)
    panels: Any = figure.subplots(2, 2, sharex=True, sharey=True)
    for panel, metres in zip(panels.flat, POSITION_BOUNDS, strict=True):
        _panel(panel, metres, methods)
    figure.suptitle(title, fontsize=14, fontweight="bold", color="#222222")
    for panel in panels[-1]:
        panel.set_xlabel("allowed rotation error, degrees (square-root scale)", fontsize=10, color="#444444")
    for panel in panels[:, 0]:
        panel.set_ylabel("accuracy, % of objects", fontsize=10, color="#444444")
    handles, labels = panels.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=11, handlelength=3.2)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _panel(panel: Any, metres: float, methods: Mapping[str, Sequence[Score]]) -> None:
    panel.set_xscale("function", functions=(np.sqrt, np.square))
    for number, (name, scores) in enumerate(methods.items()):
        style = line_style(number)
        hits = np.array([sum(one.within(metres, degrees) for one in scores) for degrees in _DEGREES])
        if number == 0:
            panel.fill_between(_DEGREES, *_band(hits, len(scores)), color=style["color"], alpha=0.13, linewidth=0)
        panel.plot(_DEGREES, 100 * hits / max(1, len(scores)), label=name, zorder=10 - number, **style)
    panel.set_title(f"position within {100 * metres:.0f} cm", loc="left", fontsize=11, color="#222222")
    panel.set_xticks(_TICKS, [str(tick) for tick in _TICKS])
    panel.set_xlim(0, 180)
    tidy(panel)


def tidy(panel: Any) -> None:
    """Per cent upwards, a light grid, no frame."""
    panel.set_ylim(0, 102)
    panel.set_yticks(range(0, 101, 20))
    panel.grid(color="#DDDDDD", linewidth=0.8)
    panel.set_axisbelow(True)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        panel.spines[side].set_color("#999999")
    panel.tick_params(colors="#444444", length=3)


def line_style(number: int) -> dict[str, Any]:
    """Of the method of that number."""
    return {"linewidth": 1.9, **_STYLES[number % len(_STYLES)]}


def _band(hits: Iterable[Any], count: int) -> tuple[Floats, Floats]:
    bounds = 100 * np.array([interval(int(each), count) for each in hits])
    return bounds[:, 0], bounds[:, 1]


@dataclass(frozen=True)
class Scored:
    """The results of several methods on the same images, and their scores."""

    truths: Sequence[Truth]
    results: Mapping[str, Sequence[Result]]
    methods: Mapping[str, Sequence[Score]]

    @staticmethod
    def of(dataset: Path, chosen: Sequence[Image], files: Mapping[str, Path]) -> Scored:
        """Reads and scores result files, by name."""
        catalogue = Catalogue.load(dataset / "models")
        truths = [truth for image in chosen for truth in image.truths]
        views = {image.id: (image.depth, image.K) for image in chosen}
        results = {
            name: [one for one in read_results(path) if (one.scene_id, one.image_id) in views]
            for name, path in files.items()
        }
        methods = {name: score(truths, found, catalogue, views) for name, found in results.items()}
        return Scored(truths, results, methods)


def markdown(scored: Scored) -> str:
    """A table with a row for each method: shares with 95 % intervals, BOP's recalls, medians and times."""
    methods, results = scored.methods, scored.results
    any_scores = next(iter(methods.values()))
    columns = [*BOUNDS, *recalls(any_scores), "median", "flips", "right sets", "seconds an image"]
    lines = ["| method | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name, scores in methods.items():
        shares = [_share(sum(map(hit, scores)), len(scores)) for hit in BOUNDS.values()]
        others = [f"{100 * value:.1f}" for value in recalls(scores).values()]
        sets = right_sets(scored.truths, results[name])
        cells = [*shares, *others, _median(scores), str(sum(one.flip for one in scores)),
                 f"{sets[0]} of {sets[1]}", _seconds(results[name])]  # fmt: skip
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def behind(methods: Mapping[str, Sequence[Score]]) -> str:
    """Where another method has more objects than the first: at each position bound, of the whole degrees."""
    name, *others = methods
    lines = [
        f"{other} is ahead of {name} within {degrees} degrees (objects): {', '.join(filter(None, found))}"
        for other in others
        for degrees in range(1, 181)
        for found in [[_lead(methods[other], methods[name], metres, degrees) for metres in POSITION_BOUNDS]]
        if any(found)
    ]
    return "\n".join(lines) or f"No method is ahead of {name} at any bound of the figure (each whole degree)."


def _lead(theirs: Sequence[Score], ours: Sequence[Score], metres: float, degrees: float) -> str:
    """Both counts where the other method has more objects, otherwise nothing."""
    other, own = (sum(one.within(metres, degrees) for one in scores) for scores in (theirs, ours))
    return f"{other} against {own} within {100 * metres:.0f} cm" if other > own else ""


def _share(hits: int, count: int) -> str:
    low, high = interval(hits, count)
    return f"{100 * hits / max(1, count):.1f} ({100 * low:.0f} to {100 * high:.0f})"


def _median(scores: Sequence[Score]) -> str:
    """Of position and rotation, over all objects; those not found are farther off than any."""
    metres = float(np.median([one.metres for one in scores]))
    degrees = float(np.rad2deg(np.median([one.radians for one in scores])))
    return f"{1000 * metres:.1f} mm, {degrees:.1f} deg" if np.isfinite(metres) else "not found"


def _seconds(results: Sequence[Result]) -> str:
    """The mean over images, and the longest."""
    times = {(one.scene_id, one.image_id): one.seconds for one in results if one.seconds >= 0}
    if not times:
        return "-"
    return f"{np.mean(list(times.values())):.1f} (at most {max(times.values()):.1f})"


@command
def main() -> int:
    """Draws the figure and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="PNG")
    parser.add_argument("dataset", type=Path, help="BOP data set folder")
    parser.add_argument("methods", nargs="+", metavar="NAME=CSV", help="results in BOP format")
    options = parser.parse_args()
    print(_drawn(options.out, options.dataset, dict(_named(text) for text in options.methods)))
    return 0


def _named(text: str) -> tuple[str, Path]:
    name, sign, path = text.partition("=")
    if not (name and sign and path):
        raise Refused(f"'{text}': results are given as NAME=CSV")
    return name, Path(path)


def _drawn(out: Path, dataset: Path, files: Mapping[str, Path]) -> str:
    chosen = list(images(dataset, detections_file(dataset, "exact")))
    scored = Scored.of(dataset, chosen, files)
    draw(out, f"{dataset.resolve().name}: {len(scored.truths)} objects in {len(chosen)} images", scored.methods)
    return f"{markdown(scored)}\n\n{behind(scored.methods)}"


if __name__ == "__main__":
    raise SystemExit(main())
