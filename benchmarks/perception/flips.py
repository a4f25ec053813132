"""Flips before and after colour: `python -m benchmarks.flips [SET ...] [--data FOLDER] [--looks N]`.

Every image is filtered once, with exact boxes. The ranked scene is then refined by depth alone, and with colour.
An object is flipped where its shape lies right (ADD-S below 1 cm) and its rotation is wrong by more than 15 degrees,
modulo its exact symmetries. Besides the data sets there are looks of the simulated robot at objects of its own
catalogue, cans end up and end down among them; these are not filtered, but refined from a flip drawn at random.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, Truth, detections_file, images
from benchmarks.comparison.accuracy import Score, score
from benchmarks.comparison.estimate import Settings, estimates
from stages.camera import SimulatedCamera
from stages.devices.bop_results import Result
from stages.estimate import Quiet
from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, inverse, pose
from stages.messages import Candidate, Candidates, ObjectPose, Observation, SceneEstimate, Snapshot
from stages.perception.filter.likelihood import ObservedScene
from stages.perception.filter.proposals import Proposals
from stages.perception.observation.preprocessing import preprocess
from stages.perception.refinement.refinement import Placed, RefinementSettings, SceneRefiner
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.perception.rendering.renderer import Camera, Item, Renderer
from stages.robots import BUILT_IN, read_robot
from stages.scene.catalogue import Catalogue, CatalogueObject

ROOT = Path(__file__).parents[2]
CATALOGUE = ROOT / "stages" / "scene" / "catalogue.yaml"
FIGURE = ROOT / "docs" / "perception" / "figures" / "flips.png"
ROBOT = read_robot(BUILT_IN)
OWN = "simulated looks, from random flips"
SETS = ("ycb-real", "clutter-ycb", "household-layout", "simulated")
_SHOWN = ("soup_can", "soup_can", "tuna_can", ("sauce_bottle", "water_bottle", "milk_carton"), ("tea_box", "sugar_box"))
"""Objects of a look; of a tuple, one after the other."""
_TURNED = np.deg2rad(15.0)
_PLACES: list[tuple[float, float]] = [(x, y) for x in (0.58, 0.74) for y in (-0.22, 0.0, 0.22)]
_TILE = 96
_PAIRS = 10
_Dof = Literal[3, 6]


@dataclass(frozen=True)
class Case:
    """One image, what is true in it, and its objects as ranked and as refined without and with colour."""

    image: Image
    ranked: tuple[Result, ...]
    before: tuple[Result, ...]
    after: tuple[Result, ...]


@dataclass(frozen=True)
class Pair:
    """One true object and its scores: as ranked, refined by depth alone, and with colour."""

    label: str
    ranked: Score
    before: Score
    after: Score


def is_flipped(one: Score) -> bool:
    """The shape lies right, the object does not."""
    return one.adds < 0.01 and one.radians > _TURNED


def cases(dataset: Path, dof: _Dof) -> Iterator[Case]:
    """Filters each image of a data set and refines the ranked scene with and without colour."""
    catalogue = Catalogue.load(dataset / "models")
    chosen = list(images(dataset, detections_file(dataset, "exact")))
    compare = _Comparison(catalogue, dof)
    for image, found in zip(chosen, estimates(dataset, chosen, Settings(dof=dof)), strict=True):
        (observation,) = [m for m in found.messages if isinstance(m, Observation)]
        ranked = next(m for m in found.messages if isinstance(m, SceneEstimate))
        yield compare.case(image, observation, ranked)


def simulated_cases(catalogue: Catalogue, count: int) -> Iterator[Case]:
    """Refines simulated looks from a random flip of each true pose, 3 degrees and 3 mm off."""
    compare = _Comparison(catalogue, 6)
    for index, image in enumerate(looks(catalogue, count)):
        rng = np.random.default_rng([9, index])
        observation = preprocess(image.frame, image.candidates.candidates, rng, max_height=0.6)
        yield compare.case(image, observation, _begun(image, observation, catalogue, rng))


def _begun(image: Image, observation: Observation, catalogue: Catalogue, rng: np.random.Generator) -> SceneEstimate:
    """A scene as a filter that does not see labels might rank it."""
    objects: list[ObjectPose] = []
    for number, (box, truth) in enumerate(zip(image.boxes, image.truths, strict=True)):
        flips = Proposals(catalogue[box.label], 6).all_flips(truth.T_camera_object[:3], observation.T_camera_table)
        alike = catalogue[box.label].symmetries.near
        start = truth.T_camera_object @ alike[0] if len(alike) else flips[rng.integers(len(flips))]
        start = start[:3] if rng.random() < 0.5 else truth.T_camera_object[:3]
        R = exp_so3(rng.normal(0, np.deg2rad(3), 3)) @ start[:, :3]
        T = pose(R, start[:, 3] + rng.normal(0, 0.003, 3))
        objects.append(ObjectPose(name=f"{box.label}_{number}", label=box.label, T_camera_object=T,
                                  confidence=1.0, cost=0.0, box=box.box))  # fmt: skip
    return SceneEstimate(
        objects=tuple(objects), winner=0, log_weights=np.zeros(1), left_out=0, K=observation.K,
        T_camera_table=observation.T_camera_table, T_base_camera=observation.T_base_camera,
        scene_id=observation.scene_id, image_id=observation.image_id,
    )  # fmt: skip


class _Comparison:
    """The refiner without and with colour."""

    def __init__(self, catalogue: Catalogue, dof: _Dof) -> None:
        self._catalogue = catalogue
        self._refiners = [
            SceneRefiner(catalogue, RefinementSettings(dof=dof, colour=colour)) for colour in (False, True)
        ]

    def case(self, image: Image, observation: Observation, ranked: SceneEstimate) -> Case:
        """One image with what becomes of its ranked scene."""
        before, after = (refined(refiner, observation, ranked, self._catalogue) for refiner in self._refiners)
        return Case(image, _results(ranked, ranked.objects, self._catalogue), before, after)


def refined(
    refiner: SceneRefiner, observation: Observation, ranked: SceneEstimate, catalogue: Catalogue
) -> tuple[Result, ...]:
    """The objects of a ranked scene as a refiner leaves them."""
    scene = ObservedScene.of(observation.depth, observation.foreground, observation.K, observation.T_camera_table)
    placed = [Placed(item.label, item.T_camera_object) for item in ranked.objects]
    found = refiner.refine(scene, observation.rgb, placed).objects
    moved = [
        msgspec.structs.replace(item, T_camera_object=pose(new.T_camera_object[:, :3], new.T_camera_object[:, 3]))
        for item, new in zip(ranked.objects, found, strict=True)
    ]
    return _results(ranked, moved, catalogue)


def _results(scene: SceneEstimate, objects: Sequence[ObjectPose], catalogue: Catalogue) -> tuple[Result, ...]:
    return tuple(Result.of(scene, item, catalogue[item.label].label, -1.0) for item in objects)


def pairs(case: Case, catalogue: Catalogue) -> list[Pair]:
    """The true objects of a case with their scores."""
    names = {item.label: item.name for item in catalogue.objects.values()}
    scored = [
        score(list(case.image.truths), list(found), catalogue) for found in (case.ranked, case.before, case.after)
    ]
    return [Pair(names[each[0].truth.label], *each) for each in zip(*scored, strict=True)]


# --- simulated looks --------------------------------------------------------------------------------------------


def looks(catalogue: Catalogue, count: int) -> Iterator[Image]:
    """What the simulated head camera sees of standing, inverted and lying objects, with boxes around each."""
    camera = SimulatedCamera(SimulatedCamera.Config(catalogue=CATALOGUE))
    for index in range(count):
        rng = np.random.default_rng([7, index])
        labels = [each if isinstance(each, str) else each[index % len(each)] for each in _SHOWN]
        spots = rng.permutation(len(_PLACES))[: len(labels)]
        poses = [_rested(catalogue[a], _PLACES[b], rng) for a, b in zip(labels, spots.tolist(), strict=True)]
        yield _look(camera, catalogue, labels, poses, index)
    camera.close()


def _rested(item: CatalogueObject, place: tuple[float, float], rng: np.random.Generator) -> Floats:
    """T_base_object on the table, resting in one of its ways, turned at random."""
    R = exp_so3(np.array([0, 0, rng.uniform(-np.pi, np.pi)])) @ item.resting[rng.integers(len(item.resting))]
    lowest = float((item.mesh.vertices @ R[2]).min())
    x, y = np.array(place) + rng.uniform(-0.02, 0.02, 2)
    return pose(R, np.array([x, y, ROBOT.table.height - lowest]))


def _look(
    camera: SimulatedCamera, catalogue: Catalogue, labels: Sequence[str], poses: Sequence[Floats], index: int
) -> Image:
    snapshot = Snapshot(
        names=tuple(labels),
        T_base_objects=np.stack(poses),
        joint_names=tuple(ROBOT.posture),
        joint_positions=np.array(list(ROBOT.posture.values())),
        time=0.0,
    )
    frame = camera.on_snapshot(snapshot, Quiet([8, index]))
    frame = msgspec.structs.replace(
        frame, n_objects=len(labels), scene_id=index + 1, index=index, name=f"look {index + 1}"
    )
    assert frame.T_base_camera is not None
    seen = [inverse(frame.T_base_camera) @ T for T in poses]
    boxes = _boxes([(catalogue[label], T) for label, T in zip(labels, seen, strict=True)], View.of(frame.K, 640, 480))
    found = tuple(Candidate(box=box, label=label, confidence=1.0) for box, label in zip(boxes, labels, strict=True))
    candidates = Candidates(candidates=found, labels=tuple(catalogue.objects),
                            confidences=np.zeros((len(found), len(catalogue.objects))))  # fmt: skip
    truths = tuple(Truth((index + 1, 0), catalogue[label].label, T) for label, T in zip(labels, seen, strict=True))
    return Image(frame, candidates, truths)


def _boxes(items: Sequence[tuple[CatalogueObject, Floats]], view: View) -> list[Floats]:
    """Boxes around what can be seen of each object."""
    layers = [inverse_depth(Soup.of(item.mesh), T, view) for item, T in items]
    nearest = np.maximum.reduce(layers)
    shown = [np.nonzero((layer > 0) & (layer >= nearest)) for layer in layers]
    return [np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], float) for v, u in shown]


# --- table and figure -------------------------------------------------------------------------------------------


def table(found: dict[str, list[Pair]]) -> str:
    """Flips by set and object, in Markdown."""
    lines = [
        "| set | object | instances | flipped as ranked | refined by depth | with colour |",
        "|---|---|---|---|---|---|",
    ]
    for name, each in found.items():
        labels = sorted({pair.label for pair in each if any(map(is_flipped, _stages(pair)))})
        lines += [_row(name, label, [pair for pair in each if pair.label == label]) for label in labels]
        lines.append(_row(name, "**all**", each))
    return "\n".join(lines)


def _row(name: str, label: str, each: list[Pair]) -> str:
    counts = [sum(map(is_flipped, scores)) for scores in zip(*map(_stages, each), strict=True)]
    return f"| {name} | {label} | {len(each)} | " + " | ".join(map(str, counts)) + " |"


def _stages(pair: Pair) -> tuple[Score, Score, Score]:
    return pair.ranked, pair.before, pair.after


def sheet(shown: Sequence[tuple[Case, Pair]], catalogues: Sequence[Catalogue]) -> NDArray[np.uint8]:
    """One column a pair: observation, as ranked, refined with colour."""
    columns = [_column(case, pair, catalogue) for (case, pair), catalogue in zip(shown, catalogues, strict=True)]
    return np.concatenate(columns, 1)


def _column(case: Case, pair: Pair, catalogue: Catalogue) -> NDArray[np.uint8]:
    frame = case.image.frame
    item = next(each for each in catalogue.objects.values() if each.label == pair.before.truth.label)
    drawn = [frame.rgb, *(_overlay(case.image, _nearest(found, pair), item) for found in (case.ranked, case.after))]
    x0, y0, x1, y1 = _crop(pair, item, frame.K, frame.rgb.shape)
    return np.concatenate([cv2.resize(each[y0:y1, x0:x1], (_TILE, _TILE)) for each in drawn], 0).astype(np.uint8)


def _nearest(found: Sequence[Result], pair: Pair) -> Floats:
    """The estimate of the pair's object."""
    truth = pair.before.truth
    poses = [each.T_camera_object for each in found if each.label == truth.label]
    return min(poses, key=lambda T: float(np.linalg.norm(T[:3, 3] - truth.T_camera_object[:3, 3])))


def _overlay(image: Image, T_camera_object: Floats, item: CatalogueObject) -> NDArray[np.uint8]:
    """The observation in grey with one object, rendered, laid over it."""
    height, width = image.depth.shape
    renderer = Renderer(width, height)
    rendered = renderer.color([Item(item.mesh, T_camera_object)], Camera(image.K, np.eye(4)))
    renderer.close()
    grey = np.repeat(image.rgb.mean(axis=2, keepdims=True), 3, axis=2)
    return np.where(rendered.any(axis=2, keepdims=True), rendered, 0.7 * grey).astype(np.uint8)


def _crop(pair: Pair, item: CatalogueObject, K: Floats, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """A square around the object, inside the image."""
    centre = (pair.before.truth.T_camera_object @ np.append(item.bounds.mean(0), 1))[:3]
    u, v = (K @ centre)[:2] / centre[2]
    side = int(1.3 * np.linalg.norm(item.dimensions) * K[0, 0] / centre[2])
    x0 = int(np.clip(u - side / 2, 0, max(0, shape[1] - side)))
    y0 = int(np.clip(v - side / 2, 0, max(0, shape[0] - side)))
    return x0, y0, x0 + side, y0 + side


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _found(name: str, data: Path, count: int) -> tuple[Catalogue, list[Case]]:
    if name == "simulated":
        catalogue = Catalogue.load(CATALOGUE)
        return catalogue, list(simulated_cases(catalogue, count))
    dof: _Dof = 3 if name == "household-layout" else 6
    return Catalogue.load(data / name / "models"), list(cases(data / name, dof))


@command
def main() -> int:
    """Prints the table and writes the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="*", default=list(SETS), help=f"of {', '.join(SETS)}")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--looks", type=int, default=20)
    parser.add_argument("--figure", type=Path, default=FIGURE)
    options = parser.parse_args()
    rows: dict[str, list[Pair]] = {}
    shown: list[tuple[Case, Pair]] = []
    catalogues: list[Catalogue] = []
    for name in options.sets:
        catalogue, found = _found(name, options.data, options.looks)
        each = [(case, pair) for case in found for pair in pairs(case, catalogue)]
        rows[OWN if name == "simulated" else name] = [pair for _, pair in each]
        changed = [one for one in each if is_flipped(one[1].ranked) != is_flipped(one[1].after)]
        shown += changed
        catalogues += [catalogue] * len(changed)
    print(table(rows))
    if shown:
        _write(options.figure, sheet(shown[:_PAIRS], catalogues[:_PAIRS]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
