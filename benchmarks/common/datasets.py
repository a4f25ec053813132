"""The images of BOP data sets with the boxes of a detections file and the truth: what every benchmark iterates over."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from runner.contract import Refused
from stages.camera import DatasetCamera
from stages.detector import RecordedDetections
from stages.estimate import Quiet
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.messages import Candidate, Candidates, Frame
from stages.messages.arrays import Depth, Intrinsics, Rgb

ImageId = tuple[int, int]
"""scene_id, im_id."""


@dataclass(frozen=True)
class Truth:
    """One object as the data set has it."""

    image: ImageId
    label: int
    """BOP's obj_id."""
    T_camera_object: Floats
    """4 x 4, metres."""
    visible: float = 1.0
    """Share of its silhouette that can be seen; 1 where the data set does not say."""
    box: Floats | None = None
    """Of what can be seen: x0, y0, x1, y1 in pixels; None where the data set does not say."""
    label_known: bool = False
    """Whether the pose is also true without any symmetry: which way the label faces."""


@dataclass(frozen=True)
class Image:
    """One image with its candidate boxes; ``truths`` are for scores and figures alone."""

    frame: Frame
    candidates: Candidates
    truths: tuple[Truth, ...]

    @property
    def id(self) -> ImageId:
        """Scene and image number."""
        return self.frame.scene_id, self.frame.image_id

    @property
    def rgb(self) -> Rgb:
        """H x W x 3, sRGB."""
        return self.frame.rgb

    @property
    def depth(self) -> Depth:
        """H x W, metres, 0 where there is no reading."""
        return self.frame.depth

    @property
    def K(self) -> Intrinsics:
        """3 x 3, pixel centres at integer coordinates."""
        return self.frame.K

    @property
    def n_objects(self) -> int:
        """Objects that the data set's targets ask for in this image."""
        return self.frame.n_objects or 0

    @property
    def boxes(self) -> tuple[Candidate, ...]:
        """The candidates in the file's order: ``label``, ``confidence``, ``box`` as x0, y0, x1, y1 in pixels."""
        return self.candidates.candidates


def images(dataset: Path, detections: Path, wanted: Iterable[ImageId] | int | None = None) -> Iterator[Image]:
    """The images in the order of the targets file: all, the first ``wanted``, or those of the ids in ``wanted``.

    Raises:
        Refused: a file is missing or malformed, or an id is not in the data set.
    """
    camera = DatasetCamera(DatasetCamera.Config(dataset=dataset))
    boxes = RecordedDetections(RecordedDetections.Config(detections=detections, catalogue=dataset / "models"))
    truths = truths_by_image(dataset)
    ids = None if wanted is None or isinstance(wanted, int) else _known(wanted, truths)
    for frame in camera.source(Quiet()):
        id = frame.scene_id, frame.image_id
        if isinstance(wanted, int) and frame.index >= wanted:
            return
        if ids is None or id in ids:
            yield Image(frame, boxes.on_frame(frame, Quiet()), truths.get(id, ()))


def detections_file(dataset: Path, name: str) -> Path:
    """``exact`` or ``noisy`` name the data set's own files; anything else is a path."""
    return dataset / f"detections_{name}.json" if name in ("exact", "noisy") else Path(name)


def parse_ids(text: str) -> list[ImageId]:
    """Image ids from ``1/0,2/0`` (scene/image).

    Raises:
        Refused: the text is not of that form.
    """
    try:
        return [(int(scene), int(image)) for scene, image in (part.split("/") for part in text.split(","))]
    except ValueError:
        raise Refused(f"'{text}': images are a number (the first so many) or ids such as 1/0,2/0") from None


def parse_wanted(text: str | None) -> list[ImageId] | int | None:
    """The option ``--images``: nothing for all, a number for the first so many, or ids."""
    if text is None or text.isdecimal():
        return None if text is None else int(text)
    return parse_ids(text)


def _known(wanted: Iterable[ImageId], known: Collection[ImageId]) -> set[ImageId]:
    ids = set(wanted)
    for id in sorted(ids - set(known)):
        raise Refused(f"there is no image {id[0]}/{id[1]}; there are {', '.join(f'{s}/{i}' for s, i in sorted(known))}")
    return ids


def truths_by_image(dataset: Path) -> dict[ImageId, tuple[Truth, ...]]:
    """The truth of each image; what :func:`read_truth` reads."""
    found: dict[ImageId, tuple[Truth, ...]] = {}
    for truth in read_truth(dataset):
        found[truth.image] = (*found.get(truth.image, ()), truth)
    return found


def read_truth(dataset: Path) -> list[Truth]:
    """Every object of every image of a BOP data set.

    Raises:
        Refused: the folder has no ground truth.
    """
    files = sorted(dataset.glob("test/*/scene_gt.json"))
    if not files:
        raise Refused(f"{dataset}: no test/*/scene_gt.json; a BOP data set is expected")
    return [truth for file in files for truth in _scene_truth(file)]


def _scene_truth(file: Path) -> Iterator[Truth]:
    content: dict[str, list[dict[str, Any]]] = json.loads(file.read_text())
    more = file.with_name("scene_gt_info.json")
    infos: dict[str, list[dict[str, Any]]] = json.loads(more.read_text()) if more.is_file() else {}
    for image, items in content.items():
        for item, info in zip(items, infos.get(image, [{}] * len(items)), strict=True):
            T = pose(np.array(item["cam_R_m2c"], float).reshape(3, 3), np.array(item["cam_t_m2c"], float) / 1000)
            visible = float(info.get("visib_fract", 1.0))
            yield Truth(
                (int(file.parent.name), int(image)), int(item["obj_id"]), T, visible, _box(info),
                label_known=bool(item.get("label_known", False)),
            )  # fmt: skip


def _box(info: dict[str, Any]) -> Floats | None:
    if "bbox_visib" not in info:
        return None
    x, y, width, height = info["bbox_visib"]
    return np.array([x, y, x + width, y + height], float)
