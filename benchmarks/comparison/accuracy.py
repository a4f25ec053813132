"""Scores BOP results: `python -m benchmarks.accuracy DATASET CSV [--json]`."""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from benchmarks.common.command import command
from benchmarks.common.datasets import ImageId, Truth, read_truth
from stages.devices.bop import read_dataset
from stages.devices.bop_results import Result, read_results
from stages.geometry.arrays import Floats
from stages.messages.arrays import Depth, Intrinsics
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.scene.catalogue import Catalogue, CatalogueObject
from stages.scene.metrics import (
    BOP_SHARES,
    BOP_SYMMETRY_STEP,
    add_s,
    area_under_curve,
    average_recall,
    is_near_flip,
    mssd,
    nearest_symmetries,
    pose_errors,
    vsd,
)

_POINTS = 2000
_FLIP = np.deg2rad(15.0)
_SURE = 0.9
_SHOWN = 1 / 3
"""Of an object's silhouette that must be seen for it to count where nobody gave boxes."""
_WORST = np.ones(len(BOP_SHARES))

Views = Mapping[ImageId, tuple[Depth, Intrinsics]]
"""Depth (H x W, metres) and intrinsics of images; VSD needs them."""


@dataclass(frozen=True)
class Score:
    """What became of one true object; errors are infinite where nothing of its label was found."""

    truth: Truth
    adds: float = np.inf
    metres: float = np.inf
    radians: float = np.inf
    plain_metres: float = np.inf
    plain_radians: float = np.inf
    """Errors without any symmetry: they tell which way the label faces."""
    flip: bool = False
    mssd: float = np.inf
    """As a share of the object's diameter."""
    vsd: tuple[float, ...] | None = None
    """One error for each of BOP's tolerances; None where the images were not given."""
    result: Result | None = None

    def within(self, metres: float, degrees: float) -> bool:
        """Whether position and rotation are that close, modulo symmetries."""
        return self.metres < metres and self.radians < np.deg2rad(degrees)

    @property
    def label_right(self) -> bool:
        """Whether the pose is within 2 cm and 15 degrees without any symmetry."""
        return self.plain_metres < 0.02 and self.plain_radians < np.deg2rad(15)


def score(
    truths: Sequence[Truth], results: Sequence[Result], catalogue: Catalogue, views: Views | None = None
) -> list[Score]:
    """One score per true object against the results of its image and label, each result used once."""
    judges = {item.label: _Judge(item) for item in catalogue.objects.values()}
    groups: dict[tuple[ImageId, int], tuple[list[Truth], list[Result]]] = defaultdict(lambda: ([], []))
    for truth in truths:
        groups[truth.image, truth.label][0].append(truth)
    for result in results:
        groups[(result.scene_id, result.image_id), result.label][1].append(result)
    return [one for (image, label), group in groups.items() if group[0]
            for one in _matched(*group, judges[label], None if views is None else views[image])]  # fmt: skip


def _matched(
    truths: list[Truth], results: list[Result], judge: _Judge, view: tuple[Depth, Intrinsics] | None
) -> list[Score]:
    costs = [[judge.adds(truth, result) for result in results] for truth in truths]
    rows, columns = linear_sum_assignment(np.minimum(costs, 1e3).reshape(len(truths), len(results)))
    matched = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    missing = None if view is None else tuple(_WORST)
    return [judge.score(truth, results[matched[i]], view) if i in matched else Score(truth, vsd=missing)
            for i, truth in enumerate(truths)]  # fmt: skip


class _Judge:
    """Everything that is prepared once for one object."""

    def __init__(self, item: CatalogueObject) -> None:
        vertices = item.mesh.vertices
        self._item = item
        self._points = vertices[:: max(1, len(vertices) // _POINTS)]
        self._prepared: tuple[Floats, float, Floats, Soup] | None = None

    def adds(self, truth: Truth, result: Result) -> float:
        return add_s(result.T_camera_object, truth.T_camera_object, self._points)

    def score(self, truth: Truth, result: Result, view: tuple[Depth, Intrinsics] | None) -> Score:
        T, T_true = result.T_camera_object, truth.T_camera_object
        corners, diameter, symmetries, soup = self._prepare()
        exact = self._item.symmetries
        metres, radians = pose_errors(T, T_true, nearest_symmetries(T, T_true, exact))
        plain = pose_errors(T, T_true, np.eye(4)[None])
        flip = is_near_flip(T, T_true, exact, tolerance=_FLIP)
        farthest = mssd(T, T_true, corners, symmetries) / diameter
        seen = None if view is None else _vsd((T, T_true), soup, view, diameter)
        return Score(truth, self.adds(truth, result), metres, radians, *plain, flip, farthest, seen, result)

    def _prepare(self) -> tuple[Floats, float, Floats, Soup]:
        """Corners of the convex hull, diameter, BOP's sampling of the symmetries, triangles."""
        if self._prepared is None:
            vertices = self._item.mesh.vertices
            corners = vertices[ConvexHull(vertices).vertices]
            symmetries = self._item.symmetries.transforms(BOP_SYMMETRY_STEP)
            self._prepared = corners, float(pdist(corners).max()), symmetries, Soup.of(self._item.mesh)
        return self._prepared


def _vsd(
    poses: tuple[Floats, Floats], soup: Soup, seen: tuple[Depth, Intrinsics], diameter: float
) -> tuple[float, ...]:
    """VSD of the estimated and the true pose at each of BOP's tolerances."""
    depth, K = seen
    view = View.of(K, depth.shape[1], depth.shape[0])
    estimate, truth = (_depth(inverse_depth(soup, T, view)) for T in poses)
    return tuple(vsd(estimate, truth, depth, K, BOP_SHARES * diameter).tolist())


def _depth(inverse: Any) -> Floats:
    return np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-6), 0.0)


def right_sets(truths: Sequence[Truth], results: Sequence[Result]) -> tuple[int, int]:
    """Images whose set of labels is exactly right, and all images."""
    images = sorted({truth.image for truth in truths})
    found = [sorted(r.label for r in results if (r.scene_id, r.image_id) == image) for image in images]
    wanted = [sorted(t.label for t in truths if t.image == image) for image in images]
    return sum(f == w for f, w in zip(found, wanted, strict=True)), len(images)


@dataclass(frozen=True)
class Claims:
    """What results say beyond the objects that are there."""

    false: int
    """Results of which no object of their label is left in their image."""
    sure: int
    """Results called right with a probability of 0.9 and more; false ones count."""
    sure_right: int
    """Of these within 2 cm and 15 degrees."""
    images: int

    @staticmethod
    def of(scores: Sequence[Score], results: Sequence[Result]) -> Claims:
        """Those of results that were scored."""
        matched = [(one, one.result) for one in scores if one.result is not None]
        sure = sum(result.score >= _SURE for result in results)
        right = sum(result.score >= _SURE and one.within(0.02, 15) for one, result in matched)
        return Claims(len(results) - len(matched), sure, right, len({one.truth.image for one in scores}))


BOUNDS: dict[str, Callable[[Score], bool]] = {
    "ADD-S < 1 cm": lambda one: one.adds < 0.01,
    "ADD-S < 2 cm": lambda one: one.adds < 0.02,
    "1 cm and 10 degrees": lambda one: one.within(0.01, 10),
    "2 cm and 15 degrees": lambda one: one.within(0.02, 15),
}


def recalls(scores: Sequence[Score]) -> dict[str, float]:
    """AUC of ADD-S (0 to 10 cm) and BOP's average recalls, 0 to 1."""
    values = {"ADD-S AUC": area_under_curve(np.array([one.adds for one in scores]))}
    values["MSSD recall"] = average_recall(np.array([one.mssd for one in scores]))
    errors = [one.vsd for one in scores if one.vsd is not None]
    if len(errors) == len(scores):
        values["VSD recall"] = average_recall(np.array(errors))
    return values


def interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson, 1927), 0 to 1."""
    z, n = 1.96, max(1, count)
    share = hits / n
    middle, reach = share + z * z / (2 * n), z * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    low, high = (middle - reach) / (1 + z * z / n), (middle + reach) / (1 + z * z / n)
    return max(0.0, float(low)), min(1.0, float(high))


def table(scores: Sequence[Score], sets: tuple[int, int], claims: Claims | None = None) -> str:
    """The summary that people read."""
    lines = [_line(name, sum(map(hit, scores)), len(scores)) for name, hit in BOUNDS.items()]
    known = [one for one in scores if one.truth.label_known]
    lines += [_line("label faces right", sum(one.label_right for one in known), len(known))] if known else []
    lines += [f"{name:22s} {100 * value:5.1f} %" for name, value in recalls(scores).items()]
    lines.append(f"{'near-symmetric flips':22s} {sum(one.flip for one in scores)} (counted as errors above)")
    lines.append(f"{'set of objects right':22s} {sets[0]} of {sets[1]} images")
    if claims is not None:
        shown = [one for one in scores if one.truth.visible >= _SHOWN]
        lines.append(_line("2 cm, 15 deg, a third", sum(one.within(0.02, 15) for one in shown), len(shown)))
        lines.append(_line("right of those sure", claims.sure_right, claims.sure))
        lines.append(f"{'false objects':22s} {claims.false} in {claims.images} images")
    return "\n".join(lines)


def _line(name: str, hits: int, count: int) -> str:
    low, high = interval(hits, count)
    share = 100 * hits / max(1, count)
    return f"{name:22s} {share:5.1f} %  ({hits} of {count})  95 % interval {100 * low:.1f} to {100 * high:.1f}"


def as_json(scores: Sequence[Score], sets: tuple[int, int]) -> dict[str, Any]:
    """The same numbers and every object's errors, for other programs; infinite errors are null."""
    values: dict[str, Any] = {name: float(np.mean([hit(one) for one in scores])) for name, hit in BOUNDS.items()}
    values |= recalls(scores)
    known = [one.label_right for one in scores if one.truth.label_known]
    values |= {"label faces right": float(np.mean(known)) if known else None, "labels": len(known)}
    values |= {"flips": sum(one.flip for one in scores), "right_sets": sets[0], "images": sets[1]}
    return values | {"objects": [_entry(one) for one in scores]}


def _entry(one: Score) -> dict[str, Any]:
    found = bool(np.isfinite(one.adds))
    return {
        "scene_id": one.truth.image[0],
        "im_id": one.truth.image[1],
        "obj_id": one.truth.label,
        "visible": one.truth.visible,
        "adds": one.adds if found else None,
        "metres": one.metres if found else None,
        "degrees": float(np.rad2deg(one.radians)) if found else None,
        "mssd_per_diameter": one.mssd if found else None,
        "label_known": one.truth.label_known,
        "label_degrees": float(np.rad2deg(one.plain_radians)) if found else None,
        "flip": one.flip,
    }


def failed(scores: Iterable[Score]) -> list[Score]:
    """The objects that are not within 2 cm and 15 degrees; where it is known how the label faces, without symmetry."""
    return [one for one in scores if not (one.label_right if one.truth.label_known else one.within(0.02, 15))]


def failures(scores: Sequence[Score], catalogue: Catalogue) -> str:
    """A line for every object that :func:`failed` returns."""
    names = {item.label: item.name for item in catalogue.objects.values()}
    return "\n".join(
        f"  scene {one.truth.image[0]} image {one.truth.image[1]} {names[one.truth.label]}: {described(one)}"
        for one in failed(scores)
    )


def described(one: Score) -> str:
    """The errors of an object in words."""
    if not np.isfinite(one.adds):
        return f"not found, {100 * one.truth.visible:.0f} % visible"
    errors = f"{100 * one.metres:.1f} cm, {np.rad2deg(one.radians):.0f} degrees, ADD-S {100 * one.adds:.1f} cm"
    label = f", label {np.rad2deg(one.plain_radians):.0f} degrees" if one.truth.label_known else ""
    return f"{errors}{label}, {100 * one.truth.visible:.0f} % visible{', near-symmetric flip' if one.flip else ''}"


def read_views(dataset: Path) -> Views:
    """Depth and intrinsics of every image of a data set."""
    return {(image.scene_id, image.image_id): (image.read()[1], image.K) for image in read_dataset(dataset)}


@command
def main() -> int:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="BOP data set folder")
    parser.add_argument("csv", type=Path, help="results in BOP format")
    parser.add_argument("--json", action="store_true", help="prints JSON instead of a table")
    arguments = parser.parse_args()
    catalogue = Catalogue.load(arguments.dataset / "models")
    truths, results = read_truth(arguments.dataset), read_results(arguments.csv)
    scores = score(truths, results, catalogue, read_views(arguments.dataset))
    sets = right_sets(truths, results)
    if arguments.json:
        print(json.dumps(as_json(scores, sets), indent=1))
    else:
        print(table(scores, sets, Claims.of(scores, results)))
        print(failures(scores, catalogue))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
