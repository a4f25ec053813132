"""A photograph lies where depth does afterwards, and is as bright as views are."""

import numpy as np
import pytest

from stages.perception.detection.alignment import aligned
from tests.stages.perception.detection.scenes import NAMES, photograph


@pytest.mark.parametrize("beside", [(4, -3), (-5, 2), (0, 6)])
def test_colour_that_lies_beside_depth_is_moved_onto_it(beside: tuple[int, int]) -> None:
    seen = photograph(*NAMES)
    straight = aligned(seen.rgb, seen.depth)
    moved = aligned(np.roll(seen.rgb, beside, (0, 1)), seen.depth)
    near = [np.abs(moved.astype(float) - np.roll(straight, (y, x), (0, 1)))[20:-20, 20:-20].mean()
            for y in (-1, 0, 1) for x in (-1, 0, 1)]  # fmt: skip
    assert min(near) < 1


def test_what_shows_no_outline_stays_where_it_is() -> None:
    rgb = np.full((48, 64, 3), 90, np.uint8)
    rgb[10:20, 10:20] = 242
    np.testing.assert_array_equal(aligned(rgb, np.ones((48, 64), np.float32)), rgb)


def test_a_dark_photograph_becomes_as_bright_as_a_well_exposed_one() -> None:
    seen = photograph(*NAMES)
    dark = aligned((seen.rgb * 0.6).astype(np.uint8), seen.depth)
    assert np.abs(dark.astype(float) - aligned(seen.rgb, seen.depth)).mean() < 2
