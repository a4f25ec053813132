"""How well the annotated truth fits the readings itself: `python -m benchmarks.truth DATASET OUT.csv [--dof 3]`.

Real frames are annotated by hand or by registration, so their truth errs too. For each object the command prints how
far the estimate is from the truth, how far readings lie from the surface at either, and by how much point-to-plane
ICP turns the object when it begins at the truth: no method that reads the same depth can be expected nearer than that.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, detections_file, images
from benchmarks.comparison.accuracy import Score, score
from stages.devices.bop_results import read_results
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.perception.filter.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.filter.proposals import Dof, Proposals
from stages.perception.hypotheses.composition import fit
from stages.perception.observation.preprocessing import preprocess
from stages.perception.rendering.rasteriser import Float32s, inverse_depth
from stages.scene.catalogue import Catalogue
from stages.scene.metrics import nearest_symmetries, pose_errors

_MAX_HEIGHT = 0.6
"""The setting of the hypotheses stage."""
_TRIANGLES = 2000
_STEPS, _GATE = 20, 0.01
"""Of the polish that begins at the truth: Gauss-Newton steps, metres."""
_FORM = CostForm()
HEADING = (
    "| scene | object | estimate off by, degrees | readings off the estimate | readings off the truth "
    "| ICP turns the truth, degrees | the truth leans, degrees |\n|---|---|---|---|---|---|---|"
)


@dataclass(frozen=True)
class Comparison:
    """One object's truth beside its estimate."""

    score: Score
    at_truth: float
    """Mean distance of the readings from the visible surface, metres, bounded."""
    at_estimate: float
    turned: float
    """Radians by which polish turns the object from the truth, modulo symmetries."""
    leans: float
    """Radians between the plane's normal and the axis of the true object that is nearest to it."""


def comparisons(image: Image, scores: Sequence[Score], catalogue: Catalogue, dof: Dof) -> Iterator[Comparison]:
    """The objects of an image that were found."""
    rng = np.random.default_rng(0)
    seen = preprocess(image.frame, image.candidates.candidates, rng, max_height=_MAX_HEIGHT)
    scene = ObservedScene.of(seen.depth, seen.foreground, seen.K, seen.T_camera_table)
    items = {item.label: item for item in catalogue.objects.values()}
    shapes = {one.truth.label: Shape.of(items[one.truth.label].simplified(_TRIANGLES)) for one in scores}
    layers = [inverse_depth(shapes[one.truth.label].soup, one.truth.T_camera_object[:3], scene.view) for one in scores]
    for i, one in enumerate(scores):
        if one.result is not None:
            others = np.maximum.reduce([scene.plane_inverse, *layers[:i], *layers[i + 1 :]])
            shape, item, truth = shapes[one.truth.label], items[one.truth.label], one.truth.T_camera_object
            at_truth, at_estimate = (
                fit(scene, inverse_depth(shape.soup, T[:3], scene.view), others, _FORM)[0]
                for T in (truth, one.result.T_camera_object)
            )
            directions = Proposals(item, dof).directions(scene.T_camera_table)
            moved = _polished(shape, truth, directions, scene, others)
            turned = pose_errors(moved, truth, nearest_symmetries(moved, truth, item.symmetries))[1]
            yield Comparison(one, at_truth, at_estimate, turned, _lean(truth, scene.T_camera_table))


def _polished(shape: Shape, T: Floats, directions: Floats, scene: ObservedScene, others: Float32s) -> Floats:
    """Where point-to-plane ICP leads from a pose (4 x 4), ``others`` being all that is known besides."""
    everything = (0, 0, scene.view.width, scene.view.height)
    window = Window.of(scene, others, everything, everything, stride=1, form=_FORM)
    likelihood = ObjectLikelihood(shape, window, scene, _FORM)
    moved = likelihood.refine(T[None, :3], directions, steps=_STEPS, gate=_GATE)[0]
    return pose(moved[:, :3], moved[:, 3])


def _lean(T_camera_object: Floats, T_camera_table: Floats) -> float:
    cosines = np.abs((T_camera_object[:3, :3] * T_camera_table[:3, 2][:, None]).sum(0))
    return float(np.arccos(min(1.0, cosines.max())))


def line(each: Comparison, name: str) -> str:
    """A row of the table."""
    one = each.score
    degrees = [f"{np.rad2deg(angle):.2f}" for angle in (one.radians, each.turned, each.leans)]
    off = [f"{1000 * distance:.2f} mm" for distance in (each.at_estimate, each.at_truth)]
    cells = [str(one.truth.image[0]), name, degrees[0], *off, *degrees[1:]]
    return f"| {' | '.join(cells)} |"


@command
def main() -> int:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="BOP data set folder")
    parser.add_argument("csv", type=Path, help="results in BOP format")
    parser.add_argument("--dof", type=int, choices=(3, 6), default=6)
    options = parser.parse_args()
    catalogue = Catalogue.load(options.dataset / "models")
    results = read_results(options.csv)
    names = {item.label: item.name for item in catalogue.objects.values()}
    found: list[Comparison] = []
    print(HEADING)
    for image in images(options.dataset, detections_file(options.dataset, "exact")):
        mine = [one for one in results if (one.scene_id, one.image_id) == image.id]
        for each in comparisons(image, score(image.truths, mine, catalogue), catalogue, options.dof):
            print(line(each, names[each.score.truth.label]), flush=True)
            found.append(each)
    print(summary(found))
    return 0


def summary(found: Sequence[Comparison]) -> str:
    """How often the truth fits worse than the estimate, and how far polish moves it."""
    worse = sum(each.at_truth > each.at_estimate for each in found)
    median = np.rad2deg(np.median([each.turned for each in found])) if found else 0.0
    return (
        f"\nTruth fits worse than the estimate: {worse} of {len(found)}. ICP turns it by {median:.2f} degrees (median)."
    )


if __name__ == "__main__":
    raise SystemExit(main())
