"""The benchmark of flips: its looks and its table."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.common.datasets import Truth
from benchmarks.comparison.accuracy import Score
from benchmarks.perception.flips import Pair, is_flipped, looks, table
from tests.stages.perception.scenes import CATALOGUE


def scored(degrees: float, adds: float = 0.002) -> Score:
    return Score(Truth((1, 0), 8, np.eye(4)), adds, 0.001, np.deg2rad(degrees))


def test_a_flip_has_the_right_shape_and_the_wrong_rotation() -> None:
    assert is_flipped(scored(179)) and is_flipped(scored(16))
    assert not is_flipped(scored(14)) and not is_flipped(scored(179, adds=0.02))


def test_the_table_counts_flips_by_object() -> None:
    right, wrong = scored(2), scored(178)
    found = [Pair("soup_can", wrong, wrong, right), Pair("soup_can", wrong, right, right), Pair("cup", *[right] * 3)]
    lines = table({"looks": found}).splitlines()
    assert lines[2:] == ["| looks | soup_can | 2 | 2 | 1 | 0 |", "| looks | **all** | 3 | 2 | 1 | 0 |"]


def test_looks_have_boxes_around_what_rests_on_the_table() -> None:
    (image,) = looks(CATALOGUE, 1)
    assert image.n_objects == len(image.boxes) == len(image.truths) == 5
    names = {item.label: item for item in CATALOGUE.objects.values()}
    assert image.frame.T_base_camera is not None
    for box, truth in zip(image.boxes, image.truths, strict=True):
        item = names[truth.label]
        assert item.name == box.label
        centre = truth.T_camera_object @ np.append(item.bounds.mean(0), 1)
        u, v = (image.K @ centre[:3])[:2] / centre[2]
        assert box.box[0] < u < box.box[2] and box.box[1] < v < box.box[3]
        T_base_object = image.frame.T_base_camera @ truth.T_camera_object
        lowest = (item.mesh.vertices @ T_base_object[2, :3]).min() + T_base_object[2, 3]
        assert lowest == pytest.approx(0.7, abs=1e-6)
