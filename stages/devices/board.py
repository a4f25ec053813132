"""A calibration board in the simulated world: where it truly is, and how it looks."""

from __future__ import annotations

from functools import cache

import numpy as np

from stages.devices.suites.suite import Kind, Suite
from stages.devices.tabletop import Layout
from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, pose
from stages.hand_eye.board import Board
from stages.hand_eye.rig import Rig
from stages.robots import Robot, Table
from stages.scene.catalogue import Mesh

_SHIFT, _TURN = 0.02, np.deg2rad(4)
"""Metres and radians by which the board is not where it is said to be, along and about each axis."""
_INK, _PAPER = 25, 240
_RIM, _BEHIND = 0.01, 0.0005
"""Metres of paper around the pattern, and by which the paper lies behind the ink."""


class Bare(Suite):
    """A table with nothing on it."""

    names = ()

    def __init__(self, table: Table, *, joints: float) -> None:
        self.table, self.joints = table, joints

    def sample(self, kind: Kind, rng: np.random.Generator) -> Layout:
        """Nothing."""
        return {}


class TrueBoard:
    """A board that somebody put into the hand, or flat on the table, not quite as described."""

    def __init__(self, robot: Robot, board: Board, rng: np.random.Generator) -> None:
        rig = Rig(robot, board)
        turn, shift = _TURN * rng.uniform(-1, 1, 3), _SHIFT * rng.uniform(-1, 1, 3)
        if not rig.held:
            turn[:2], shift[2] = 0.0, 0.0
        self._link = rig.link
        self.T_link_board = pose(exp_so3(turn) @ rig.Y[:3, :3], rig.Y[:3, 3] + shift)
        """4 x 4, in the frame of what it is fixed to."""
        self.robot = rig.with_board(self.T_link_board)

    def place(self, positions: Floats) -> Floats:
        """T_base_board (4 x 4) at true positions of the robot's joints."""
        if not self._link:
            return self.T_link_board
        return self.robot.body.link_poses(self.robot.joint_names, positions)[self._link] @ self.T_link_board


@cache
def print_of(board: Board) -> Mesh:
    """Ink on paper, in the board frame."""
    width, height = board.size / 2 + _RIM
    paper = np.array([[-width, -height, width, height]])
    parts = [_front(board.ink, 0.0, _INK), _front(paper, _BEHIND, _PAPER), _back(paper, 2 * _BEHIND)]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]).astype(np.int32),
        np.concatenate([part.colors for part in parts]),
    )


def _front(rectangles: Floats, z: float, grey: int) -> Mesh:
    """Rectangles (M x 4: left, upper, right, lower) that face the viewer."""
    corners = rectangles[:, [[0, 1], [0, 3], [2, 3], [2, 1]]].reshape(-1, 2)
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (4 * np.arange(len(rectangles))[:, None, None] + halves).reshape(-1, 3).astype(np.int32)
    vertices = np.column_stack([corners, np.full(len(corners), z)])
    return Mesh(vertices, faces, np.full((len(vertices), 3), grey, np.uint8))


def _back(rectangles: Floats, z: float) -> Mesh:
    mesh = _front(rectangles, z, _PAPER)
    return Mesh(mesh.vertices, mesh.faces[:, ::-1], mesh.colors)
