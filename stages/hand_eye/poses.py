"""Postures from which the camera sees the board, chosen so that together they say most about where both are."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import mujoco
import numpy as np

from stages.geometry.arrays import Floats, most_telling
from stages.geometry.camera import project
from stages.geometry.poses import exp_so3, inverse, pose, small_motion
from stages.hand_eye.rig import Rig
from stages.hand_eye.solving import Sight
from stages.planning.motion.collision import CollisionWorld, add_table
from stages.planning.motion.motion import restarts, solve_ik
from stages.robots import Robot

_ENOUGH = 5
"""So many times as many postures are found as are wanted: they are chosen from these."""
_TRIES = 300
"""Places of the board in the picture that are tried for each posture that is wanted."""
_AIMS = 3
"""Times that a place in the picture is aimed for."""
_MARGIN = 60
"""Pixels between the pattern and the edge of the picture: nobody knows yet exactly where camera and board are."""
_SMALLEST = 18.0
"""Pixels of a square's edge."""
_FILLED = 0.8
"""Share of the picture's height that the pattern's diagonal fills at most."""
_TILTED = np.deg2rad(45)
"""Turn of the board out of the picture's plane, at most."""
_NEAR = 0.6
"""Share of the places that are looked for near one that could be reached, ..."""
_TURN, _SHIFT = np.deg2rad(50), 0.08
"""... turned and shifted by up to so much; radians and metres."""
_HOUSING = 0.08
"""Metres before the camera in which nothing is in the way."""
_BOARD = "calibration_board"
_STEP = 1e-6


class Sightlines:
    """What stands between the camera and a point."""

    def __init__(self, robot: Robot) -> None:
        """``robot`` with the board, and whatever else may be in the way beside its table."""
        spec = robot.specification(seen=False)
        add_table(spec, robot.table)
        self._model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self._model)
        self._board = {geom for geom in range(self._model.ngeom) if _BOARD in self._owner(geom)}
        for name, position in robot.posture.items():
            self._data.joint(name).qpos[0] = position
        self._joints = [self._model.joint(name).qposadr[0] for name in robot.joints]

    def reach(self, q: Floats, eye: Floats, points: Floats) -> bool:
        """Whether nothing but the board lies between ``eye`` (3) and the points (N x 3), in the base frame."""
        self._data.qpos[self._joints] = q
        mujoco.mj_kinematics(self._model, self._data)
        hit = np.full(1, -1, np.int32)
        for point in points:
            way = (point - eye) / np.linalg.norm(point - eye)
            # The camera itself has a housing.
            far = mujoco.mj_ray(self._model, self._data, eye + _HOUSING * way, way, None, 1, -1, hit)
            if far >= 0 and far + _HOUSING < np.linalg.norm(point - eye) and hit[0] not in self._board:
                return False
        return True

    def _owner(self, geom: int) -> str:
        return str(self._model.body(self._model.geom_bodyid[geom]).name)


def proposed(
    rig: Rig, world: CollisionWorld, sightlines: Sightlines, count: int, rng: np.random.Generator
) -> list[Floats]:
    """Up to ``count`` postures (J each), the one that says most first.

    Places of the board in the picture are drawn, inverse kinematics finds postures for them that are free in
    ``world``, and of these each time the one is taken that adds most to the determinant of the information about
    camera and board (D-optimal design).
    """
    found: list[Floats] = []
    informations: list[Floats] = []
    for q in _in_view(rig, world, sightlines, _TRIES * count, rng):
        found.append(q)
        informations.append(_information(rig, q))
        if len(found) == _ENOUGH * count:
            break
    return [found[k] for k in islice(most_telling(informations, np.eye(12)), count)]


def nearest_first(postures: list[Floats], start: Floats) -> list[Floats]:
    """The same postures, each the nearest to the one before."""
    left, order, at = list(postures), [], start
    while left:
        distances = [float(np.abs(q - at).max()) for q in left]
        at = left.pop(int(np.argmin(distances)))
        order.append(at)
    return order


def _in_view(
    rig: Rig, world: CollisionWorld, sightlines: Sightlines, tries: int, rng: np.random.Generator
) -> Iterator[Floats]:
    """Postures that are free and in which the whole pattern is in the picture."""
    good: list[tuple[Floats, Floats]] = []
    """Places in the picture that could be reached, and how: others are looked for near them, too."""
    for _ in range(tries):
        if good and rng.random() < _NEAR:
            place, start = good[rng.integers(len(good))]
            seeds, wanted = iter([start]), _near(place, rng)
        else:
            start, wanted = rig.robot.home, _drawn(rig, rng)
            seeds = restarts(world, rng, start, extra=2)
        q = _reached(rig, world, wanted, start, seeds) if _sees(rig, wanted) else None
        if q is None:
            continue
        T, T_base_camera = _T_camera_board(rig, q), _T_base_camera(rig, q)
        points = (T_base_camera @ T @ np.vstack([rig.board.rim.T, np.ones(4)]))[:3].T
        if sightlines.reach(q, T_base_camera[:3, 3], points):
            good.append((T, q))
            yield q


def _reached(rig: Rig, world: CollisionWorld, wanted: Floats, start: Floats, seeds: Iterator[Floats]) -> Floats | None:
    """A posture that shows the board about at ``wanted`` (T_camera_board); None where none is found.

    The arm's first joint may carry the camera as well (a torso that lifts): then it is aimed for again.
    """
    for _ in range(_AIMS):
        q = solve_ik(world, _hand(rig, world, start, wanted), seeds=seeds)
        if q is None or _sees(rig, _T_camera_board(rig, q)):
            return q
        start, seeds = q, iter([q])
    return None


def _near(T: Floats, rng: np.random.Generator) -> Floats:
    """A place (T_camera_board) not far from another."""
    turn = exp_so3(_TURN * rng.uniform(-1, 1, 3))
    return pose(turn @ T[:3, :3], T[:3, 3] * rng.uniform(0.8, 1.25) + _SHIFT * rng.uniform(-1, 1, 3))


def _drawn(rig: Rig, rng: np.random.Generator) -> Floats:
    """T_camera_board of a board somewhere in the picture, near or far, tilted and turned."""
    camera, board = rig.robot.camera, rig.board
    width, height = camera.size
    nearest = camera.focal * float(np.hypot(*board.size)) / (_FILLED * height)
    farthest = max(camera.focal * board.square / _SMALLEST, nearest)
    z = rng.uniform(nearest, farthest)
    pixel = np.array([rng.uniform(0.15, 0.85) * width, rng.uniform(0.15, 0.85) * height, 1.0])
    towards = rng.uniform(0, 2 * np.pi)
    tilt = exp_so3(rng.uniform(0, _TILTED) * np.array([np.cos(towards), np.sin(towards), 0.0]))
    turn = exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    return pose(tilt @ turn, z * (np.linalg.inv(camera.K) @ pixel).astype(np.float64))


def _hand(rig: Rig, world: CollisionWorld, q: Floats, T_camera_board: Floats) -> Floats:
    """T_base_hand that shows the board there, while what carries the camera, or holds the board, is as at ``q``."""
    T_base_camera = _T_base_camera(rig, q)
    if rig.held:
        T_board_hand = inverse(rig.Y) @ rig.robot.gripper.T_link_hand
        return T_base_camera @ T_camera_board @ T_board_hand
    T_camera_hand = inverse(T_base_camera) @ world.hand(q)
    return rig.Y @ inverse(T_camera_board) @ T_camera_hand


def _T_base_camera(rig: Rig, q: Floats) -> Floats:
    joints = rig.robot.posture | dict(zip(rig.robot.joints, q.tolist(), strict=True))
    return rig.robot.camera_pose(tuple(joints), np.array(list(joints.values())))


def _T_camera_board(rig: Rig, q: Floats) -> Floats:
    return inverse(rig.X) @ rig.between(dict(zip(rig.robot.joints, q.tolist(), strict=True))) @ rig.Y


def _sees(rig: Rig, T: Floats) -> bool:
    """Whether the pattern at ``T`` (T_camera_board) lies in the picture and faces the camera."""
    rim = rig.board.rim @ T[:3, :3].T + T[:3, 3]
    if (rim[:, 2] <= 0).any():
        return False
    pixels = project(rim, rig.robot.camera.K)
    faces = T[:3, 2] @ T[:3, 3] > np.cos(_TILTED + np.deg2rad(15)) * np.linalg.norm(T[:3, 3])
    inside = (pixels >= _MARGIN) & (pixels < np.array(rig.robot.camera.size) - _MARGIN)
    return bool(faces and inside.all())


def _information(rig: Rig, q: Floats) -> Floats:
    """12 x 12: what a picture from there says about X and Y, with corners off by a pixel."""
    A = rig.between(dict(zip(rig.robot.joints, q.tolist(), strict=True)))
    corners = rig.board.corners
    sight = Sight(A, corners, np.zeros((len(corners), 2)), rig.robot.camera.K)
    here = sight.errors(rig.X, rig.Y)
    columns: list[Floats] = []
    for k in range(12):
        change = _STEP * np.eye(12)[k]
        columns.append(
            (sight.errors(rig.X @ small_motion(change[:6]), rig.Y @ small_motion(change[6:])) - here).ravel() / _STEP
        )
    J = np.stack(columns, axis=1)
    return J.T @ J
