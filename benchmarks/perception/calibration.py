"""Fits how sure the estimator says it is, and shows whether that is right: `python -m benchmarks.calibration FOLDER`.

Renders piles of several kinds into FOLDER, each in two disjoint sets, estimates them from exact and from noisy boxes
(kept there, so that a second call only fits), writes the constants of the training sets to
``stages/perception/confidence/calibration.yaml`` and prints the reliability on the test sets.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar

from benchmarks.common.datasets import Image, detections_file, images
from benchmarks.common.pipeline import Estimate
from benchmarks.comparison.estimate import Settings, estimates
from stages.devices.clutter import Pile, write_clutter
from stages.geometry.arrays import Floats
from stages.messages import Hypothesis, Observation, SceneEstimate
from stages.perception.confidence.calibration import (
    CONSTANTS,
    FEATURES,
    RIGHT_METRES,
    RIGHT_RADIANS,
    Calibration,
    cost_of_an_object,
    hypothesis_probabilities,
    standardised,
)
from stages.perception.confidence.doubt import Judge, judged
from stages.perception.confidence.evidence import Evidence, Judged
from stages.perception.filter.likelihood import ObservedScene
from stages.perception.refinement.refinement import Placed, RefinementSettings, SceneRefiner
from stages.perception.rendering.depth_noise import StructuredLight
from stages.scene.catalogue import Catalogue
from stages.scene.metrics import pose_errors

Truths = NDArray[np.bool_]
_ROOT = Path(__file__).parents[2]
_CATALOGUE = _ROOT / "stages" / "scene" / "catalogue.yaml"
_PLOT = _ROOT / "docs" / "perception" / "figures" / "reliability.png"
_SEEDS = {"train": 1001, "test": 3003}
"""Of the first kind of piles, the others follow; Clutter-15 has seed 0."""


@dataclass(frozen=True)
class Kind:
    """Piles of one kind, and how many scenes of each set are estimated from exact and from noisy boxes."""

    pile: Pile
    exact: int
    noisy: int


_COARSE = StructuredLight(
    disparity_sigma=0.14, disparity_step=0.25, lateral_sigma=1.0, edge_dropout=0.6, flying=0.2, holes=0.02
)
_STANDING = ("mug", "cup", "soup_can", "tuna_can", "sauce_bottle", "water_bottle", "sugar_box", "tea_box",
             "milk_carton", "salt_shaker")  # fmt: skip
"""Objects that look nearly the same when they are turned or flipped."""
KINDS = {
    "clutter": Kind(Pile(), exact=20, noisy=30),
    "coarse": Kind(
        Pile(
            counts=(6, 7, 5, 8, 6), spread=0.035, least_visible=0.04, distance=(1.1, 1.7), sensor=_COARSE,
            jitter=0.1, false=(2, 4),
        ), exact=60, noisy=20,
    ),
    "low": Kind(
        Pile(
            counts=(7, 6, 8, 7, 5), labels=_STANDING, spread=0.03, least_visible=0.03, pitch=(8.0, 30.0),
            jitter=0.1, false=(2, 4),
        ), exact=40, noisy=20,
    ),
    "heaps": Kind(
        Pile(
            counts=(8, 9, 7, 10, 8), spread=0.03, least_visible=0.03, views=8, pitch=(20.0, 55.0),
            jitter=0.1, false=(2, 4),
        ), exact=20, noisy=10,
    ),
}  # fmt: skip
"""Clutter-15's piles; seen from afar by a coarse sensor; standing objects seen from low down, which hides handles and
shows flips alike; and heaps in which objects show a few percent of themselves."""
POSE_SCALES = (10.0, 20.0, 40.0)
"""Readings that count as one, to choose from."""
_SIGNS = dict(zip(FEATURES, (1, -1, 1, 1, -1, -1, 1, 1, -1, -1, -1), strict=True))
"""Which way evidence points: a fit to few scenes must not turn it round."""
_RIDGE = 1.0
_PRIOR = {"margin": 0.5, "fit": -1.0, "gain": 1.0, "looked through": -1.0}
"""Weights that the ridge pulls towards: log-odds of half the margin, which is what its theory says, tempered; and one
nat per deviation for an object that does not fit its readings. Few scenes show a pose that is certain and wrong."""
_BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.85, 0.95, 0.99, 1.0)
_COARSE_BINS = (0.0, 0.5, 0.85, 0.95, 1.0)
"""There are fewer images than objects."""


@dataclass(frozen=True)
class Instance:
    """One estimated object."""

    label: str
    right: bool
    """Within 2 cm and 15 degrees of the truth, modulo symmetries; False for an object that is not there."""
    metres: float
    radians: float
    """Errors; 9 where the object is not there."""
    evidence: dict[str, Evidence]
    """By pose scale."""


@dataclass(frozen=True)
class Scene:
    """One estimated image."""

    kind: str
    """Of :data:`KINDS`."""
    boxes: str
    """``exact`` or ``noisy``."""
    winner: int
    winner_right: bool
    """The winner's set of objects is the true one."""
    true_hypothesis: int
    """Index of the hypothesis with the true set; -1 where there is none."""
    nat: float
    """Metres times pixels that are one unit of :func:`hypothesis_probabilities`."""
    log_weights: tuple[float, ...]
    instances: tuple[Instance, ...]

    def probabilities(self, scale: float) -> Floats:
        """Of the hypotheses."""
        return hypothesis_probabilities(np.array(self.log_weights), self.nat * scale)


# ------------------------------------------------------------------------------------ what is fitted to


class Recorder:
    """Gathers the evidence of estimated images at several scales, and compares them with the truth."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._refiner = SceneRefiner(catalogue, RefinementSettings())
        constants = Calibration.load()
        self._judges = {
            str(scale): Judge(catalogue, dof=6, calibration=replace(constants, pose_scale=scale, spread_scale=1.0))
            for scale in POSE_SCALES
        }

    def scene(self, image: Image, kind: tuple[str, str], estimate: Estimate) -> Scene:
        """One image, refined again to see what the refiner compared."""
        observation, *_ = (item for item in estimate.messages if isinstance(item, Observation))
        ranked, *_ = (item for item in estimate.messages if isinstance(item, SceneEstimate))
        scene = ObservedScene.of(observation.depth, observation.foreground, observation.K, observation.T_camera_table)
        placed = [Placed(item.label, item.T_camera_object) for item in ranked.objects]
        refined = self._refiner.refine(scene, observation.rgb, placed)
        doubted = [judged(*each) for each in zip(ranked.objects, refined.objects, strict=True)]
        found = {scale: _evidence(judge, scene, doubted) for scale, judge in self._judges.items()}
        instances = tuple(
            self._instance(image, item.label, item.T_camera_object, {scale: found[scale][i] for scale in found})
            for i, item in enumerate(doubted)
        )
        sets = _hypothesised(estimate)
        true = sorted(self._name(truth.label) for truth in image.truths)
        return Scene(
            kind=kind[0],
            boxes=kind[1],
            winner=ranked.winner,
            winner_right=sorted(item.label for item in ranked.objects) == true,
            true_hypothesis=sets.index(true) if true in sets else -1,
            nat=cost_of_an_object(scene, len(doubted)),
            log_weights=tuple(ranked.log_weights.tolist()),
            instances=instances,
        )

    def _instance(self, image: Image, label: str, T: Floats, evidence: dict[str, Evidence]) -> Instance:
        item = self._catalogue[label]
        truths = [truth.T_camera_object for truth in image.truths if truth.label == item.label]
        whole = np.vstack([T[:3], [0.0, 0.0, 0.0, 1.0]])
        errors = [pose_errors(whole, truth, item.symmetries.transforms()) for truth in truths]
        metres, radians = min(errors, key=lambda e: e[0] / RIGHT_METRES + e[1] / RIGHT_RADIANS, default=(9.0, 9.0))
        right = bool(metres < RIGHT_METRES and radians < RIGHT_RADIANS)
        return Instance(label, right, float(metres), float(radians), evidence)

    def _name(self, number: int) -> str:
        return next(item.name for item in self._catalogue.objects.values() if item.label == number)


def _evidence(judge: Judge, scene: ObservedScene, doubted: Sequence[Judged]) -> list[Evidence]:
    return [evidence for evidence, _ in judge.evidence(scene, doubted, judge.layers(scene, doubted), 0.5)]


def _hypothesised(estimate: Estimate) -> list[list[str]]:
    """The labels of each hypothesis, sorted, in the order of their weights."""
    found = sorted((item for item in estimate.messages if isinstance(item, Hypothesis)), key=lambda item: item.index)
    return [sorted(candidate.label for candidate in item.candidates) for item in found]


def scenes(folder: Path, name: str, most: int | None, processes: int, *, kept: bool = False) -> list[Scene]:
    """The estimated scenes of one set; rendered and estimated once and then read from ``folder``.

    ``most`` is the number of scenes of each kind of piles and boxes that are used at most; with ``kept`` only those
    are used that were estimated before.
    """
    found: list[Scene] = []
    for number, (kind, setting) in enumerate(KINDS.items()):
        dataset = folder / f"{name}-{kind}"
        for boxes, count in (("exact", setting.exact), ("noisy", setting.noisy)):
            wanted = count if most is None else min(count, most)
            path = folder / f"{dataset.name}-{boxes}.jsonl"
            lines = path.read_text().splitlines() if path.is_file() else []
            done = [msgspec.json.decode(line, type=Scene) for line in lines]
            if len(done) < wanted and not kept:
                generate(dataset, setting.pile, max(setting.exact, setting.noisy), _SEEDS[name] + number)
                done += _estimated(path, (kind, boxes), range(len(done), wanted), processes)
            found += done[:wanted]
    return found


def _estimated(path: Path, kind: tuple[str, str], wanted: range, processes: int) -> list[Scene]:
    """Estimates further scenes of a kind of piles and boxes, and keeps what is found in a file."""
    dataset = path.with_name(path.stem.removesuffix(f"-{kind[1]}"))
    chosen = [image for image in images(dataset, detections_file(dataset, kind[1])) if image.frame.index in wanted]
    recorder = Recorder(Catalogue.load(dataset / "models"))
    done: list[Scene] = []
    for image, estimate in zip(chosen, estimates(dataset, chosen, Settings(processes=processes)), strict=True):
        done.append(recorder.scene(image, kind, estimate))
        with path.open("a") as file:
            file.write(msgspec.json.encode(done[-1], enc_hook=np.generic.item).decode() + "\n")
        wrong = sum(not item.right for item in done[-1].instances)
        print(f"{path.stem} {image.frame.name}: {wrong} of {len(done[-1].instances)} wrong", flush=True)
    return done


# ------------------------------------------------------------------------------------ the fit


def fit(train: Sequence[Scene]) -> Calibration:
    """Constants of greatest likelihood; the pose scale is the best of a few."""
    hypothesis = _fit_hypotheses(train)
    fits = [_fit_poses(train, hypothesis, scale) for scale in POSE_SCALES]
    for scale, (_, loss) in zip(POSE_SCALES, fits, strict=True):
        print(f"pose scale {scale:5.0f}: log loss {loss:.4f}")
    return min(fits, key=lambda each: each[1])[0]


def _fit_hypotheses(train: Sequence[Scene]) -> float:
    """The scale at which the true set of objects is most likely, or the winner least where that set is not there."""
    doubtful = [scene for scene in train if len(scene.log_weights) > 1]

    def likelihood(scene: Scene, scale: float) -> float:
        found = scene.probabilities(scale)
        return float(1 - found[scene.winner] if scene.true_hypothesis < 0 else found[scene.true_hypothesis])

    def loss(log_scale: float) -> float:
        chosen = [likelihood(scene, float(np.exp(log_scale))) for scene in doubtful]
        # A scale that makes every scene certain is not to be learnt from a few scenes that are all right.
        return float(-np.log(np.maximum(chosen, 1e-12)).sum() + 0.1 * (log_scale - np.log(0.1)) ** 2)

    found: Any = minimize_scalar(loss, bounds=(np.log(1e-3), np.log(3.0)), method="bounded")
    return float(np.exp(found.x))


def _fit_poses(train: Sequence[Scene], hypothesis: float, scale: float) -> tuple[Calibration, float]:
    """Logistic regression with a ridge about a prior; every weight keeps the sign of its evidence."""
    X, right = design(train, hypothesis, scale)
    centres, scales = X.mean(0), np.maximum(X.std(0), 0.1)
    centres[0], scales[0] = 0.0, 1.0  # the margin is in log-odds already
    Z = standardised(X, centres, scales)
    signs = np.array([_SIGNS[name] for name in FEATURES])
    prior = np.array([0.0, *(_PRIOR.get(name, 0.0) for name in FEATURES)])

    def loss(parameters: Floats) -> tuple[float, Floats]:
        logits = parameters[0] + (Z * parameters[1:]).sum(1)
        residual = 1 / (1 + np.exp(-logits)) - right
        off = parameters - prior
        value = np.logaddexp(0.0, np.where(right, -logits, logits)).sum() + 0.5 * _RIDGE * (off**2).sum()
        return float(value), np.append(residual.sum(), (Z * residual[:, None]).sum(0)) + _RIDGE * off

    bounds = [(None, None), *((0, None) if sign > 0 else (None, 0) for sign in signs)]
    found = minimize(loss, prior, jac=True, bounds=bounds, method="L-BFGS-B")
    weights = found.x[1:]
    constants = Calibration(
        hypothesis_scale=hypothesis,
        pose_scale=scale,
        spread_scale=_fit_spread(train, scale),
        bias=float(found.x[0]),
        weights=tuple(weights.tolist()),
        centres=tuple(centres.tolist()),
        scales=tuple(scales.tolist()),
    )
    return constants, float(found.fun) / len(right)


def _fit_spread(train: Sequence[Scene], scale: float) -> float:
    """The factor that makes the median error of right poses what it is for a normal distribution of that spread."""
    ratios = [
        item.metres / item.evidence[str(scale)].spread_metres
        for scene in train
        for item in scene.instances
        if item.right
    ]
    return float(np.median(ratios)) / 0.888


def design(chosen: Sequence[Scene], hypothesis: float, scale: float) -> tuple[Floats, Truths]:
    """Features of every instance, N x F, and whether it is right."""
    rows = [
        replace(item.evidence[str(scale)], hypothesis=float(scene.probabilities(hypothesis)[scene.winner])).features()
        for scene in chosen
        for item in scene.instances
    ]
    return np.array(rows), np.array([item.right for scene in chosen for item in scene.instances])


# ------------------------------------------------------------------------------------ the evaluation


@dataclass(frozen=True)
class Bin:
    """Estimates that were called about equally sure."""

    low: float
    high: float
    called: float
    """Mean probability."""
    right: int
    count: int

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the share that is right."""
        return wilson(self.right, self.count)


Bins = tuple[Sequence[Bin], Sequence[Bin]]
"""Of poses and of winning hypotheses."""


def wilson(right: int, count: int) -> tuple[float, float]:
    """Score interval of a share, 95 % (Wilson 1927)."""
    z = 1.959964
    share, n = right / count, count
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return float(max(0.0, middle - half)), float(min(1.0, middle + half))


def reliability(sure: Floats, right: Truths, edges: Sequence[float] = _BINS) -> list[Bin]:
    """Bins that hold something."""
    found: list[Bin] = []
    for low, high in pairwise(edges):
        inside = (sure >= low) & ((sure < high) | (high == 1.0))
        if inside.any():
            found.append(Bin(low, high, float(sure[inside].mean()), int(right[inside].sum()), int(inside.sum())))
    return found


def expected_error(bins: Sequence[Bin]) -> float:
    """Expected calibration error: mean distance of what was called and what was right, by count."""
    total = sum(each.count for each in bins)
    return sum(each.count * abs(each.called - each.right / each.count) for each in bins) / total


def table(bins: Sequence[Bin]) -> str:
    """The reliability of all bins."""
    lines = ["called        mean   right              95 % interval"]
    for each in bins:
        low, high = each.interval
        lines.append(
            f"{each.low:4.2f} to {each.high:4.2f}  {each.called:5.3f}  {each.right / each.count:5.3f} "
            f"({each.right:3d} of {each.count:3d})  {low:5.3f} to {high:5.3f}"
        )
    return "\n".join([*lines, f"expected calibration error {expected_error(bins):.3f}"])


def called(chosen: Sequence[Scene], constants: Calibration) -> tuple[Floats, Truths]:
    """What the constants call each instance, and whether it is right."""
    X, right = design(chosen, constants.hypothesis_scale, constants.pose_scale)
    return np.array([constants.probability(row) for row in X]), right


def winners(chosen: Sequence[Scene], constants: Calibration) -> tuple[Floats, Truths]:
    """How probable the winner is where there are several hypotheses, and whether it is the true set of objects."""
    several = [scene for scene in chosen if len(scene.log_weights) > 1]
    sure = [float(scene.probabilities(constants.hypothesis_scale)[scene.winner]) for scene in several]
    return np.array(sure), np.array([scene.winner_right for scene in several], bool)


def evaluate(chosen: Sequence[Scene], constants: Calibration) -> tuple[list[Bin], list[Bin]]:
    """Prints what the constants are worth on these scenes; the bins of the poses and those of the winners."""
    sure, right = called(chosen, constants)
    bins = reliability(sure, right)
    print(f"\n{len(right)} objects in {len(chosen)} estimates, {right.mean():.1%} right\n{table(bins)}")
    of = np.array([(scene.kind, scene.boxes) for scene in chosen for _ in scene.instances])
    for kind, boxes in dict.fromkeys(map(tuple, of.tolist())):
        mine = (of[:, 0] == kind) & (of[:, 1] == boxes)
        print(f"{kind:8} {boxes} boxes: called {sure[mine].mean():.3f}, right {right[mine].mean():.3f} of {mine.sum()}")
    order = np.argsort(sure)[: max(1, len(sure) // 10)]
    print(f"the least sure tenth holds {np.sum(~right[order])} of {np.sum(~right)} errors")
    return bins, _evaluated_winners(*winners(chosen, constants))


def _evaluated_winners(sure: Floats, right: Truths) -> list[Bin]:
    if not len(sure):
        return []
    bins = reliability(sure, right, _COARSE_BINS)
    print(f"winning hypotheses: called {sure.mean():.3f}, right {right.mean():.3f} of {len(sure)}\n{table(bins)}")
    return bins


def crossed(halves: Sequence[tuple[Sequence[Scene], Calibration]]) -> tuple[list[Bin], list[Bin]]:
    """Prints the reliability over sets of scenes, each judged with constants that were fitted to the other."""
    sure, right = _pooled([called(*half) for half in halves])
    bins = reliability(sure, right)
    print(f"\n{len(right)} objects of both sets, each judged with the constants of the other\n{table(bins)}")
    return bins, _evaluated_winners(*_pooled([winners(*half) for half in halves]))


def _pooled(parts: Sequence[tuple[Floats, Truths]]) -> tuple[Floats, Truths]:
    return np.concatenate([sure for sure, _ in parts]), np.concatenate([right for _, right in parts])


def plot(test: Bins, both: Bins, path: Path) -> None:
    """The reliability diagrams of poses and, where there were several hypotheses, of the winning ones.

    ``both`` are of all sets, each judged with the constants of the other.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    titles = "Poses within 2 cm and 15 degrees (numbers: objects)", "Winning hypotheses (numbers: images)"
    shown = [each for each in zip(titles, test, both, strict=True) if each[1]]
    figure, axes = plt.subplots(
        1, len(shown), figsize=(5.2 * len(shown), 5.0), layout="constrained", sharey=True, squeeze=False
    )
    for each, (title, alone, pooled) in zip(axes[0], shown, strict=True):
        each.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="perfect")
        each.axvspan(0.85, 0.95, color="0.93", zorder=0)
        _draw(each, alone, "#2c6fbb", "test set, 95 %", -0.004)
        _draw(each, pooled, "#c7761d", "both sets, constants of the other", 0.004)
        each.set(xlabel="probability that was reported", xlim=(0, 1.06), ylim=(0, 1.06), title=title)
    axes[0, 0].set(ylabel="share that is right")
    axes[0, 0].legend(loc="upper left", frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def _draw(axes: Any, bins: Sequence[Bin], color: str, label: str, aside: float) -> None:
    sure = [each.called + aside for each in bins]
    right = np.array([each.right / each.count for each in bins])
    ends = np.array([each.interval for each in bins]).T
    off = np.maximum(np.abs(ends - right), 0.0)
    axes.errorbar(sure, right, yerr=off, fmt="o", color=color, capsize=3, label=label)
    for each, x, y in zip(bins, sure, right, strict=True):
        place = (7, -11) if aside > 0 else (-24, 4)
        axes.annotate(str(each.count), (x, y), textcoords="offset points", xytext=place, fontsize=8, color=color)


def write_constants(constants: Calibration, path: Path, command: str) -> None:
    """Writes the constants with the command that made them."""
    content = {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(constants).items()}
    rounded = {key: [float(f"{v:.4g}") for v in value] if isinstance(value, list) else float(f"{value:.4g}")
               for key, value in content.items()}  # fmt: skip
    features = ", ".join(FEATURES)
    head = f"# Written by `{command}`. Weights are of the features\n# {features}.\n"
    path.write_text(head + yaml.safe_dump(rounded, sort_keys=False, default_flow_style=None, width=110))


def generate(dataset: Path, pile: Pile, count: int, seed: int) -> None:
    """Renders a set of scenes, unless as many are there."""
    targets = dataset / "test_targets_bop19.json"
    there = {item["scene_id"] for item in json.loads(targets.read_text())} if targets.is_file() else set[int]()
    if len(there) < count:
        print(f"rendering {count} scenes of {dataset.name}", flush=True)
        write_clutter(dataset, Catalogue.load(_CATALOGUE), scenes=count, seed=seed, pile=pile)


def main() -> None:
    """Fits and evaluates."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where scenes and estimates are kept; empty it to begin anew")
    parser.add_argument("--most", type=int, help="scenes of each kind of piles and boxes, at most")
    parser.add_argument("--kept", action="store_true", help="use the scenes that are estimated already and no others")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--evaluate", action="store_true", help="keep the constants that are there")
    options = parser.parse_args()
    sets = {name: scenes(options.folder, name, options.most, options.processes, kept=options.kept) for name in _SEEDS}
    if not options.evaluate:
        most, kept = f" --most {options.most}" if options.most else "", " --kept" if options.kept else ""
        command = f"python -m benchmarks.calibration FOLDER{most}{kept}"
        write_constants(fit(sets["train"]), CONSTANTS, command)
        Calibration.load.cache_clear()
    constants = Calibration.load()
    print("\nThe test set:", end="")
    alone = evaluate(sets["test"], constants)
    other = fit(sets["test"])
    both = crossed([(sets["test"], constants), (sets["train"], other)])
    plot(alone, both, _PLOT)


if __name__ == "__main__":
    main()
