"""The board: printed and simulated alike, and found in pictures."""

import numpy as np
import pytest

from runner.contract import Refused
from stages.devices.board import print_of
from stages.geometry.camera import intrinsics, project
from stages.geometry.poses import exp_so3, pose
from stages.hand_eye.board import Board
from stages.perception.rendering.renderer import Camera, Item, Renderer

BOARD = Board()


def test_ink_is_what_is_printed() -> None:
    pixels = 48
    drawn = np.full((BOARD.rows * pixels, BOARD.columns * pixels), 255, np.uint8)
    for x0, y0, x1, y1 in np.round((BOARD.ink + np.tile(BOARD.size / 2, 2)) / BOARD.square * pixels).astype(int):
        drawn[y0:y1, x0:x1] = 0
    assert (drawn != BOARD.print(pixels)).mean() < 1e-3


def test_corners_are_found_where_they_are() -> None:
    K = intrinsics(600, 640, 480)
    T = pose(exp_so3(np.array([0.4, -0.3, 0.7])), np.array([0.03, -0.02, 0.6]))
    renderer = Renderer(640, 480)
    # The mesh stands in the camera's own frame.
    rgb = renderer.color([Item(print_of(BOARD), T)], Camera(K, np.eye(4)), background=(120, 120, 120))
    renderer.close()
    found = BOARD.find(rgb)
    assert found is not None
    ids, pixels = found
    assert len(ids) == len(BOARD.corners) == 24
    errors = pixels - project(BOARD.corners[ids] @ T[:3, :3].T + T[:3, 3], K)
    assert np.abs(errors.mean(0)).max() < 0.03 and np.sqrt((errors**2).mean()) < 0.1


def test_a_picture_without_a_board_has_none() -> None:
    assert BOARD.find(np.full((480, 640, 3), 128, np.uint8)) is None


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"columns": 2}, "board: 2 x 5 squares are too few"),
        ({"marker": 0.05}, r"board\.marker = 0\.05: must lie between 0 and board\.square = 0\.04"),
        ({"dictionary": "4X4_51"}, r"board\.dictionary = '4X4_51' is not known; valid: .*4X4_50"),
        ({"position": (1.0, 2.0)}, r"board\.position = \[1\.0, 2\.0\]: three numbers are needed"),
    ],
)
def test_boards_that_nobody_can_print_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(Refused, match=message):
        Board(**settings)  # type: ignore[arg-type]
