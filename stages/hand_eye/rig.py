"""A robot, its camera and a board: which of the two the arm moves, and the board as part of the robot's model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, pose
from stages.hand_eye.board import Board
from stages.robots import Robot
from stages.robots.model import Part

_MARGIN = 0.01
"""Metres by which the plate is wider than the pattern."""
_THICK = 0.006
_BEHIND = 0.0005
"""Metres by which the plate lies behind the print."""
_HANDLE = 0.06
"""Metres between the fingertips and the plate: what the fingers hold it by."""
_IN_HAND = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""R_hand_board: the fingers close on the plate, whose upper edge is next to them."""
_ON_TABLE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""R_base_board: face up, its upper edge away from the robot."""


@dataclass(frozen=True)
class Rig:
    """The board is in the hand, unless the camera is: then it lies or stands somewhere in the room."""

    robot: Robot
    board: Board

    @property
    def held(self) -> bool:
        """Whether the hand holds the board."""
        return not self.robot.camera_in_hand

    @property
    def link(self) -> str:
        """What the board is fixed to; empty: the base."""
        return self.robot.gripper.link if self.held else ""

    @property
    def X(self) -> Floats:
        """T_cameralink_camera as the description has it, 4 x 4."""
        mounted = self.robot.camera.T_link_camera
        return np.eye(4) if mounted is None else mounted

    @cached_property
    def Y(self) -> Floats:
        """T_boardlink_board as far as it is known before, 4 x 4."""
        robot, board = self.robot, self.board
        if self.held:
            frame, turn, place = robot.gripper.T_link_hand, _IN_HAND, (_HANDLE + board.size[1] / 2, 0.0, 0.0)
        else:
            middle = float(np.mean(robot.x)), float(np.mean(robot.y))
            frame, turn, place = np.eye(4), _ON_TABLE, (*middle, robot.table.height + _THICK)
        if board.rotation:
            turn = Rotation.from_euler("xyz", board.rotation, degrees=True).as_matrix()
        return frame @ pose(turn, np.array(board.position or place))

    def between(self, joints: Mapping[str, float]) -> Floats:
        """A = T_cameralink_boardlink (4 x 4) at joint positions; what is not named is at home."""
        joints = self.robot.posture | dict(joints)
        links = self.robot.body.link_poses(tuple(joints), np.array(list(joints.values())))
        here = {"": np.eye(4), **links}
        return inverse(here[self.robot.camera.link]) @ here[self.link]

    def unread(self, joint_names: Sequence[str]) -> list[str]:
        """The joints that stand still between camera and board and are not among those named."""
        home, still = self.between({}), self.robot.still.items()
        left = {name: self.between({name: position + 0.1}) for name, position in still if name not in joint_names}
        return [name for name, A in left.items() if not np.allclose(A, home, atol=1e-9)]

    def with_board(self, Y: Floats, *, clearance: float = 0.0) -> Robot:
        """The robot with the board at ``Y`` (T_boardlink_board), its plate larger by ``clearance`` metres."""
        return _with(self.robot, _plate(self.board, Y, self.held, clearance), on=self.link)


def _with(robot: Robot, body: str, *, on: str) -> Robot:
    text = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    part = Part(robot.model.parts[0].file.parent, text, on=on, prefix="calibration_")
    return replace(robot, model=replace(robot.model, parts=(*robot.model.parts, part)))


def _plate(board: Board, Y: Floats, held: bool, clearance: float) -> str:
    """The plate, and what the hand holds it by, behind the print."""
    width, height = board.size / 2 + _MARGIN
    boxes = [((0.0, 0.0), (width, height))]
    if held:
        boxes.append(((0.0, -height - _HANDLE / 2), (0.02, _HANDLE / 2)))
    quaternion = Rotation.from_matrix(Y[:3, :3]).as_quat(scalar_first=True)
    geoms = "".join(
        f'<geom type="box" pos="{x} {y} {_THICK / 2 + _BEHIND}" rgba="0.95 0.95 0.95 1" mass="0.1" '
        f'size="{w + clearance} {h + clearance} {_THICK / 2 + clearance}"/>'
        for (x, y), (w, h) in boxes
    )
    at = f'pos="{_text(Y[:3, 3])}" quat="{_text(quaternion)}"'
    return f'<body name="board" {at}>{geoms}</body>'


def _text(numbers: Floats) -> str:
    return " ".join(f"{number:.9f}" for number in numbers)
