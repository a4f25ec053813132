"""The arm as a chain of joints, and postures that bring the hand to a pose.

Compiled, and apart from the simulator: planning asks for thousands of postures.
"""

# ruff: noqa: PLR0917
# Compiled functions take arrays by position.

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import atan2, cos, sin
from typing import Any

import mujoco
import numba
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.geometry.poses import pose

POSITION_TOLERANCE = 5e-4
"""Metres per axis at which inverse kinematics is content."""
ROTATION_TOLERANCE = 3e-3
"""Radians per axis at which inverse kinematics is content."""

_DAMPING = 1e-4
_LARGEST_STEP = 0.4
"""Radians that one joint may move in one step of inverse kinematics."""
_PATIENCE, _PROGRESS = 10, 0.97
"""Inverse kinematics gives up where so many steps leave more than this share of the error: out of reach."""


@dataclass(frozen=True)
class Chain:
    """J joints between the base and the hand, the base's first.

    Joint positions (J) are in the order of the robot's description, ``order`` says which of them each joint has.
    """

    order: NDArray[np.int64]
    links: Floats
    """(J + 1) x 4 x 4: from each joint's frame (the base's first) to the next one's (the hand's last), at zero."""
    axes: Floats
    """J x 3, unit vectors in the joints' frames."""
    slides: NDArray[np.bool_]
    """J: which joints move along their axis instead of turning about it."""
    zeros: Floats
    """J: positions at which :attr:`links` holds."""
    lower: Floats
    upper: Floats
    """J: limits."""

    @staticmethod
    def of(
        model: Any, joints: Sequence[str], hand: str, still: Mapping[str, float], limits: tuple[Floats, Floats]
    ) -> Chain:
        """The joints of a MuJoCo model that lead to a body; others than ``joints`` on the way are ``still``."""
        order, links, axes, slides, zeros = [], [], [], [], []
        frame = np.eye(4)
        for body in _path(model, hand):
            frame = frame @ pose(_rotation(model.body_quat[body]), model.body_pos[body])
            for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
                name, axis, at = model.joint(joint).name, model.jnt_axis[joint], np.eye(4)
                at[:3, 3] = model.jnt_pos[joint]
                slide, zero = (
                    model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE,
                    model.qpos0[model.jnt_qposadr[joint]],
                )
                frame = frame @ at
                if name in joints:
                    order.append(joints.index(name))
                    links, axes, slides, zeros = [*links, frame], [*axes, axis], [*slides, slide], [*zeros, zero]
                    frame = np.eye(4)
                else:
                    _move(frame, axis, slide, still[name] - zero)
                at[:3, 3] *= -1
                frame = frame @ at
        lower, upper = (limit[order] for limit in limits)
        links = np.array([*links, frame])
        return Chain(np.array(order), links, np.array(axes), np.array(slides), np.array(zeros), lower, upper)

    def hand(self, q: Floats) -> Floats:
        """Forward kinematics: T_base_hand (4 x 4) at joint positions ``q`` (J)."""
        frames = np.empty((len(q) + 1, 4, 4))
        _forward(self.links, self.axes, self.slides, q[self.order] - self.zeros, frames)
        return frames[-1]

    def posture(self, T_base_hand: Floats, seed: Floats, iterations: int) -> Floats | None:
        """Joint positions (J) near ``seed`` that put the hand at a pose; None where descending does not lead there.

        Damped least squares within the joint limits (Wampler 1986).
        """
        q = np.clip(seed[self.order], self.lower, self.upper)
        limits = self.lower, self.upper
        if not _descend(self.links, self.axes, self.slides, self.zeros, *limits, T_base_hand, q, iterations):
            return None
        result = np.empty_like(q)
        result[self.order] = q
        return result


def _path(model: Any, body: str) -> list[int]:
    """Bodies from the base to one of them."""
    at, path = int(model.body(body).id), list[int]()
    while at:
        path.insert(0, at)
        at = int(model.body_parentid[at])
    return path


def _rotation(quaternion: Floats) -> Floats:
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, quaternion)
    return R.reshape(3, 3)


@numba.njit(cache=True)
def _move(T: Floats, axis: Floats, slide: bool, amount: float) -> None:
    """Moves a frame (4 x 4) along or about an axis of its own."""
    if slide:
        for i in range(3):
            T[i, 3] += amount * (T[i, 0] * axis[0] + T[i, 1] * axis[1] + T[i, 2] * axis[2])
        return
    x, y, z = axis
    c, s = cos(amount), sin(amount)
    v = 1.0 - c
    for i in range(3):
        a, b, d = T[i, 0], T[i, 1], T[i, 2]
        T[i, 0] = a * (c + x * x * v) + b * (y * x * v + z * s) + d * (z * x * v - y * s)
        T[i, 1] = a * (x * y * v - z * s) + b * (c + y * y * v) + d * (z * y * v + x * s)
        T[i, 2] = a * (x * z * v + y * s) + b * (y * z * v - x * s) + d * (c + z * z * v)


@numba.njit(cache=True)
def _forward(links: Floats, axes: Floats, slides: Any, q: Floats, frames: Floats) -> None:
    """The frame of every joint once it has moved, and the hand's: (J + 1) x 4 x 4, into ``frames``."""
    for k in range(len(links)):
        for i in range(4):
            for j in range(4):
                if k == 0:
                    frames[k, i, j] = links[0, i, j]
                else:
                    total = 0.0
                    for m in range(4):
                        total += frames[k - 1, i, m] * links[k, m, j]
                    frames[k, i, j] = total
        if k < len(q):
            _move(frames[k], axes[k], slides[k], q[k])


@numba.njit(cache=True)
def _error(current: Floats, target: Floats, error: Floats) -> None:
    """Twist (6) in the base frame that leads from one pose to another in unit time, into ``error``."""
    turn = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for m in range(3):
                turn[i, j] += target[i, m] * current[j, m]
    x, y, z = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    sine = 0.5 * (x * x + y * y + z * z) ** 0.5
    angle = atan2(sine, 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0))
    scale = 0.5 * angle / sine if sine > 1e-9 else 0.5
    for i in range(3):
        error[i] = target[i, 3] - current[i, 3]
    error[3], error[4], error[5] = scale * x, scale * y, scale * z


@numba.njit(cache=True)
def _jacobian(frames: Floats, axes: Floats, slides: Any, J: Floats) -> None:
    """6 x J: linear then angular velocity of the hand in the base frame, into ``J``."""
    for k in range(len(axes)):
        axis, arm = np.zeros(3), frames[-1, :3, 3] - frames[k, :3, 3]
        for i in range(3):
            for m in range(3):
                axis[i] += frames[k, i, m] * axes[k, m]
        if slides[k]:
            J[:3, k], J[3:, k] = axis, 0.0
        else:
            J[0, k] = axis[1] * arm[2] - axis[2] * arm[1]
            J[1, k] = axis[2] * arm[0] - axis[0] * arm[2]
            J[2, k] = axis[0] * arm[1] - axis[1] * arm[0]
            J[3:, k] = axis


@numba.njit(cache=True)
def _descend(
    links: Floats,
    axes: Floats,
    slides: Any,
    zeros: Floats,
    lower: Floats,
    upper: Floats,
    target: Floats,
    q: Floats,
    iterations: int,
) -> bool:
    """Moves ``q`` (J) until the hand is at ``target``; False where it does not get there."""
    frames, J, error = np.empty((len(links), 4, 4)), np.empty((6, len(q))), np.empty(6)
    damping = _DAMPING * np.eye(6)
    least = np.inf
    for k in range(iterations):
        _forward(links, axes, slides, q - zeros, frames)
        _error(frames[-1], target, error)
        if k % _PATIENCE == 0:
            left = np.abs(error).max()
            if left > _PROGRESS * least:
                return False
            least = left
        if np.abs(error[:3]).max() < POSITION_TOLERANCE and np.abs(error[3:]).max() < ROTATION_TOLERANCE:
            return True
        _jacobian(frames, axes, slides, J)
        step = J.T @ np.linalg.solve(J @ J.T + damping, error)
        step *= min(1.0, _LARGEST_STEP / max(np.abs(step).max(), 1e-9))
        for i in range(len(q)):
            q[i] = min(max(q[i] + step[i], lower[i]), upper[i])
    return False
