"""The calibrator at the end of its tether: stopped, called twice, unable to begin."""

from pathlib import Path

import numpy as np
import pytest

from runner.contract import Refused
from stages.calibrator import Calibrator
from stages.hand_eye.board import Board
from stages.hand_eye.limits import Limits
from stages.hand_eye.rig import Rig
from stages.messages import Abort, Brake, CalibrateCamera, CameraCalibration, Mounting, RobotCommand, RobotState
from stages.robots import Robot, read_robot
from tests.stages.episodes import Recorded
from tests.stages.robots.test_robots import FOLDER

FETCH, HAND, STAND = (FOLDER / f"{name}.yaml" for name in ("fetch", "ur5e_hand", "ur5e"))


def calibrator(file: Path = HAND) -> Calibrator:
    stage, robot = Calibrator(Calibrator.Config(robot=file, scripted=False, poses=6)), read_robot(file)
    mounting = Mounting(link=robot.camera.link, T_link_camera=Rig(robot, Board()).X)
    assert stage.on_mounting(mounting, Recorded()) is None
    return stage


def state(robot: Robot, **changes: str) -> RobotState:
    names, positions = tuple(robot.posture), np.array(list(robot.posture.values()))
    return RobotState(joint_names=names, positions=positions, gripper_width=0.05, time=0.0, **changes)


def test_the_hand_holds_the_board_unless_it_holds_the_camera() -> None:
    assert [Rig(read_robot(file), Board()).held for file in (FETCH, HAND, STAND)] == [True, False, True]


def test_it_moves_when_it_is_called_and_stops_when_asked() -> None:
    stage, ctx, robot = calibrator(), Recorded(), read_robot(HAND)
    assert stage.on_robot_state(state(robot), ctx) is None
    with pytest.raises(Refused, match="no calibration is under way"):
        stage.on_stop(Abort(), ctx)
    reading = stage.on_calibrate(CalibrateCamera(), ctx)
    assert isinstance(reading, RobotCommand) and not len(reading.times)
    with pytest.raises(Refused, match="a calibration is under way"):
        stage.on_calibrate(CalibrateCamera(), ctx)
    moving = stage.on_robot_state(state(robot), ctx)
    assert isinstance(moving, RobotCommand) and len(moving.times) and moving.guard is not None
    assert isinstance(stage.on_stop(Abort(), ctx), Brake)
    end = stage.on_robot_state(state(robot, stopped="stop"), ctx)
    assert isinstance(end, CameraCalibration)
    assert (end.success, end.reason) == (False, "stopped as asked; the arm stands where it is")
    assert isinstance(stage.on_calibrate(CalibrateCamera(), ctx), RobotCommand)


def test_a_touch_ends_it() -> None:
    stage, ctx, robot = calibrator(), Recorded(), read_robot(HAND)
    stage.on_calibrate(CalibrateCamera(), ctx)
    stage.on_robot_state(state(robot), ctx)
    end = stage.on_robot_state(state(robot, stopped="touch", reason="14 N at the hand"), ctx)
    assert isinstance(end, CameraCalibration) and not end.success
    assert end.reason == "touch: 14 N at the hand; the arm stands where it is"


def test_a_board_that_touches_the_arm_is_named() -> None:
    stage, ctx = calibrator(STAND), Recorded()
    stage.on_calibrate(CalibrateCamera(), ctx)
    end = stage.on_robot_state(state(read_robot(STAND)), ctx)
    assert isinstance(end, CameraCalibration)
    assert end.reason == (
        "where the arm stands, calibration_board and upper_arm_link would touch: move it, or the board"
    )


def test_fewer_poses_than_boards_are_needed_are_refused() -> None:
    with pytest.raises(Refused, match=r"calibrator\.poses = 5: limits\.boards = 6 are needed"):
        Calibrator.Config(poses=5, limits=Limits(boards=6))
