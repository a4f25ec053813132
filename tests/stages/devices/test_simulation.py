"""The simulated world."""

from collections import deque
from itertools import pairwise

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


def rolling(metres_per_second: float) -> Simulation:
    """A can that lies in the middle of the table and rolls to the left."""
    simulation = Simulation(catalogue(), ROBOT, ("soup_can",), TABLE)
    lying = next(k for k, R in enumerate(catalogue()["soup_can"].resting) if abs(R[2, 2]) < 0.5)
    simulation.arrange({"soup_can": standing("soup_can", 0.65, 0.1, resting=lying)}, settle=0.5)
    (T,) = simulation.object_poses()
    sideways = np.cross([0, 0, 1.0], T[:3, 2])
    joint = simulation._data.joint("soup_can")  # pyright: ignore[reportPrivateUsage]
    spin = T[:3, :3].T @ np.cross([0, 0, 1.0], sideways) / (T[2, 3] - TABLE.height)
    joint.qvel[:] = metres_per_second * np.concatenate([sideways, spin])
    return simulation


def test_a_can_rolls_and_comes_to_rest() -> None:
    simulation = rolling(0.08)
    places = [simulation.object_poses()[0][:2, 3]]
    for _ in range(2):
        simulation.run(1.0)
        places.append(simulation.object_poses()[0][:2, 3])
    first, second = (np.linalg.norm(b - a) for a, b in pairwise(places))
    assert 0.01 < first < 0.06 and second < 0.003


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
