"""Motions of the arm for looks at itself: what is said of the table may be a little off."""

import contextlib
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from stages.messages import PostureRequest, RobotCommand, RobotState
from stages.planning.motion.collision import CollisionWorld
from stages.planning.motion.posture import PostureRoutine
from tests.stages.planning.scenes import ROBOT

SHOWN = np.array([0.328, -0.892, 1.09, -1.761, -2.086, -0.515, 0.36, 1.696])
"""A posture over the table, which the arm reaches from below its front edge."""
BOXES = np.array([
    [0.425, 0.123, 0.705, 0.601, 0.298, 0.853],
    [0.453, -0.21, 0.705, 0.601, -0.054, 0.848],
    [0.487, -0.047, 0.705, 0.682, 0.183, 0.837],
    [0.531, -0.271, 0.705, 0.754, -0.024, 1.066],
    [0.648, 0.127, 0.705, 0.824, 0.309, 0.907],
])  # fmt: skip
"""What stands on the table."""


ON_THE_FLOOR = np.array([0.104, 0.289, 1.032, -0.809, 0.860, 1.099, 0.172, 0.204])
"""The fingers, before the table."""


def motions(request: PostureRequest) -> Iterator[RobotCommand]:
    """Motions into a posture, by an arm that begins at home; some ways are not found."""
    at_home = RobotState(joint_names=ROBOT.joints, positions=ROBOT.home, gripper_width=0.1, time=0.0)
    for seed in range(10):
        routine = PostureRoutine(request, robot=ROBOT, rng=np.random.default_rng(seed), log=print).run()
        next(routine)
        with contextlib.suppress(StopIteration):
            yield routine.send(at_home)


@pytest.mark.parametrize("off", [0.0, 0.035])
def test_the_arm_keeps_off_a_table_that_is_a_little_lower_than_is_said(off: float) -> None:
    table = ROBOT.table
    request = PostureRequest(
        joint_names=ROBOT.joints, positions=SHOWN, table_height=table.height + off, occupied=BOXES, label=""
    )
    true = CollisionWorld(ROBOT, table, {}, clearance=0.0)
    found = list(motions(request))
    assert len(found) > 2
    assert {pair for motion in found for q in motion.positions for pair in true.contacts(q)} == set()


def test_the_arm_keeps_off_the_floor() -> None:
    world = CollisionWorld(ROBOT, ROBOT.table, {})
    assert any("floor" in pair for pair in world.contacts(ON_THE_FLOOR))
    assert world.contacts(ROBOT.home) == set()


def test_after_a_touch_the_arm_goes_back_the_way_it_came() -> None:
    """Where something is touched no motion is free, and the guard of the next one would stop it at once."""
    request = PostureRequest(
        joint_names=ROBOT.joints, positions=SHOWN, table_height=ROBOT.table.height, occupied=BOXES, label=""
    )
    state = RobotState(joint_names=ROBOT.joints, positions=ROBOT.home, gripper_width=0.1, time=0.0)
    routine = PostureRoutine(request, robot=ROBOT, rng=np.random.default_rng(0), log=print).run()
    next(routine)
    there = routine.send(state)
    halfway = len(there.positions) // 2
    touched = msgspec.structs.replace(state, positions=there.positions[halfway], stopped="touch", reason="9 N")
    back = routine.send(touched)
    assert back.guard is not None and there.guard is not None and back.guard.force > there.guard.force
    assert np.allclose(back.positions[0], touched.positions) and np.allclose(back.positions[-1], ROBOT.home)
    for q in back.positions:
        assert np.abs(there.positions[: halfway + 1] - q).max(1).min() < 0.05
    with pytest.raises(StopIteration) as end:
        routine.send(state)
    assert (end.value.value.success, end.value.value.stopped) == (False, "touch")
    assert np.allclose(end.value.value.positions, ROBOT.home)
