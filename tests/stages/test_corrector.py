"""The corrector: a robot with known errors, rendered, moves and looks at its own arm."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from benchmarks.robot.correction import Lab
from runner.contract import Refused
from stages.corrector import Corrector, Phase, State
from stages.estimate import Quiet
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, rotation_angle
from stages.messages import Arrived, Calibrate, Correction, Frame, LookRequest, PostureRequest
from stages.messages.robot import Stopped
from stages.perception.rendering.rasteriser import View
from stages.robots import BUILT_IN, Robot, read_robot

HAND_CAMERA = BUILT_IN.with_name("ur5e_hand.yaml")
CTX = Quiet()
LOOK = LookRequest(purpose="goal")
SURVEY = LookRequest(purpose="own arm: what is in the way")


def frame(*, T_base_camera: Floats | None = None) -> Frame:
    return Frame(
        rgb=np.zeros((4, 6, 3), np.uint8), depth=np.ones((4, 6), np.float32), K=np.eye(3), T_base_camera=T_base_camera,
        robot_mask=None, name="goal", index=0, total=0,
    )  # fmt: skip


@pytest.mark.slow
def test_finds_what_is_wrong_with_the_camera_and_corrects_every_look() -> None:
    lab = Lab("tray", 340)
    seen = lab.look("goal")
    lab.close()
    errors, found = seen.snapshot.errors, lab.correction
    assert errors is not None and found is not None and found.found
    # What perception needs is the depth camera; nobody says that it is not the colour camera.
    truth = errors.T_believed_true @ errors.T_color_depth
    assert np.linalg.norm(found.T_believed_true[:3, 3] - truth[:3, 3]) < 0.002
    assert rotation_angle(found.T_believed_true[:3, :3], truth[:3, :3]) < np.deg2rad(0.1)
    assert found.depth * errors.depth == pytest.approx(1.0, abs=0.002)
    assert 5 < found.robot_seconds < 60
    as_it_is, corrected = seen.as_it_is, seen.corrected
    assert as_it_is.T_base_camera is not None and corrected.T_base_camera is not None
    assert np.array_equal(corrected.T_base_camera, as_it_is.T_base_camera @ found.T_believed_true)
    assert np.allclose(corrected.depth, as_it_is.depth * found.depth) and corrected.rgb is as_it_is.rgb


def test_passes_looks_on_untouched_where_it_is_switched_off() -> None:
    corrector = Corrector(Corrector.Config(calibrate=False))
    given = frame(T_base_camera=np.eye(4))
    assert list(corrector.on_look_request(LOOK, CTX)) == [LOOK]
    assert list(corrector.on_frame(given, CTX)) == [given]
    with pytest.raises(Refused, match=r"corrector\.calibrate is false"):
        corrector.on_calibrate(Calibrate(), CTX)


def test_a_camera_in_the_hand_is_taken_as_it_is_and_told_why() -> None:
    corrector = Corrector(Corrector.Config(robot=HAND_CAMERA))
    said, passed = corrector.on_look_request(LOOK, CTX)
    assert isinstance(said, Correction) and not said.found and "in the hand" in said.reason
    assert passed == LOOK
    with pytest.raises(Refused, match="in the hand"):
        corrector.on_calibrate(Calibrate(), CTX)


def test_a_look_from_elsewhere_waits_until_the_arm_has_brought_the_camera_there() -> None:
    corrector = Corrector(Corrector.Config(robot=HAND_CAMERA, calibrate=False))
    robot = read_robot(HAND_CAMERA)
    aside, home = LookRequest(purpose="goal, from view 1", view=1), LookRequest(purpose="goal")
    (survey,) = corrector.on_look_request(aside, CTX)
    assert survey == LookRequest(purpose="own arm: what is in the way of the camera")
    (posture,) = corrector.on_frame(table(robot), CTX)
    assert isinstance(posture, PostureRequest) and np.array_equal(posture.positions, robot.views[0])
    assert list(corrector.on_arrived(arrived(), CTX)) == [aside]
    assert list(corrector.on_look_request(aside, CTX)) == [aside], "it is there"
    assert list(corrector.on_look_request(home, CTX)) == [survey]
    (back,) = corrector.on_frame(table(robot), CTX)
    assert isinstance(back, PostureRequest) and np.array_equal(back.positions, robot.home)
    assert list(corrector.on_arrived(arrived(success=False, stopped="touch"), CTX)) == [home], "from where it stands"
    assert list(corrector.on_look_request(home, CTX)) == [survey], "which is not home"


def test_a_camera_that_sees_no_table_stays_where_it_is() -> None:
    corrector = Corrector(Corrector.Config(robot=HAND_CAMERA, calibrate=False))
    aside = LookRequest(purpose="goal, from view 1", view=1)
    list(corrector.on_look_request(aside, CTX))
    assert list(corrector.on_frame(frame(), CTX)) == [aside]


def test_whoever_stops_the_arm_on_its_way_to_a_view_gets_no_look() -> None:
    corrector = Corrector(Corrector.Config(robot=HAND_CAMERA, calibrate=False))
    list(corrector.on_look_request(LookRequest(purpose="goal", view=2), CTX))
    list(corrector.on_frame(table(read_robot(HAND_CAMERA)), CTX))
    assert not list(corrector.on_arrived(arrived(success=False, stopped="stop"), CTX))


def test_a_view_that_the_robot_does_not_have_is_refused() -> None:
    with pytest.raises(Refused, match=r"view 1: .*fetch\.yaml has 0; demonstrator\.robot must be the same"):
        list(Corrector(Corrector.Config(calibrate=False)).on_look_request(LookRequest(purpose="goal", view=1), CTX))


def table(robot: Robot) -> Frame:
    """An empty one, from home."""
    width, height = robot.camera.size
    T = inverse(robot.T_camera_base)
    rays = View.of(robot.camera.K, width, height).rays() @ T[:3, :3].T
    depth = (robot.table.height - T[2, 3]) / rays[..., 2]
    return msgspec.structs.replace(
        frame(T_base_camera=T), rgb=np.zeros((height, width, 3), np.uint8), depth=depth.astype(np.float32),
        K=robot.camera.K,
    )  # fmt: skip


def test_a_camera_of_which_nobody_knows_where_it_stands_is_taken_as_it_is() -> None:
    corrector = Corrector(Corrector.Config())
    (survey,) = corrector.on_look_request(LOOK, CTX)
    assert survey == SURVEY
    said, passed = corrector.on_frame(frame(), CTX)
    assert isinstance(said, Correction) and said.reason == "nobody knows where the camera stands to the robot"
    assert passed == LOOK
    (after,) = corrector.on_frame(frame(), CTX)
    assert isinstance(after, Frame)
    assert list(corrector.on_look_request(LOOK, CTX)) == [LOOK], "not again until it is asked for"
    corrector.on_calibrate(Calibrate(), CTX)
    assert list(corrector.on_look_request(LOOK, CTX)) == [survey]
    with pytest.raises(Refused, match="under way: waits for a look at what is in the way"):
        corrector.on_calibrate(Calibrate(), CTX)


def arrived(*, success: bool = True, stopped: Stopped = "") -> Arrived:
    return Arrived(
        success=success, reason="", stopped=stopped, joint_names=(), positions=np.zeros(0), robot_seconds=2.0
    )


AHEAD = tuple(
    PostureRequest(joint_names=(), positions=np.zeros(0), table_height=0.0, occupied=np.zeros((0, 6)), label=label)
    for label in ("second", "home")
)


def under_way() -> Corrector:
    """On the way to the first of two postures."""
    corrector = Corrector(Corrector.Config())
    corrector._state = State(phase=Phase.MOVING, asked=LOOK, ahead=AHEAD)  # pyright: ignore[reportPrivateUsage]
    return corrector


def test_a_posture_that_is_not_reached_is_left_out_and_too_few_say_nothing() -> None:
    corrector = under_way()
    (second,) = corrector.on_arrived(arrived(success=False), CTX)
    assert isinstance(second, PostureRequest) and second.label == "second"
    (home,) = corrector.on_arrived(arrived(success=False), CTX)
    assert isinstance(home, PostureRequest) and home.label == "home"
    (survey,) = corrector.on_arrived(arrived(), CTX)
    assert survey == SURVEY, "from there others may be reached"
    said, passed = corrector.on_frame(frame(), CTX)
    assert isinstance(said, Correction) and said.robot_seconds == 6.0 and passed == LOOK


def test_after_a_touch_the_arm_goes_home_and_what_is_in_the_way_is_looked_at_again() -> None:
    corrector = under_way()
    for _ in range(3):
        (home,) = corrector.on_arrived(arrived(success=False, stopped="touch"), CTX)
        assert isinstance(home, PostureRequest) and home.label == "home"
        survey, *passed = corrector.on_arrived(arrived(), CTX)
        state = corrector._state  # pyright: ignore[reportPrivateUsage]
        corrector._state = replace(state, phase=Phase.MOVING, ahead=AHEAD)  # pyright: ignore[reportPrivateUsage]
    assert isinstance(survey, Correction) and survey.reason == "the arm could show itself in 0 postures only"
    assert passed == [LOOK]


@pytest.mark.parametrize("stopped", ["stop", "fault"])
def test_an_arm_that_is_stopped_or_fails_takes_no_look_and_the_next_one_begins_again(stopped: Stopped) -> None:
    corrector = under_way()
    assert not list(corrector.on_arrived(arrived(success=False, stopped=stopped), CTX))
    (survey,) = corrector.on_look_request(LOOK, CTX)
    assert survey == SURVEY
