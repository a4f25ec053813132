"""The ChArUco board: how it is printed, and its corners in a picture."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.messages.arrays import Rgb

_INCH, _DPI = 0.0254, 300
_FEWEST = 8
"""Corners of a board that is seen: with fewer, or all in one row, its pose is anyone's guess."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A chessboard whose white squares hold markers; lengths in metres, measured on the print.

    The board frame: origin in the middle of the pattern, x right, y down, z into the board.
    """

    columns: int = 7
    rows: int = 5
    """Squares of the chessboard."""
    square: float = 0.04
    marker: float = 0.03
    """Edges of a square and of a marker."""
    dictionary: str = "4X4_50"
    """OpenCV's name of the markers."""
    position: tuple[float, ...] = ()
    rotation: tuple[float, ...] = ()
    """Roughly where the board is, so that it is looked for there: metres, and roll, pitch and yaw in degrees about
    fixed x, y and z; in the hand frame where the hand holds it, else in the base frame. Empty: held between the
    fingertips by the middle of its upper edge, or flat on the table in the middle of the workspace."""

    def __post_init__(self) -> None:
        """Refuses boards that nobody can print."""
        if min(self.columns, self.rows) < 3:
            raise Refused(f"board: {self.columns} x {self.rows} squares are too few; at least 3 x 3 are needed")
        if not 0 < self.marker < self.square:
            raise Refused(f"board.marker = {self.marker:g}: must lie between 0 and board.square = {self.square:g}")
        if not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            valid = ", ".join(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_"))
            raise Refused(f"board.dictionary = {self.dictionary!r} is not known; valid: {valid}")
        for key in ("position", "rotation"):
            if len(getattr(self, key)) not in (0, 3):
                raise Refused(f"board.{key} = {list(getattr(self, key))}: three numbers are needed")

    @property
    def size(self) -> Floats:
        """Width and height of the pattern, metres."""
        return np.array([self.columns, self.rows]) * self.square

    @property
    def corners(self) -> Floats:
        """N x 3: the inner corners of the chessboard in the board frame, by id."""
        return np.asarray(_printed(self).getChessboardCorners(), np.float64) - np.append(self.size / 2, 0)

    @property
    def rim(self) -> Floats:
        """4 x 3: the outer corners of the pattern in the board frame."""
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return np.column_stack([signs * self.size / 2, np.zeros(4)])

    @property
    def ink(self) -> Floats:
        """M x 4: left, upper, right and lower edge of the black rectangles of which the pattern consists."""
        printed = _printed(self)
        markers = np.asarray(printed.getObjPoints())[:, 0, :2] - self.size / 2
        squares = np.stack(np.meshgrid(np.arange(self.columns), np.arange(self.rows)), -1).reshape(-1, 2)
        squares = squares * self.square - self.size / 2
        white = (np.abs(squares[:, None] - markers).max(-1) < self.square / 2).any(-1)
        found = [np.hstack([squares[~white], squares[~white] + self.square])]
        modules = printed.getDictionary().markerSize + 2
        step = self.marker / modules
        for id, corner in zip(printed.getIds().ravel(), markers, strict=True):
            dark = np.argwhere(printed.getDictionary().generateImageMarker(int(id), modules) == 0)[:, ::-1] * step
            found.append(np.hstack([corner + dark, corner + dark + step]))
        return np.concatenate(found)

    def print(self, pixels: int) -> NDArray[np.uint8]:
        """The pattern as a grey image, ``pixels`` to a square."""
        return np.asarray(_printed(self).generateImage((self.columns * pixels, self.rows * pixels)))

    def find(self, rgb: Rgb) -> tuple[NDArray[np.intp], Floats] | None:
        """Ids of the corners that a picture shows (K) and where, pixels (K x 2); None where there is no board in it."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        found, ids, _, _ = _detector(self).detectBoard(grey)
        if ids is None or len(ids) < _FEWEST:
            return None
        ids = np.asarray(ids, np.intp).ravel()
        rows = np.unique(ids // (self.columns - 1)), np.unique(ids % (self.columns - 1))
        return (ids, np.asarray(found, np.float64).reshape(-1, 2)) if min(map(len, rows)) > 1 else None


def picture(board: Board) -> Image.Image:
    """The board with a white margin, to be printed without any scaling."""
    pixels = round(board.square / _INCH * _DPI)
    image = Image.fromarray(np.pad(board.print(pixels), pixels // 4, constant_values=255))
    image.info["dpi"] = (pixels * _INCH / board.square,) * 2
    return image


def main() -> None:
    """Reads the command line and writes the picture."""
    parser = argparse.ArgumentParser(
        description="Writes a board to be printed: python -m stages.hand_eye.board OUT.png"
    )
    parser.add_argument("out", type=Path, metavar="OUT.png")
    for key in ("columns", "rows", "square", "marker", "dictionary"):
        default = Board.__dataclass_fields__[key].default
        parser.add_argument(f"--{key}", type=type(default), default=default)
    options = vars(parser.parse_args())
    out = options.pop("out")
    image = picture(Board(**options))
    image.save(out, dpi=image.info["dpi"])


@cache
def _printed(board: Board) -> Any:
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    return cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, markers)


@cache
def _detector(board: Board) -> Any:
    return cv2.aruco.CharucoDetector(_printed(board))


if __name__ == "__main__":
    main()
