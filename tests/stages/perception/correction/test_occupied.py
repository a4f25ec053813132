"""What the arm keeps out of before anybody knows how far the camera is off."""

import numpy as np
import pytest

from stages.geometry.poses import inverse, pose
from stages.perception.correction.occupied import occupied
from tests.stages.perception.scenes import VIEW, camera, render, upright
from tests.stages.planning.scenes import ROBOT


@pytest.mark.parametrize("depth", [0.98, 1.0, 1.02])
def test_the_table_is_not_lower_and_things_not_smaller_than_they_are(depth: float) -> None:
    """A camera whose depth is 2 % off, about a metre away."""
    T_base_table = pose(np.eye(3), np.array([*ROBOT.table.center, ROBOT.table.height]))
    seen = render({"milk_carton": upright("milk_carton", 0.0, 0.0, 0.0)})
    T_base_camera = T_base_table @ inverse(camera())
    found = occupied(
        (depth * seen.scene.depth).astype(np.float32), VIEW, T_base_camera, ROBOT, np.random.default_rng(0)
    )
    assert found is not None
    height, (box,) = found
    assert ROBOT.table.height < height < ROBOT.table.height + 0.06
    low, high = box[:2] - ROBOT.table.center, box[3:5] - ROBOT.table.center
    assert (low < -0.03).all() and (high > 0.03).all() and box[5] > ROBOT.table.height + 0.15


def test_one_tall_object_does_not_make_all_that_it_touches_as_high() -> None:
    """A bottle at the end of a row of low things: over the other end the arm has room."""
    T_base_table = pose(np.eye(3), np.array([*ROBOT.table.center, ROBOT.table.height]))
    row = {"tea_box": -0.12, "sponge": 0.0, "water_bottle": 0.09}
    seen = render({name: upright(name, x, 0.0, np.pi / 2) for name, x in row.items()})
    T_base_camera = T_base_table @ inverse(camera())
    found = occupied(seen.scene.depth, VIEW, T_base_camera, ROBOT, np.random.default_rng(0))
    assert found is not None
    (low, high) = (
        max(box[5] for box in found[1] if box[0] < x < box[3]) - ROBOT.table.height
        for x in np.array([-0.12, 0.09]) + ROBOT.table.center[0]
    )
    assert low < 0.15 and high > 0.2


def test_a_table_that_shows_in_single_readings_only_is_not_seen() -> None:
    T_base_table = pose(np.eye(3), np.array([*ROBOT.table.center, ROBOT.table.height]))
    depth = np.zeros((VIEW.height, VIEW.width), np.float32)
    depth[::8, ::8] = render({}).scene.depth[::8, ::8]
    assert occupied(depth, VIEW, T_base_table @ inverse(camera()), ROBOT, np.random.default_rng(0)) is None
