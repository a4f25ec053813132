"""A calibration from its first command to its result, with an arm that goes where it is told and corners of a board
where a camera would have them."""

import numpy as np
import pytest

from stages.geometry.arrays import Floats
from stages.geometry.camera import project
from stages.geometry.poses import exp_so3, inverse, pose, rotation_angle
from stages.hand_eye.board import Board
from stages.hand_eye.limits import Limits
from stages.hand_eye.rig import Rig
from stages.hand_eye.routine import CalibrationRoutine
from stages.messages import CameraCalibration, Frame, RobotCommand, RobotState
from stages.robots import BUILT_IN, read_robot

RIG = Rig(read_robot(BUILT_IN), Board())
X = RIG.X @ pose(exp_so3(np.deg2rad([0.3, -0.2, 0.1])), np.array([0.004, -0.002, 0.003]))
HEAD = dict(zip(RIG.robot.still, np.array(list(RIG.robot.still.values())) + np.deg2rad([0.0, 0.5]), strict=True))
"""Where the head stands: half a degree lower than described."""


def calibrated(read: dict[str, float], lines: list[str], monkeypatch: pytest.MonkeyPatch) -> CameraCalibration:
    """``read``: what the encoders say of the head."""
    robot, q = RIG.robot, RIG.robot.home
    steps = CalibrationRoutine(RIG, poses=6, limits=Limits(), log=lines.append).run(np.random.default_rng(0))
    monkeypatch.setattr(Board, "find", lambda *_: (np.arange(len(RIG.board.corners)), corners(q)))
    asked = next(steps)
    try:
        while True:
            if isinstance(asked, RobotCommand):
                q = asked.positions[-1] if len(asked.positions) else q
                positions = np.array([*q, *read.values()])
                names = (*robot.joints, *read)
                asked = steps.send(RobotState(joint_names=names, positions=positions, gripper_width=0.0, time=0.0))
            else:
                asked = steps.send(looked())
    except StopIteration as end:
        return end.value


def corners(q: Floats) -> Floats:
    joints = dict(zip(RIG.robot.joints, q.tolist(), strict=True)) | HEAD
    T = inverse(X) @ RIG.between(joints) @ RIG.Y
    return project(RIG.board.corners @ T[:3, :3].T + T[:3, 3], RIG.robot.camera.K)


def looked() -> Frame:
    width, height = RIG.robot.camera.size
    return Frame(
        rgb=np.zeros((height, width, 3), np.uint8), depth=np.zeros((height, width), np.float32), K=RIG.robot.camera.K,
        T_base_camera=None, robot_mask=None, name="", index=0, total=0,
    )  # fmt: skip


def test_the_camera_is_found_on_a_head_that_stands_elsewhere_than_described(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    found = calibrated(HEAD, lines, monkeypatch)
    assert found.success and found.T_link_camera is not None
    assert rotation_angle(found.T_link_camera[:3, :3], X[:3, :3]) < np.deg2rad(0.05)
    assert not any("no encoder" in line for line in lines)


def test_joints_whose_encoders_nobody_reads_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    calibrated({}, lines, monkeypatch)
    said = "no encoder of head_pan_joint, head_tilt_joint is read: taken to stand where the description says"
    assert said in lines
