"""Which side of an object a pick and its place leave to be seen."""

from itertools import islice

import numpy as np
import pytest

from stages.geometry.poses import inverse
from stages.messages import Transfer
from stages.planning.motion.pick_place import planners
from tests.stages.planning.scenes import ROBOT, TABLE, catalogue, standing


@pytest.mark.parametrize("faces", [False, True])
@pytest.mark.parametrize("name", ["tea_box", "tuna_can"])
def test_an_object_shows_the_side_that_its_target_says_where_that_matters(name: str, faces: bool) -> None:
    entry, T = catalogue()[name], standing(name, 0.65, 0.1)
    target = standing(name, 0.65, -0.1, yaw=np.pi)
    transfer = Transfer(
        object=name, source="table", destination="table", T_base_targets=target[None], pick="", place="", faces=faces
    )
    _, planner = next(planners(ROBOT, TABLE, {name: (entry, T)}, transfer, np.random.default_rng(0)))
    ends = [
        plan.place.hand.T_base_hand @ inverse(plan.pick.hand.T_object_hand)
        for plan in islice(planner.plans(ROBOT.home), 6)
    ]
    alike = target @ entry.symmetries.transforms(np.deg2rad(22.5))
    assert ends and all(min(np.abs(end - T).max() for T in alike) < 1e-6 for end in ends)
    assert all(np.allclose(end, target, atol=1e-6) for end in ends) == faces
