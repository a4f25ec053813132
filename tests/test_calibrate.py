"""`runner calibrate` from end to end: a board is shown, the description written, and the recording tells it again."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from runner.testing import finish, runner
from stages.messages import CameraCalibration
from stages.robots import read_robot
from tests.stages.robots.test_robots import FOLDER


@pytest.mark.slow
def test_a_camera_in_the_hand_is_calibrated_by_one_command_and_replayed(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(f"# Our robot.\nlike: {FOLDER / 'ur5e_hand.yaml'}\n")
    settings = (f"world.robot={own}", "world.seed=3", "calibrator.poses=7")
    options = [part for setting in settings for part in ("--set", setting)]
    run = finish(runner("calibrate", "--recordings", str(tmp_path), *options), tmp_path)
    assert run.code == 0, run.output
    (found,) = run.messages(CameraCalibration)
    assert f"written to {own}" in run.output and run.output.splitlines()[-1].startswith("calibrated: ")
    text = own.read_text()
    assert text.startswith(f"# Our robot.\nlike: {FOLDER / 'ur5e_hand.yaml'}\ncamera:\n  link: gripper_base\n")
    camera = read_robot(own).camera
    assert camera.calibrated == yaml.safe_load(text)["camera"]["calibrated"] != ""
    np.testing.assert_allclose(camera.T_link_camera, found.T_link_camera, atol=1e-5)
    command = (sys.executable, "-m", "runner.cli", "replay", str(run.recording), "--verify")
    replay = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False)
    assert replay.returncode == 0, replay.stdout + replay.stderr
