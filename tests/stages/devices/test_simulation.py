"""The simulated world."""

from collections import deque

import numpy as np

from stages.devices.simulation import Simulation
from stages.messages import RobotCommand
from tests.stages.planning.scenes import ROBOT, TABLE, catalogue, standing


def test_what_falls_off_the_table_lies_on_the_floor() -> None:
    simulation = Simulation(catalogue(), ROBOT, ("soup_can",), TABLE)
    simulation.arrange({"soup_can": standing("soup_can", 0.8, 0.63)}, settle=3.0)
    (T,) = simulation.object_poses()
    assert np.isfinite(T).all()
    assert 0.0 < T[2, 3] < 0.1


def stacked() -> Simulation:
    """A can on a carton, at rest for long enough to sleep."""
    simulation = Simulation(catalogue(), ROBOT, ("tea_box", "soup_can"), TABLE)
    top = TABLE.height + catalogue()["tea_box"].dimensions[2]
    simulation.arrange(
        {"tea_box": standing("tea_box", 0.6, 0.0), "soup_can": standing("soup_can", 0.6, 0.0, height=top)}
    )
    return simulation


def test_what_stood_on_what_is_taken_away_falls() -> None:
    simulation = stacked()
    high = simulation.layout()["soup_can"][2, 3]
    simulation.remove("tea_box")
    simulation.run(1.0)
    assert simulation.layout()["soup_can"][2, 3] < high - 0.05


def test_what_is_put_down_is_there_at_once() -> None:
    simulation = stacked()
    T = standing("soup_can", 0.7, 0.2)
    simulation.add("soup_can", T)
    assert np.allclose(simulation.layout()["soup_can"], T, atol=0.003)
    simulation.remove("soup_can")
    simulation.add("soup_can", T)
    assert np.allclose(simulation.layout()["soup_can"], T, atol=0.003)


def test_what_is_at_rest_still_touches() -> None:
    simulation = stacked()
    assert simulation.touching("soup_can") == {"tea_box"}
    assert simulation.touching("tea_box") == {"table", "soup_can"}
    assert simulation.held() == ""


def test_fingers_that_are_where_they_should_be_take_no_time() -> None:
    simulation = stacked()
    none, width = np.zeros((0, 0)), ROBOT.gripper.open_width
    passed: list[float] = []
    for wanted in (width, width / 2, width):
        before = simulation.time
        command = RobotCommand(times=np.zeros(0), positions=none, velocities=none, gripper_width=wanted)
        deque(simulation.servo.carry_out(command), maxlen=0)
        passed.append(simulation.time - before)
        assert abs(simulation.servo.opening() - wanted) < 0.001
    assert passed[0] <= 0.1
    assert 0.3 <= passed[1] <= 0.6
