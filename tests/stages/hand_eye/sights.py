"""Pictures of a board as a camera would have taken them whose place is known."""

from collections.abc import Iterator

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.camera import intrinsics, project
from stages.geometry.poses import exp_so3, inverse, pose
from stages.hand_eye.board import Board
from stages.hand_eye.solving import Sight

BOARD = Board()
K = intrinsics(600, 640, 480)
X = pose(exp_so3(np.array([2.1, -0.4, 0.9])), np.array([-0.1, 0.5, 0.8]))
ALL = np.eye(3)
Y = pose(exp_so3(np.array([-0.3, 1.7, 0.2])), np.array([0.05, 0.02, 0.13]))


def boards(count: int, rng: np.random.Generator, *, axes: Floats, degrees: float = 35.0) -> Iterator[Floats]:
    """T_camera_board of boards in view, turned about some of the axes (rows)."""
    for _ in range(count):
        turn = rng.uniform(-1, 1, len(axes)) @ axes * np.deg2rad(degrees)
        yield pose(exp_so3(turn), rng.uniform((-0.15, -0.1, 0.5), (0.15, 0.1, 0.9)))


def sights(
    count: int,
    seed: int,
    *,
    noise: float = 0.2,
    axes: Floats = ALL,
    degrees: float = 35.0,
    square: float = 1.0,
) -> list[Sight]:
    """``noise`` in pixels; ``square``: how much larger the print is than is said."""
    rng = np.random.default_rng(seed)
    found: list[Sight] = []
    for B in boards(count, rng, axes=axes, degrees=degrees):
        points = BOARD.corners * square
        pixels = project(points @ B[:3, :3].T + B[:3, 3], K) + rng.normal(0, noise, (len(points), 2))
        found.append(Sight(X @ B @ inverse(Y), BOARD.corners, pixels, K))
    return found
