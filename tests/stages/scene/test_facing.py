"""Which side objects show: chosen in a goal, told by what is seen, judged by poses."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.contract import Refused
from stages.messages import Goal, SceneGraph
from stages.messages.scene import Side
from stages.scene.facing import SIDES, TOLD, faced, shows, sides
from stages.scene.goals import without
from stages.scene.stance import yawed
from stages.scene.truth import Truth
from stages.scene.virtual import in_region, satisfied
from tests.stages.layouts import Layout, catalogue
from tests.stages.scene.test_truth import snapshot, verdict

GOAL = Layout().put("tea_box", 0.0, 0.0, yaw=0.4).put("soup_can", 0.0, -0.12)
ANY_SIDE = st.sampled_from(SIDES)


def turned(layout: Layout, name: str, degrees: float) -> Layout:
    T = layout.poses[name].copy()
    T[:3, :3] = yawed(np.deg2rad(degrees), np.zeros(3))[:3, :3] @ T[:3, :3]
    return Layout({**layout.poses, name: T})


def violated(goal: SceneGraph, current: SceneGraph) -> list[str]:
    return [str(item) for item in satisfied(goal, current, catalogue())[1]]


@pytest.mark.parametrize(("side", "degrees"), [("shown", 0), ("left", 90), ("back", 180), ("right", -90)])
def test_a_side_holds_up_to_an_eighth_of_a_turn_whatever_the_shape(side: Side, degrees: float) -> None:
    goal = faced(GOAL.graph(), "tea_box", side)
    said = f"faces(tea_box, {side})"
    for off in (-40, 0, 40):
        assert said not in violated(goal, turned(GOAL, "tea_box", degrees + off).graph())
    for off in (-50, 50, 90, 180):  # 180 degrees look alike without a label.
        assert violated(goal, turned(GOAL, "tea_box", degrees + off).graph()).count(said) == 1


def test_a_side_that_is_not_seen_does_not_count() -> None:
    shown = GOAL.graph().objects[0]
    assert shows(shown, shown.T_base_object)
    for facing in (None, TOLD - 0.01):
        assert not shows(msgspec.structs.replace(shown, facing=facing), shown.T_base_object)


@given(st.lists(ANY_SIDE, min_size=1, max_size=4))
def test_what_stands_beside_stays_where_it_was_shown(chosen: list[Side]) -> None:
    goal = GOAL.graph()
    (region,) = goal.virtual_objects
    assert (region.parent, region.child) == ("tea_box", "soup_can")
    for side in chosen:
        goal = faced(goal, "tea_box", side)
    assert sides(goal) == {"tea_box": chosen[-1]}
    quarter = 90 * SIDES.index(chosen[-1])
    poses = {item.name: item.T_base_object for item in turned(GOAL, "tea_box", quarter).graph().objects}
    symmetries = catalogue()["tea_box"].symmetries
    assert in_region(goal.virtual_objects[0], poses["tea_box"], poses["soup_can"], symmetries)
    back = faced(goal, "tea_box", "any")
    assert sides(back) == {} and back.assertions == GOAL.graph().assertions
    assert np.allclose(back.virtual_objects[0].T_parent_virtual, region.T_parent_virtual)


def test_a_side_is_struck_out_alone_and_with_its_object() -> None:
    goal = faced(GOAL.graph(), "tea_box", "back")
    assert without(goal, "faces(tea_box, back)").assertions == GOAL.graph().assertions
    assert sides(without(goal, "tea_box")) == {}


def test_a_side_that_nobody_can_tell_is_refused() -> None:
    scene = GOAL.graph()
    plain = tuple(msgspec.structs.replace(item, facing=0.5) for item in scene.objects[:1])
    scene = msgspec.structs.replace(scene, objects=(*plain, *scene.objects[1:]))
    for name in ("tea_box", "spoon"):
        with pytest.raises(Refused, match=f"object='{name}': no object of the goal whose side .*; valid: soup_can"):
            faced(scene, name, "back")


def test_the_truth_sees_the_wrong_side() -> None:
    goal = faced(GOAL.graph(), "tea_box", "back")
    for degrees, restored in ((180, True), (0, False)):
        final = turned(GOAL, "tea_box", degrees)
        snapshots = [snapshot(GOAL, "goal"), snapshot(GOAL, "start"), snapshot(final, "after transfer 1")]
        said = verdict(GOAL, final)
        found = Truth(catalogue()).judge(snapshots, Goal(name="tea", scene=goal, pddl=""), said, ())
        assert found.restored == restored and not found.losses
