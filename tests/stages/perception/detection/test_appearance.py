"""Crops keep shape and colours; likenesses of equal pieces are one."""

import numpy as np
import pytest

from stages.perception.detection.appearance import Looks, square
from stages.perception.detection.backbone import SIDE


def piece(color: tuple[int, int, int], height: int = 40, width: int = 20) -> tuple[np.ndarray, np.ndarray]:
    rgb, mask = np.zeros((100, 120, 3), np.uint8), np.zeros((100, 120), bool)
    rgb[:] = (0, 255, 0)
    rgb[30 : 30 + height, 50 : 50 + width] = color
    mask[30 : 30 + height, 50 : 50 + width] = True
    return square(rgb, mask)


def test_a_crop_is_the_masks_own_part_in_the_middle_of_grey() -> None:
    crop, mask, whole = piece((200, 30, 40))
    assert crop.shape == (SIDE, SIDE, 3) and mask.shape == (SIDE, SIDE)
    assert (whole == mask).all()
    rows, columns = np.nonzero(mask)
    assert np.ptp(rows) + 1 == pytest.approx(0.92 * SIDE, abs=1)
    assert (np.ptp(rows) + 1) / (np.ptp(columns) + 1) == pytest.approx(2, abs=0.05)
    assert (rows.mean(), columns.mean()) == pytest.approx((SIDE / 2 - 0.5, SIDE / 2 - 0.5), abs=1)
    assert (crop[mask] == (200, 30, 40)).all() and (crop[~mask] == 127).all()


def test_equal_pieces_are_alike_and_colours_tell_pieces_apart() -> None:
    looks = Looks.of([piece((200, 30, 40)), piece((200, 30, 40), 60, 30), piece((30, 40, 200))])
    alike = looks.chroma @ looks.chroma.T
    assert alike[0, 0] == pytest.approx(1, abs=1e-5)
    assert alike[0, 1] > 0.99 and alike[0, 2] < 0.1
    assert (looks.outline[0] == looks.outline[1]).mean() > 0.97


def test_what_is_hidden_counts_for_the_frame_and_the_outline_alone() -> None:
    rgb, whole = np.full((100, 120, 3), (200, 30, 40), np.uint8), np.zeros((100, 120), bool)
    whole[30:70, 50:70] = True
    seen = whole & (np.arange(100) < 50)[:, None]
    part, alone = square(rgb, seen, whole), square(rgb, whole)
    assert (part.whole == alone.whole).all() and part.mask.sum() == pytest.approx(part.whole.sum() / 2, rel=0.05)
    assert (part.crop[part.mask] == (200, 30, 40)).all() and (part.crop[~part.mask] == 127).all()
    looks = Looks.of([part, alone])
    assert (looks.outline[0] == looks.outline[1]).all() and looks.covered[0].sum() < looks.covered[1].sum()
