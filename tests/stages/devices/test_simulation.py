"""The simulated world."""

import numpy as np

from stages.devices.simulation import Simulation
from tests.stages.planning.scenes import ROBOT, TABLE, catalogue, standing


def test_what_falls_off_the_table_lies_on_the_floor() -> None:
    simulation = Simulation(catalogue(), ROBOT, ("soup_can",), TABLE)
    simulation.arrange({"soup_can": standing("soup_can", 0.8, 0.63)}, settle=3.0)
    (T,) = simulation.object_poses()
    assert np.isfinite(T).all()
    assert 0.0 < T[2, 3] < 0.1
