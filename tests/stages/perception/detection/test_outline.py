"""An outline shows where the photograph changes, and only what is free of other things tells."""

import numpy as np
import pytest

from stages.messages.digest import DepthPatch
from stages.perception.detection.outline import faintness

DISTANCE = 0.8
LOOK = DepthPatch(
    left=40, top=30, inverse=np.full((60, 80), 1 / DISTANCE, np.float32), change=np.zeros((60, 80), np.float32)
)
"""Rows 60 to 180 and columns 80 to 240 of 240 x 320 pixels."""


def photograph(*, shown_from: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """A red thing on grey from a column on, and its depth before a plane."""
    rgb, depth = np.full((240, 320, 3), 120, np.uint8), np.full((240, 320), 1.0, np.float32)
    rgb[60:180, shown_from:240] = 170, 60, 50
    depth[60:180, 80:240] = DISTANCE
    return rgb, depth


@pytest.mark.parametrize(("shown_from", "share"), [(80, 0.0), (240, 1.0), (160, 0.5)])
def test_a_border_without_a_change_of_colour_is_faint(shown_from: int, share: float) -> None:
    rgb, depth = photograph(shown_from=shown_from)
    assert faintness([LOOK], rgb, depth)[0] == pytest.approx(share, abs=0.06)


def test_what_stands_in_front_has_the_border_to_itself() -> None:
    rgb, depth = photograph(shown_from=160)
    depth[:, :80] = 0.5
    depth[:60, :160] = depth[180:, :160] = 0.5
    assert faintness([LOOK], rgb, depth)[0] == pytest.approx(0, abs=0.06)


def test_nothing_is_told_of_an_outline_that_others_hide_or_the_image_cuts() -> None:
    rgb, _ = photograph()
    assert np.isnan(faintness([LOOK], rgb, np.full((240, 320), 0.5, np.float32))).all()
    everything = DepthPatch(
        left=0, top=0, inverse=np.ones((120, 160), np.float32), change=np.zeros((120, 160), np.float32)
    )
    assert np.isnan(faintness([everything], rgb, np.ones((240, 320), np.float32))).all()
