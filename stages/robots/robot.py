"""What is known of a robot and of where it stands: all that planning, the simulated world and views read."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.camera import intrinsics
from stages.geometry.poses import inverse
from stages.scene.catalogue import Mesh

if TYPE_CHECKING:
    import mujoco

    from stages.robots.body import Body
    from stages.robots.model import Model

BUILT_IN = Path(__file__).parent / "fetch.yaml"
"""The robot of graphs that name none."""
BESIDE = 0.08
"""Metres by which a table may reach further to the sides than is known of it."""
_LARGER = 0.15
"""Metres by which a table may reach further than it is declared: the robot stands somewhere, too."""


@dataclass(frozen=True)
class Table:
    """A table top: a slab whose upper face is horizontal; metres, robot base frame."""

    center: tuple[float, float]
    size: tuple[float, float]
    height: float
    thickness: float = 0.04

    def seen(self, T_base_table: Floats, surface: Floats | None) -> Table:
        """The table as it was perceived: at the height of its frame (4 x 4), and at least as large as it is declared;
        to the sides larger, for there the picture may end before the table does.

        ``surface``: corners as far as they were seen, K x 2, in the table's frame; None where nobody knows.
        """
        center, half = np.array(self.center), np.array(self.size) / 2
        low, high = center - half, center + half
        if surface is not None:
            corners = surface @ T_base_table[:2, :2].T + T_base_table[:2, 3]
            low = np.clip(corners.min(0), low - _LARGER, low)
            high = np.clip(corners.max(0), high, high + _LARGER)
        low[1], high[1] = low[1] - BESIDE, high[1] + BESIDE
        (x, y), (width, depth) = ((low + high) / 2).tolist(), (high - low).tolist()
        return replace(self, center=(x, y), size=(width, depth), height=float(T_base_table[2, 3]))


@dataclass(frozen=True, eq=False)
class Gripper:
    """Two parallel fingers, and the hand frame between their tips: x is the approach, y the closing direction."""

    link: str
    T_link_hand: Floats
    """4 x 4, the hand in the link's frame."""
    fingers: tuple[str, str]
    """Joints that each move one finger."""
    followers: dict[str, float]
    """Further joints of the fingers, and how far each turns with them."""
    joint_positions: Floats
    """N positions of a finger joint, rising, and ..."""
    widths: Floats
    """N, the metres between the fingers there."""
    closed_width: float
    open_width: float
    """Metres between the fingers at most."""
    widest: float
    """Width in metres of the widest object that the fingers take between them."""

    def width(self, finger: float) -> float:
        """Metres between the fingers at a finger joint's position, also a little beyond its range."""
        positions, widths = self.joint_positions, self.widths
        k = min(max(bisect_left(positions, finger), 1), len(positions) - 1)
        slope = (widths[k] - widths[k - 1]) / (positions[k] - positions[k - 1])
        return float(slope * (finger - positions[k - 1]) + widths[k - 1])

    def finger_position(self, width: float) -> float:
        """Position of a finger joint for ``width`` metres between the fingers, within their range."""
        clipped = min(max(width, self.closed_width), self.open_width)
        order = np.argsort(self.widths)
        return float(np.interp(clipped, self.widths[order], self.joint_positions[order]))

    def posture(self, width: float) -> dict[str, float]:
        """Positions of all joints of the fingers."""
        position = self.finger_position(width)
        return {name: position * share for name, share in (dict.fromkeys(self.fingers, 1.0) | self.followers).items()}


@dataclass(frozen=True, eq=False)
class Camera:
    """The colour camera, a pinhole: x right, y down, z forward; depth is registered to it."""

    link: str
    """What it is mounted on; empty: it stands in the base frame."""
    T_link_camera: Floats | None
    """4 x 4; None where the link's frame is the camera's."""
    focal: float
    """Pixels."""
    size: tuple[int, int]
    """Width and height, pixels."""
    calibrated: str = ""
    """When it was measured where the camera is, and how well; empty: nobody has."""

    @property
    def K(self) -> Floats:
        """Intrinsics, 3 x 3."""
        return intrinsics(self.focal, *self.size)


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm on a base that stands still, with a gripper and a camera, at a table. Compared by identity."""

    model: Model
    joints: tuple[str, ...]
    """The J joints that planning moves."""
    velocity: Floats
    """J, limits, rad/s (m/s)."""
    acceleration: Floats
    """J, limits, rad/s^2 (m/s^2)."""
    home: Floats
    """J, a posture that leaves the camera's view free."""
    views: tuple[Floats, ...]
    """Further postures, J each, from which the camera looks at the table."""
    still: dict[str, float]
    """Positions of joints that planning does not move."""
    gripper: Gripper
    hand: str
    """From this link on, links may come near the object in the hand."""
    camera: Camera
    table: Table
    """The table that the robot stands at, until one is seen."""
    floor: float
    """Height of the floor, metres."""
    x: tuple[float, float]
    y: tuple[float, float]
    """Where the robot places, metres."""
    shoulder: tuple[float, float]
    """Where the arm turns about a vertical axis."""
    reach: float
    """Metres around the shoulder within which objects on the table are grasped and placed from the top."""

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Every joint whose encoder is read: of the arm, those that stand still, the fingers'."""
        return (*self.joints, *self.still, *self.gripper.fingers, *self.gripper.followers)

    @cached_property
    def posture(self) -> dict[str, float]:
        """Where the arm and what stands still are at home."""
        return dict(zip(self.joints, self.home.tolist(), strict=True)) | self.still

    def specification(self, *, seen: bool = True) -> mujoco.MjSpec:
        """A new MuJoCo specification of the robot alone, with its actuators; the world frame is the base frame.

        Without ``seen``, shapes that are only for the eye are left out.

        Raises:
            Refused: a file of the model is missing or cannot be read.
        """
        # MuJoCo takes a third of a second to load; whoever only reads a description does without.
        from stages.robots.assembly import specification

        return specification(self.model, seen=seen)

    @cached_property
    def body(self) -> Body:
        """Its links: where they are and how they look."""
        from stages.robots.body import Body

        return Body(self.specification())

    def beyond_reach(self, T_base_object: Floats) -> float:
        """How far an object's pose is out of :attr:`reach`, metres; 0 within."""
        return max(0.0, float(np.linalg.norm(T_base_object[:2, 3] - self.shoulder)) - self.reach)

    def camera_pose(self, joint_names: Sequence[str], positions: Floats) -> Floats:
        """T_base_camera (4 x 4) of the camera's optical frame; joints that are not named are at zero."""
        camera = self.camera
        if not camera.link:
            assert camera.T_link_camera is not None
            return camera.T_link_camera
        T_base_link = self.body.link_poses(joint_names, positions)[camera.link]
        return T_base_link if camera.T_link_camera is None else T_base_link @ camera.T_link_camera

    @cached_property
    def camera_in_hand(self) -> bool:
        """Whether the camera moves with the gripper."""

        def held(q: Floats) -> Floats:
            T_base_links = self.body.link_poses(self.joints, q)
            return inverse(self.camera_pose(self.joints, q)) @ T_base_links[self.gripper.link]

        return bool(np.allclose(held(self.home), held(self.home + 0.1), atol=1e-9))

    @cached_property
    def T_camera_base(self) -> Floats:
        """Of the camera while the robot is at home, 4 x 4."""
        return inverse(self.camera_pose(tuple(self.posture), np.array(list(self.posture.values()))))

    def links(self, joint_names: Sequence[str], positions: Floats) -> list[tuple[Mesh, Floats]]:
        """The shape of every link (in the link's frame) and its T_base_link (4 x 4)."""
        T_base_links = self.body.link_poses(joint_names, positions)
        return [(mesh, T_base_links[link]) for link, mesh in self.body.meshes]
