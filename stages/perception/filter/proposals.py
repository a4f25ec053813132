"""Where the particles of one object come from: first guesses, diffusion and flips."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from stages.geometry.arrays import Floats, distinct_rows
from stages.geometry.poses import (
    compose,
    cube_rotations,
    exp_so3,
    random_rotations,
    rotate,
    symmetry_angle,
    turned_within,
)
from stages.perception.rendering.rasteriser import KERNEL
from stages.scene.catalogue import CatalogueObject, Mesh

Dof = Literal[3, 6]
_SAME = np.deg2rad(12.0)
_YAWS = np.asarray(np.arange(1, 12) * (np.pi / 6), float)
_FACES = 24
_ROUGHLY = 0.1
"""Normals that differ by less belong to one face."""
_CLEARLY = 0.88
_ROUND = 0.7
"""Share of the sides' area whose normals meet one axis (within ``_MEETING`` of the object's size), from which on a body
is round, whatever handle it has."""
_MEETING = 0.03
_ROUNDS = 10
_UPRIGHT = 0.9
"""Share of a triangle's area, seen from the side, that makes it one of the sides."""
_BODY_TURNS = np.deg2rad(np.arange(20.0, 360.0, 20.0))
_RESTING = 0.5
"""Share of the first guesses in which the object rests on the plane, where it need not."""


@dataclass(frozen=True)
class Guess:
    """What a candidate says of an object's pose."""

    points: Floats
    """N x 3 readings that may belong to it, camera frame, metres."""
    T_camera_table: Floats


class Proposals:
    """Pose proposals for one catalogue object; poses are P x 3 x 4 rows of T_camera_object."""

    @staticmethod
    def of(item: CatalogueObject, dof: Dof) -> Proposals:
        """Those of an object, made once."""
        return item.once((Proposals, dof), lambda: Proposals(item, dof))

    def __init__(self, item: CatalogueObject, dof: Dof) -> None:
        self.dof: Dof = dof
        self._centre = item.bounds.mean(0)
        mesh = item.simplified(500)
        self._vertices = mesh.vertices
        self._support = self._vertices[ConvexHull(self._vertices).vertices]
        # The catalogue's z axis is up when an object stands; resting poses of scanned meshes may lean a little.
        self._resting = np.eye(3)[None] if dof == 3 else np.stack([np.eye(3), *item.resting])
        self._symmetries = item.symmetries.transforms()
        self.axes = box_axes(self._vertices)
        """The object's own axes, as columns in its frame, 3 x 3."""
        self.spins = dof == 6
        """Whether every second flip is a turn by any angle about one of the axes."""
        turns = compose(compose(self.axes, cube_rotations()), self.axes.T)
        self._flips = self._distinct(np.concatenate([turns, item.symmetries.near[:, :3, :3]]))
        self._body_turns = self._turns_of_body(mesh)

    def initial(self, guess: Guess, count: int, rng: np.random.Generator) -> Floats:
        """First guesses: a reading inside the box is laid on the surface of the turned object."""
        rotations, resting = self._rotations(guess, count, rng)
        # In piles objects lie as they would on the plane, but on others.
        resting &= (self.dof == 3) | (rng.random(count) < 0.5)
        readings = guess.points[rng.integers(len(guess.points), size=count)]
        facing = self._facing_points(rotations, readings, rng)
        poses = np.concatenate([rotations, (readings - facing)[..., None]], -1)
        return _put_down(poses, resting, self._support, guess.T_camera_table)

    def uniform(self, guess: Guess, count: int, rng: np.random.Generator) -> Floats:
        """The paper's first guesses: any orientation, the centre at a reading inside the box."""
        rotations, resting = self._rotations(guess, count, rng, resting_share=float(self.dof == 3))
        readings = guess.points[rng.integers(len(guess.points), size=count)]
        poses = np.concatenate([rotations, (readings - rotate(rotations, self._centre))[..., None]], -1)
        return _put_down(poses, resting, self._support, guess.T_camera_table)

    def directions(self, T_camera_table: Floats) -> Floats:
        """The twists (rotation about the centre, translation; camera frame) the object may make, 6 x dof."""
        return np.eye(6) if self.dof == 6 else plane_directions(T_camera_table)

    def own_directions(self, pose: Floats, directions: Floats) -> Floats:
        """The twists that the object may make, along and about its own axes where it may make any."""
        if self.dof == 3:
            return directions
        axes = compose(pose[:, :3], self.axes)
        return np.block([[axes, np.zeros((3, 3))], [np.zeros((3, 3)), axes]])

    def diffuse(
        self, poses: Floats, directions: Floats, *, metres: float, radians: float, rng: np.random.Generator
    ) -> Floats:
        """Zero-mean Gaussian noise in every direction of freedom: the transition of Iterated Likelihood Weighting."""
        turning = np.abs(directions[:3]).sum(0) > 0
        steps = rng.normal(size=(len(poses), directions.shape[1])) * np.where(turning, radians, metres)
        twists = (directions[None] * steps[:, None, :]).sum(-1)
        return self.moved(poses, twists)

    def moved(self, poses: Floats, twists: Floats) -> Floats:
        """Poses after a turn about the object's centre and a shift each, P x 6, camera frame."""
        return _moved(np.ascontiguousarray(poses), self._centre, twists)

    def flipped(self, poses: Floats, T_camera_table: Floats, rng: np.random.Generator) -> Floats:
        """One flip each, drawn among those that the object's symmetries do not undo; with six degrees of freedom
        every second one is a turn by any angle about one of the object's axes."""
        flips = self._flip_turns(poses, T_camera_table)
        chosen = flips[np.arange(len(poses)), rng.integers(flips.shape[1], size=len(poses))]
        if self.spins:
            axes = rotate(poses[:, :, :3], self.axes.T[rng.integers(3, size=len(poses))])
            turns = exp_so3(axes * rng.uniform(-np.pi, np.pi, (len(poses), 1)))
            chosen = np.where((np.arange(len(poses)) % 2 == 0)[:, None, None], chosen, turns)
        return self._turned(poses, chosen, np.zeros(3))

    @property
    def flips(self) -> Floats:
        """Rotations in the object's frame that flip it, F x 3 x 3: those of its shape, or turns about the upright."""
        return exp_so3(_YAWS[:, None] * np.array([0.0, 0.0, 1.0])) if self.dof == 3 else self._flips

    def all_flips(self, pose: Floats, T_camera_table: Floats) -> Floats:
        """Every flip of one pose, itself first, and turns of a round body that has a handle, F x 3 x 4."""
        flips = self._flip_turns(pose[None], T_camera_table)[0]
        repeated = np.repeat(pose[None], len(flips), 0)
        flipped = self._turned(repeated, flips, np.zeros(3))
        return np.concatenate([pose[None], flipped, turned_within(pose[None], self._body_turns)[0]])

    def _flip_turns(self, poses: Floats, T_camera_table: Floats) -> Floats:
        """Rotations in the camera frame that flip each pose, P x F x 3 x 3."""
        if self.dof == 3:
            turns = exp_so3(_YAWS[:, None] * T_camera_table[:3, 2])
            return np.broadcast_to(turns, (len(poses), *turns.shape))
        R = poses[:, None, :, :3]
        return compose(compose(R, self._flips[None]), np.swapaxes(R, -1, -2))

    def _turned(self, poses: Floats, turns: Floats, shifts: Floats) -> Floats:
        """Poses after a turn about the object's centre and a shift, both in the camera frame."""
        rotations = compose(turns, poses[..., :3])
        centres = poses[..., 3] + rotate(poses[..., :3], self._centre) + shifts
        return np.concatenate([rotations, (centres - rotate(rotations, self._centre))[..., None]], -1)

    def _distinct(self, rotations: Floats) -> Floats:
        """Rotations that are neither a symmetry nor, modulo symmetry, equal to an earlier one."""
        kept: list[Floats] = []
        for R in rotations:
            known = [np.eye(3), *kept]
            if all(symmetry_angle(other, R, self._symmetries) > _SAME for other in known):
                kept.append(R)
        return np.stack(kept) if kept else exp_so3(np.pi * np.eye(3)[:1])

    def _turns_of_body(self, mesh: Mesh) -> Floats:
        """Turns about the axis of a round body in the object's frame, B x 3 x 4, none where it is wholly symmetric.

        Where something hides a mug's handle, it may be anywhere behind: flips are too far apart to find it.
        """
        none = np.empty((0, 3, 4))
        found = round_body(mesh, self.axes)
        if found is None:
            return none
        axis, point = found
        R = exp_so3(_BODY_TURNS[:, None] * axis)
        if (symmetry_angle(np.eye(3), R, self._symmetries) < _SAME).any():
            return none
        return np.concatenate([R, (point - rotate(R, point))[..., None]], -1)

    def _rotations(
        self, guess: Guess, count: int, rng: np.random.Generator, *, resting_share: float = _RESTING
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Orientations in the camera frame, and which of them rest on the plane."""
        resting = np.ones(count, bool) if self.dof == 3 else rng.random(count) < resting_share
        yaw = exp_so3(rng.uniform(-np.pi, np.pi, count)[:, None] * np.array([0.0, 0.0, 1.0]))
        lying = compose(yaw, self._resting[rng.integers(len(self._resting), size=count)])
        lying = compose(guess.T_camera_table[:3, :3], lying)
        return np.where(resting[:, None, None], lying, random_rotations(count, rng)), resting

    def _facing_points(self, rotations: Floats, readings: Floats, rng: np.random.Generator) -> Floats:
        """For each rotation a random vertex on the side that faces the camera, camera axes, P x 3."""
        chosen = self._vertices[rng.integers(len(self._vertices), size=(len(rotations), 4))]
        turned = (rotations[:, None] * (chosen - self._centre)[:, :, None, :]).sum(-1)
        along = (turned * readings[:, None]).sum(-1)
        nearest = turned[np.arange(len(turned)), np.argmin(along, 1)]
        return nearest + rotate(rotations, self._centre)


@numba.njit(**KERNEL)
def _moved(poses, centre, twists):  # pyright: ignore[reportMissingParameterType]
    """Poses P x 3 x 4 after a turn about ``centre`` (object frame) and a shift, camera frame: twists P x 6."""
    moved = np.empty_like(poses)
    turn = np.empty((3, 3))
    for p in range(poses.shape[0]):
        x, y, z = twists[p, 0], twists[p, 1], twists[p, 2]
        angle = np.sqrt(x * x + y * y + z * z) + 1e-12
        x, y, z = x / angle, y / angle, z / angle
        s, d = np.sin(angle), 1.0 - np.cos(angle)
        turn[0, 0], turn[0, 1], turn[0, 2] = 1.0 - d * (y * y + z * z), d * x * y - s * z, d * x * z + s * y
        turn[1, 0], turn[1, 1], turn[1, 2] = d * x * y + s * z, 1.0 - d * (x * x + z * z), d * y * z - s * x
        turn[2, 0], turn[2, 1], turn[2, 2] = d * x * z - s * y, d * y * z + s * x, 1.0 - d * (x * x + y * y)
        for i in range(3):
            position = poses[p, i, 3] + twists[p, 3 + i]
            for j in range(3):
                rotated = turn[i, 0] * poses[p, 0, j] + turn[i, 1] * poses[p, 1, j] + turn[i, 2] * poses[p, 2, j]
                moved[p, i, j] = rotated
                position += (poses[p, i, j] - rotated) * centre[j]
            moved[p, i, 3] = position
    return moved


def plane_directions(T_camera_table: Floats) -> Floats:
    """Twists (rotation, translation; camera frame) on the plane: a turn about its normal and two slides, 6 x 3."""
    basis = np.zeros((6, 3))
    basis[:3, 0] = T_camera_table[:3, 2]
    basis[3:, 1] = T_camera_table[:3, 0]
    basis[3:, 2] = T_camera_table[:3, 1]
    return basis


def box_axes(vertices: Floats) -> Floats:
    """Axes of the smallest box around a mesh, as the columns of a rotation: a scan need not lie along its frame.

    The box of least volume has a face along a face of the convex hull (O'Rourke, 1985, but for rare exceptions). The
    larger faces are tried in pairs, and the frame's own axes are kept unless a box is clearly smaller.
    """
    hull = ConvexHull(vertices)
    corners = vertices[hull.vertices]
    normals = _larger_faces(vertices, hull)
    first, second = np.repeat(normals, len(normals), 0), np.tile(normals, (len(normals), 1))
    across = np.cross(first, second)
    length = np.sqrt((across**2).sum(1))
    first, across = first[length > 0.1], across[length > 0.1] / length[length > 0.1, None]
    frames = np.concatenate([np.eye(3)[None], np.stack([first, across, np.cross(first, across)], -1)])
    x, y, z = (corners[None, :, k, None] * frames[:, None, k] for k in range(3))
    along = x + y + z
    volumes = (along.max(1) - along.min(1)).prod(1)
    best = int(np.argmin(volumes))
    return frames[best] if volumes[best] < _CLEARLY * volumes[0] else frames[0]


def round_body(mesh: Mesh, axes: Floats) -> tuple[Floats, Floats] | None:
    """The axis about which most of a mesh is round, and a point of it; None where it is not round.

    Normals of a surface of revolution meet its axis. ``axes`` are the directions that are tried, columns, 3 x 3.
    """
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.sqrt((across**2).sum(1))
    middles, size = corners.mean(1), float(np.ptp(mesh.vertices, axis=0).max())
    best, found = _ROUND, None
    for k in range(3):
        u, v = axes[:, (k + 1) % 3], axes[:, (k + 2) % 3]
        # Across the axis, a side's normal is a line through its middle.
        x, y = (across * u).sum(1), (across * v).sum(1)
        length = np.sqrt(x**2 + y**2)
        sides = length > _UPRIGHT * areas
        weights, tangents = areas[sides], np.stack([-y, x], -1)[sides] / length[sides, None]
        offsets = tangents[:, 0] * (middles[sides] * u).sum(1) + tangents[:, 1] * (middles[sides] * v).sum(1)
        centre, share = _meeting_point(tangents, offsets, weights, _MEETING * size)
        if share > best:
            best, found = share, (axes[:, k], centre[0] * u + centre[1] * v)
    return found


def _meeting_point(normals: Floats, offsets: Floats, weights: Floats, tolerance: float) -> tuple[Floats, float]:
    """The point where lines of a plane meet (``normals`` N x 2 times the point are ``offsets``), and the share of their
    weights that does: least squares, again and again over the half that is nearest."""
    centre, share = np.zeros(2), 0.0
    near = np.ones(len(offsets), bool)
    for _ in range(_ROUNDS):
        n, w = normals[near], weights[near]
        A = (w[:, None, None] * n[:, :, None] * n[:, None, :]).sum(0)
        if np.linalg.det(A) <= 1e-6 * np.trace(A) ** 2:  # parallel, or none
            break
        centre = np.linalg.solve(A, (w[:, None] * n * offsets[near, None]).sum(0))
        away = np.abs((normals * centre).sum(1) - offsets)
        near, share = away <= np.median(away), float(weights[away < tolerance].sum() / weights.sum())
    return centre, share


def _larger_faces(vertices: Floats, hull: ConvexHull) -> Floats:
    """Unit normals of the faces of a convex hull that have the most area, coplanar triangles together, N x 3."""
    corners = vertices[hull.simplices]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = hull.equations[:, :3] * np.sqrt((across**2).sum(1))[:, None]
    _, which = distinct_rows(np.round(hull.equations[:, :3] / _ROUGHLY))
    faces = np.stack([np.bincount(which, component) for component in outward.T], -1)
    sizes = np.sqrt((faces**2).sum(1))
    largest = np.argsort(-sizes, kind="stable")[:_FACES]
    return faces[largest] / sizes[largest, None]


def _put_down(poses: Floats, resting: NDArray[np.bool_], support: Floats, T_camera_table: Floats) -> Floats:
    """Lifts or lowers poses until the lowest vertex touches the plane, where ``resting``."""
    normal, origin = T_camera_table[:3, 2], T_camera_table[:3, 3]
    put = poses.copy()
    lying = put[resting]
    slopes = (lying[:, :, :3] * normal[:, None]).sum(1)
    lowest = (slopes[:, None, :] * support[None]).sum(-1).min(1)
    height = lowest + ((lying[:, :, 3] - origin) * normal).sum(1)
    put[resting, :, 3] -= height[:, None] * normal
    return put


def distinct_best(poses: Floats, costs: Floats, count: int, *, metres: float, radians: float) -> NDArray[np.intp]:
    """Indices of up to ``count`` cheap poses, best first, no two of which are close in both position and angle."""
    # The squared chord of two rotations an angle apart: no arc is needed to compare.
    chord = 8.0 * np.sin(min(radians, np.pi) / 2) ** 2
    return _distinct(np.ascontiguousarray(poses), np.argsort(costs, kind="stable"), count, metres**2, chord)


@numba.njit(**KERNEL)
def _distinct(poses, order, count, squared_distance, squared_chord):  # pyright: ignore[reportMissingParameterType]
    """Goes through poses P x 3 x 4 in order and keeps those that are far from all kept before."""
    kept = np.empty(min(count, len(order)), np.intp)
    found = 0
    for i in order:
        apart = True
        for k in range(found):
            distance, chord = 0.0, 0.0
            for row in range(3):
                distance += (poses[i, row, 3] - poses[kept[k], row, 3]) ** 2
                for column in range(3):
                    chord += (poses[i, row, column] - poses[kept[k], row, column]) ** 2
            if distance <= squared_distance and chord <= squared_chord:
                apart = False
                break
        if apart:
            kept[found] = i
            found += 1
            if found == count:
                break
    return kept[:found]
