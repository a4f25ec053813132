"""Reads detections in BOP format: a JSON list of boxes with scene, image, category and score."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from runner.contract import Refused


@dataclass(frozen=True)
class Detection:
    """One box of one image."""

    scene_id: int
    image_id: int
    label: str
    score: float
    """From 0 to 1."""
    box: NDArray[np.float64]
    """x0, y0, x1, y1 in pixels."""


class _Entry(msgspec.Struct, frozen=True):
    """An element of the file; other keys (``time``, ``segmentation``) are left aside."""

    scene_id: int
    image_id: int
    category_id: int
    score: float
    bbox: tuple[float, float, Annotated[float, msgspec.Meta(gt=0)], Annotated[float, msgspec.Meta(gt=0)]]
    """x, y, width, height."""


def read_detections(path: Path, names: Mapping[int, str]) -> Iterator[Detection]:
    """The file's boxes in its order; ``names`` maps category numbers to labels.

    Raises :class:`Refused` naming file, entry and what is wrong, or the category numbers that are known.
    """
    try:
        entries = msgspec.json.decode(path.read_bytes(), type=list[_Entry])
    except OSError as error:
        raise Refused(f"{path}: cannot be read ({error.strerror})") from None
    except msgspec.MsgspecError as error:
        raise Refused(f"{path}: not BOP detections: {error}") from None
    for number, entry in enumerate(entries):
        if entry.category_id not in names:
            known = ", ".join(str(category) for category in sorted(names))
            raise Refused(f"{path}: entry {number}: category_id {entry.category_id} is none of {known}")
        x, y, width, height = entry.bbox
        if not math.isfinite(x + y + width + height):
            raise Refused(f"{path}: entry {number}: numbers must be finite")
        if not 0 <= entry.score <= 1:
            raise Refused(f"{path}: entry {number}: score {entry.score:g} must lie from 0 to 1")
        box = np.array([x, y, x + width, y + height])
        yield Detection(entry.scene_id, entry.image_id, names[entry.category_id], entry.score, box)
