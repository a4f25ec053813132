"""How many objects the detector by meshes finds: `python -m benchmarks.candidates DATASET [--learned FILE]`."""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.common.command import command
from benchmarks.common.datasets import Truth, truths_by_image
from runner.contract import Refused
from runner.testing import run_stage
from stages.detector import ModelDetector
from stages.devices.bop import BopImage, read_dataset
from stages.messages import Candidates, Frame
from stages.perception.detection.boxes import intersection_over_union
from stages.scene.catalogue import Catalogue

_VISIBLE = 1 / 3
"""Of an object's silhouette that must be seen for it to count."""
_OVERLAP = 0.5
_RANKS = (5, 10, 20, 40)


@dataclass(frozen=True)
class Found:
    """What became of one object."""

    sensor: str
    rank: float
    """Place of the first candidate with its label and box, from 1; infinite where there is none."""
    precise: bool
    """Whether a candidate of its label overlaps it by more than three quarters."""
    top: bool
    """Whether its label is the most likely one of the box that overlaps it most."""


def found(truth: Truth, candidates: Candidates, label: str, sensor: str) -> Found:
    """The fate of one object, whose box the data set gives."""
    assert truth.box is not None
    boxes = np.array([candidate.box for candidate in candidates.candidates]).reshape(-1, 4)
    overlaps = intersection_over_union(truth.box[None], boxes)[0]
    right = np.array([candidate.label == label for candidate in candidates.candidates], bool)
    hits = np.flatnonzero(right & (overlaps > _OVERLAP))
    likely = [candidates.labels[int(row.argmax())] for row in candidates.confidences]
    return Found(
        sensor=sensor,
        rank=float(hits[0]) + 1 if len(hits) else np.inf,
        precise=bool((right & (overlaps > 0.75)).any()),
        top=bool(likely) and likely[int(overlaps.argmax())] == label,
    )


def table(rows: Sequence[Found], most: int) -> str:
    """Recall by sensor and of all together."""
    ranks = [rank for rank in _RANKS if rank < most] + [most]
    groups: dict[str, list[Found]] = defaultdict(list)
    for row in rows:
        groups[row.sensor].append(row)
    if len(groups) > 1:
        groups["all"] = list(rows)
    head = ["sensor", "objects", *(f"among {rank}" for rank in ranks), f"IoU > 0.75 among {most}", "top label right"]
    lines = [_line(head), _line(["---"] * len(head))]
    for sensor, group in groups.items():
        shares = [np.mean([row.rank <= rank for row in group]) for rank in ranks]
        shares += [np.mean([row.precise for row in group]), np.mean([row.top for row in group])]
        lines.append(_line([sensor, str(len(group)), *(f"{share:.3f}" for share in shares)]))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def sensor_of(image: BopImage) -> str:
    """What the data set calls the sensor of an image (``sensor`` in the scene's source.json), else its focal length."""
    source = image.rgb.parents[1] / "source.json"
    text = json.loads(source.read_text()).get("sensor", "") if source.is_file() else ""
    return " ".join(text.replace(",", " ").split()[:2]) or f"f = {image.K[0, 0]:.0f} pixels"


def _frame(image: BopImage, index: int, total: int) -> Frame:
    rgb, depth = image.read()
    name = f"{image.scene_id:06d}/{image.image_id:06d}"
    ids = {"scene_id": image.scene_id, "image_id": image.image_id, "index": index, "total": total}
    return Frame(rgb=rgb, depth=depth, K=image.K, T_base_camera=None, robot_mask=None, name=name, **ids)


def picture(image: BopImage, candidates: Candidates, truths: Sequence[Truth]) -> Image.Image:
    """The image with the true boxes (white) and the candidates, the more confident the brighter."""
    drawn = Image.fromarray(image.read()[0])
    draw = ImageDraw.Draw(drawn)
    for candidate in reversed(candidates.candidates):
        shade = (255, int(255 * min(1.0, 1.3 * candidate.confidence)), 0)
        draw.rectangle(tuple(candidate.box.tolist()), outline=shade, width=2)
        x, y = candidate.box[:2].tolist()
        draw.text((x + 4, y + 3), f"{candidate.label} {candidate.confidence:.2f}", fill=shade)
    for box in (truth.box for truth in truths if truth.box is not None):
        draw.rectangle(tuple(box.tolist()), outline="white", width=1)
    return drawn


def looked_at(dataset: Path, detector: ModelDetector) -> Iterator[tuple[BopImage, Candidates, float]]:
    """Every image with its candidates and the seconds they took."""
    images = read_dataset(dataset)
    for index, image in enumerate(images):
        frame = _frame(image, index, len(images))
        began = time.perf_counter()
        (candidates,) = run_stage(detector, [frame], name="detector", log=lambda *_: None)
        yield image, candidates, time.perf_counter() - began


@command
def main() -> int:
    """Prints a line for every image, what was missed, and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="BOP data set folder with scene_gt_info.json")
    parser.add_argument("--catalogue", type=Path, help="by default the data set's models")
    parser.add_argument("--learned", type=Path, help="by default the catalogue is learned now and kept in the cache")
    parser.add_argument("--most", type=int, default=20, help="candidates an image")
    parser.add_argument("--pictures", type=Path, help="folder for every image with its candidates and true boxes")
    options = parser.parse_args()
    path = options.catalogue or options.dataset / "models"
    names = {item.label: name for name, item in Catalogue.shared(path).objects.items()}
    config = ModelDetector.Config(catalogue=path, learned=options.learned, max_candidates=options.most)
    truths = truths_by_image(options.dataset)
    rows: list[Found] = []
    for image, candidates, seconds in looked_at(options.dataset, ModelDetector(config)):
        seen = [truth for truth in truths[image.scene_id, image.image_id] if truth.visible >= _VISIBLE]
        if any(truth.box is None for truth in seen):
            raise Refused(f"{options.dataset}: scene_gt_info.json of scene {image.scene_id} has no bbox_visib")
        fates = [found(truth, candidates, names[truth.label], sensor_of(image)) for truth in seen]
        missed = [names[truth.label] for truth, fate in zip(seen, fates, strict=True) if np.isinf(fate.rank)]
        print(
            f"{image.scene_id}/{image.image_id}: {len(seen)} objects, {seconds:.2f} s", *missed and ["missed", *missed]
        )
        rows += fates
        if options.pictures:
            options.pictures.mkdir(parents=True, exist_ok=True)
            picture(image, candidates, seen).save(options.pictures / f"{image.scene_id:06d}-{image.image_id:06d}.png")
    print(table(rows, options.most))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
