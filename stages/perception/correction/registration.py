"""Where the depth camera is and how long its metre is, from what it reads of the robot's own surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stages.geometry.arrays import Floats, most_telling
from stages.geometry.poses import small_motion
from stages.perception.correction.body import RobotSurface
from stages.perception.rendering.rasteriser import Float32s, View

_GATES = (0.03, 0.03, 0.02, 0.012, 0.008, 0.006, 0.006)
"""Metres from the robot's surface within which a reading counts as one of it, iteration by iteration."""
_ALIKE = 30.0
"""Neighbouring readings err together: so many count as one."""
_COARSE = 4
"""Of which rows and columns every so manyth is rendered to say what a posture would show."""
_NEAREST = 0.4
"""Metres from the camera at which it begins to read."""
_LEAST_EXPLAINED = 0.8
"""Share of the readings where the robot should be that must lie on it."""
_LEAST_READ = 0.5
"""Share of the robot's surface in the image that must be far enough to be read."""
_SURPRISE = 4.0
"""Standard deviations of what was declared beyond which a correction is not believed."""


@dataclass(frozen=True)
class Posture:
    """Where the robot was and where its camera was said to be."""

    joint_names: Sequence[str]
    positions: Floats
    T_base_camera: Floats


@dataclass(frozen=True)
class Sight:
    """A look at the robot in a posture; depth is H x W metres."""

    posture: Posture
    depth: Float32s


@dataclass(frozen=True)
class Fit:
    """What explains the readings best."""

    T_believed_true: Floats
    """Where the camera is, in the frame in which it is said to be."""
    depth: float
    """Factor that makes readings metres."""
    deviations: Floats
    """7, of rotation (radians), translation (metres) and the factor."""
    residual: float
    """Metres, root mean square."""
    explained: float
    """Share of the readings where the robot should be that lie on it."""
    doubt: str
    """Why it is not to be believed; empty where it is."""


class Registration:
    """Iterated least squares on the distances of readings from the robot's surface (projective point-to-plane ICP:
    Blais and Levine 1995, Chen and Medioni 1992), with Tukey's weights and the prior of what was declared.

    Unknown are seven numbers: rotation and translation of the camera about and along its own axes, and the factor on
    depth. A reading P of the surface with normal n then moves by w x P + v + P df along n.
    """

    def __init__(self, surface: RobotSurface, view: View, prior: Floats) -> None:
        """``prior`` has the standard deviations of the seven numbers."""
        self._surface, self._view, self._prior = surface, view, prior

    def fit(self, sights: Sequence[Sight]) -> Fit:
        """The camera and its depth, from all sights together."""
        T_believed_true, factor, found = np.eye(4), 1.0, np.zeros(7)
        for gate in _GATES:
            information, pull = np.diag(self._prior**-2), -found / self._prior**2
            for sight in sights:
                J, error, weights = self._readings(sight, T_believed_true, factor)
                weights = np.where(np.abs(error) < gate, weights * (1 - (error / gate) ** 2) ** 2, 0.0)
                information += (J * weights[:, None]).T @ J
                pull -= (J * (weights * error)[:, None]).sum(0)
            change = np.asarray(np.linalg.solve(information, pull), float)
            T_believed_true = T_believed_true @ small_motion(change[:6])
            factor *= 1.0 + change[6]
            found = found + change
        return self._judged(sights, T_believed_true, factor, found)

    def _judged(self, sights: Sequence[Sight], T_believed_true: Floats, factor: float, found: Floats) -> Fit:
        """The solution with what it leaves open, and whether it explains what was read."""
        read = [self._readings(sight, T_believed_true, factor) for sight in sights]
        errors = np.concatenate([error for _, error, _ in read])
        on_it = np.abs(errors) < _GATES[-1]
        explained = float(on_it.mean()) if len(errors) else 0.0
        information = np.diag(self._prior**-2) + sum((J * weights[:, None]).T @ J for J, _, weights in read)
        return Fit(
            T_believed_true=T_believed_true,
            depth=float(factor),
            deviations=np.sqrt(np.diag(np.linalg.inv(information))),
            residual=float(np.sqrt((errors[on_it] ** 2).mean())) if explained else 0.0,
            explained=explained,
            doubt=self._doubt(explained, found),
        )

    def telling(self, postures: Sequence[Posture]) -> Iterator[int]:
        """Indices of postures, each the one that leaves least uncertainty after those before it (D-optimal)."""
        return most_telling([self._information(posture) for posture in postures], np.diag(self._prior**-2))

    def _readings(self, sight: Sight, T: Floats, factor: float) -> tuple[Floats, Floats, Floats]:
        """How distances from the surface change with the seven numbers (N x 7), the distances (N) and weights (N)."""
        posture = sight.posture
        surface = self._surface.seen(posture.joint_names, posture.positions, posture.T_base_camera @ T, self._view)
        z = sight.depth.ravel()[surface.pixels].astype(np.float64)
        read = z > 0
        points, normals = surface.points[read], surface.normals[read]
        measured = points * (factor * z[read] / points[:, 2])[:, None]
        error = ((measured - points) * normals).sum(1)
        return _change(measured, normals), error, _weights(measured)

    def _information(self, posture: Posture) -> Floats:
        """What a sight of the robot in this posture would tell of the seven numbers, 7 x 7."""
        view = self._view.sampled(0, 0, self._view.width, self._view.height, _COARSE)
        seen = self._surface.seen(posture.joint_names, posture.positions, posture.T_base_camera, view)
        read = seen.points[:, 2] > _NEAREST
        if not len(read) or read.mean() < _LEAST_READ:
            return np.zeros((7, 7))  # What is right before the camera is not read, and hides the rest.
        points = seen.points[read]
        J = _change(points, seen.normals[read])
        return _COARSE**2 * (J * _weights(points)[:, None]).T @ J

    def _doubt(self, explained: float, found: Floats) -> str:
        if explained < _LEAST_EXPLAINED:
            return f"{explained:.0%} of the readings where the arm should be lie on it; {_LEAST_EXPLAINED:.0%} must"
        surprise = np.abs(found) / self._prior
        if surprise.max() > _SURPRISE:
            names = [f"{how} {axis}" for how in ("rotation about", "shift along") for axis in "xyz"] + ["depth factor"]
            return f"{names[surprise.argmax()]} would be {surprise.max():.0f} times what is declared"
        return ""


def _change(points: Floats, normals: Floats) -> Floats:
    """Of distances along normals with the seven numbers, N x 7."""
    return np.column_stack([np.cross(points, normals), normals, (points * normals).sum(1)])


def _weights(points: Floats) -> Floats:
    """Inverse variances of readings, N."""
    return (0.001 + 0.002 * points[:, 2] ** 2) ** -2 / _ALIKE
