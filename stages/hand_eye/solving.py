"""Where camera and board are, from corners in pictures: closed form, then least squares over all pictures.

A camera is fixed to one link, a board to another; the base counts as a link. With X = T_cameralink_camera,
Y = T_boardlink_board and what the encoders say, A_i = T_cameralink_boardlink, the board's pose in picture i is
B_i = X^-1 A_i Y, whichever of the two links the arm moves: eye in hand and eye to hand are one equation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from stages.geometry.arrays import Floats
from stages.geometry.camera import project
from stages.geometry.poses import exp_so3, inverse, log_so3, pose, rotation_angle, small_motion

_SURE = 1.0
"""Pixels beyond which a corner counts less and less: it is not where it was found."""
_NOISE = 0.1
"""Pixels by which corners are off at least; so few pictures that fit by chance do not look exact."""


@dataclass(frozen=True, eq=False)
class Sight:
    """One picture of the board."""

    A: Floats
    """T_cameralink_boardlink (4 x 4), from the encoders."""
    points: Floats
    """K x 3: the corners that are seen, in the board frame, metres."""
    pixels: Floats
    """K x 2: where they are seen."""
    K: Floats
    """Intrinsics of the camera, 3 x 3."""

    @property
    def T_camera_board(self) -> Floats:
        """B_i from this picture alone (perspective n points), 4 x 4."""
        library: Any = cv2
        _, turn, t = library.solvePnP(self.points, self.pixels, self.K, np.zeros(0), flags=cv2.SOLVEPNP_ITERATIVE)
        return pose(exp_so3(turn.ravel()), t.ravel())

    def errors(self, X: Floats, Y: Floats) -> Floats:
        """K x 2: pixels from where the corners are seen to where they would be."""
        T = inverse(X) @ self.A @ Y
        return project(self.points @ T[:3, :3].T + T[:3, 3], self.K) - self.pixels


@dataclass(frozen=True, eq=False)
class Fit:
    """What explains all pictures best."""

    X: Floats
    """T_cameralink_camera, 4 x 4."""
    Y: Floats
    """T_boardlink_board, 4 x 4."""
    residuals: Floats
    """Root mean square of a corner's error in each picture, pixels."""
    covariance: Floats
    """6 x 6, of the camera's turn (radians) and position (metres) in its own frame."""

    @property
    def residual(self) -> float:
        """Over all pictures, pixels."""
        return float(np.sqrt((self.residuals**2).mean()))

    @property
    def uncertain(self) -> tuple[float, float]:
        """Standard deviations of the camera's position and turn: metres and radians."""
        variances = np.diag(self.covariance)
        return float(np.sqrt(variances[3:].sum())), float(np.sqrt(variances[:3].sum()))


def solve(sights: Sequence[Sight]) -> Fit:
    """The fit to at least three pictures, from boards that are turned about at least two axes.

    Starts where the linear equations of M. Shah, "Solving the Robot-World/Hand-Eye Calibration Problem Using the
    Kronecker Product" (2013), have their solution, and needs no guess.
    """
    B, A = [sight.T_camera_board for sight in sights], [sight.A for sight in sights]
    # R_X R_B = R_A R_Y, column by column: both rotations are the null vector of this matrix, up to a common factor.
    equations = [
        np.hstack([np.kron(b[:3, :3].T, np.eye(3)), -np.kron(np.eye(3), a[:3, :3])]) for b, a in zip(B, A, strict=True)
    ]
    null = np.linalg.svd(np.concatenate(equations))[2][-1]
    null *= np.sign(np.linalg.det(null[:9].reshape(3, 3)))
    R_X, R_Y = (_nearest_rotation(one.reshape(3, 3).T) for one in (null[:9], null[9:]))
    left = np.concatenate([np.hstack([np.eye(3), -a[:3, :3]]) for a in A])
    right = np.concatenate([a[:3, 3] - R_X @ b[:3, 3] for b, a in zip(B, A, strict=True)])
    t: Floats = np.linalg.lstsq(left, right)[0].astype(np.float64)
    return refined(sights, pose(R_X, t[:3]), pose(R_Y, t[3:]))


def refined(sights: Sequence[Sight], X: Floats, Y: Floats) -> Fit:
    """The fit that is least squares from here on: every corner of every picture counts, outliers less."""

    def errors(steps: Floats) -> Floats:
        moved = X @ small_motion(steps[:6]), Y @ small_motion(steps[6:])
        return np.concatenate([sight.errors(*moved).ravel() for sight in sights])

    found: Any = least_squares(errors, np.zeros(12), loss="soft_l1", f_scale=_SURE)
    best = X @ small_motion(found.x[:6]), Y @ small_motion(found.x[6:])
    residuals = np.array([np.sqrt((sight.errors(*best) ** 2).sum(1).mean()) for sight in sights])
    variance = max(2 * found.cost / max(found.fun.size - 12, 1), _NOISE**2)
    return Fit(*best, residuals, variance * np.linalg.pinv(found.jac.T @ found.jac)[:6, :6])


def left_out(sights: Sequence[Sight], fit: Fit) -> Floats:
    """N x 2: how far the board is from where the fit to all other pictures has it; metres and radians."""
    found: list[tuple[float, float]] = []
    for k, sight in enumerate(sights):
        others = refined([*sights[:k], *sights[k + 1 :]], fit.X, fit.Y)
        seen, told = sight.T_camera_board, inverse(others.X) @ sight.A @ others.Y
        apart = float(np.linalg.norm(seen[:3, 3] - told[:3, 3]))
        found.append((apart, float(rotation_angle(seen[:3, :3], told[:3, :3]))))
    return np.array(found)


def turns(sights: Sequence[Sight]) -> tuple[Floats, Floats]:
    """By how much the boards are turned against each other about three axes that are at right angles.

    Root mean squares over all pairs (3, radians, the largest first), and the axes (3 x 3, a row each) in the frame of
    the board's link.
    """
    R = np.stack([sight.A[:3, :3] for sight in sights])
    pairs = np.array(list(combinations(range(len(R)), 2)))
    between = log_so3(np.swapaxes(R[pairs[:, 0]], 1, 2) @ R[pairs[:, 1]])
    _, spread, axes = np.linalg.svd(between, full_matrices=False)
    return spread / np.sqrt(len(pairs)), axes


def _nearest_rotation(M: Floats) -> Floats:
    U, _, V = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
