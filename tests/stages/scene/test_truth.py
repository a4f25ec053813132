"""The end of an episode by the simulator's truth."""

import numpy as np
from scipy.spatial.transform import Rotation

from stages.messages import Goal, Outcome, Snapshot, Verdict
from stages.scene.truth import Judgement, Truth
from stages.scene.virtual import satisfied
from tests.stages.episodes import outcome, transfer
from tests.stages.layouts import T_BASE_TABLE, Layout, catalogue

SHOWN = Layout().put("tray", 0.1, 0.2).put("cup", 0.0, 0.0, on="tray").put("sugar_box", 0.0, -0.2).put(
    "soup_can", 0.0, -0.3
)  # fmt: skip
START = Layout().put("tray", 0.1, 0.2).put("cup", 0.2, -0.1).put("sugar_box", 0.0, -0.2).put("soup_can", 0.0, -0.3)
TRUTH = Truth(catalogue())


def snapshot(layout: Layout, purpose: str) -> Snapshot:
    return Snapshot(
        names=tuple(layout.poses),
        T_base_objects=np.stack([T_BASE_TABLE @ T for T in layout.poses.values()]),
        joint_names=(),
        joint_positions=np.zeros(0),
        time=1.0,
        purpose=purpose,
        T_base_table=T_BASE_TABLE,
    )


def with_pose(layout: Layout, name: str, T: np.ndarray) -> Layout:
    return Layout({**layout.poses, name: T})


def verdict(taught: Layout, perceived: Layout, reason: str = "") -> Verdict:
    held, violated = satisfied(taught.graph(), perceived.graph(), catalogue())
    return Verdict(
        goal_name="tea", success=not violated, failed_stage="executor" if violated else "", reason=reason,
        satisfied=held, violated=violated,
    )  # fmt: skip


def judged(
    final: Layout,
    said: Verdict | None,
    *,
    taught: Layout = SHOWN,
    shown: Layout = SHOWN,
    outcomes: tuple[Outcome, ...] = (),
) -> Judgement:
    snapshots = [
        snapshot(shown, "goal"),
        snapshot(shown, "goal, look 2"),
        snapshot(START, "start"),
        snapshot(final, "after transfer 1"),
    ]
    return TRUTH.judge(snapshots, Goal(name="tea", scene=taught.graph(), pddl=""), said, outcomes)


def test_a_scene_restored_as_claimed() -> None:
    found = judged(SHOWN.disturbed(np.random.default_rng(0), metres=0.002, degrees=1), verdict(SHOWN, SHOWN))
    assert found.restored and found.claimed and not found.false_success
    assert found.differences == () and found.losses == ()
    assert "in(cup, tray)" in map(str, found.held) and "in(soup_can_near_sugar_box, soup_can)" in map(str, found.held)
    assert list(map(str, found.regained)) == ["in(cup, tray)"]


def test_a_success_that_the_truth_denies_is_a_false_one() -> None:
    found = judged(START, verdict(SHOWN, SHOWN))
    assert found.false_success and found.regained == ()
    assert "in(cup, tray) holds by perception and does not hold in truth" in found.differences


def test_a_failure_that_the_truth_denies_is_no_success_but_said() -> None:
    found = judged(SHOWN, verdict(SHOWN, START))
    assert found.restored and not found.claimed and not found.false_success
    assert "in(cup, tray) does not hold by perception and holds in truth" in found.differences


def test_what_was_taught_wrongly_is_judged_by_what_was_shown() -> None:
    found = judged(START, verdict(START, START), taught=START)
    assert found.false_success
    assert "in(cup, tray) is no relation of the goal by perception and does not hold in truth" in found.differences
    assert "on(cup, table) holds by perception and is no relation of the goal in truth" in found.differences


def test_a_neighbour_must_stand_where_it_truly_stood() -> None:
    shown = with_pose(SHOWN, "soup_can", Layout().put("soup_can", 0.0, -0.36).poses["soup_can"])
    assert list(map(str, judged(SHOWN, verdict(SHOWN, SHOWN), shown=shown).violated)) == [
        "in(soup_can_near_sugar_box, soup_can)"
    ]


def test_what_lies_on_the_floor_is_lost_and_does_not_exist() -> None:
    floor = Layout().put("cup", -0.3, 0.0).poses["cup"].copy()
    floor[2, 3] -= 0.7
    found = judged(with_pose(START, "cup", floor), verdict(SHOWN, START, "gave up"))
    assert [str(loss) for loss in found.losses] == ["cup left the table, and nobody said so"]
    assert "exist(cup)" in map(str, found.violated)
    said = judged(with_pose(START, "cup", floor), verdict(SHOWN, START, "not seen: cup (3 looks)"))
    assert [loss.said for loss in said.losses] == [True]


def test_what_lies_though_it_stood_was_knocked_over_and_a_failed_transfer_may_say_so() -> None:
    lying = Layout().put("sugar_box", 0.0, -0.2, resting=1).poses["sugar_box"]
    final = with_pose(SHOWN, "sugar_box", lying)
    assert [str(loss) for loss in judged(final, verdict(SHOWN, SHOWN)).losses] == [
        "sugar_box was knocked over, and nobody said so"
    ]
    slipped = outcome(1, transfer("sugar_box", "table", "tray"), failed_stage="grasp", reason="it slipped")
    assert [loss.said for loss in judged(final, verdict(SHOWN, SHOWN), outcomes=(slipped,)).losses] == [True]


def test_what_lies_as_it_did_at_the_start_is_not_restored() -> None:
    start = with_pose(SHOWN, "sugar_box", Layout().put("sugar_box", 0.0, -0.2, resting=1).poses["sugar_box"])
    found = TRUTH.judge(
        [snapshot(SHOWN, "goal"), snapshot(start, "start")], Goal(name="tea", scene=SHOWN.graph(), pddl=""),
        verdict(SHOWN, SHOWN), (),
    )  # fmt: skip
    assert "on(sugar_box, table)" in map(str, found.violated) and found.false_success and found.losses == ()


def test_what_lies_as_it_was_shown_was_not_knocked_over() -> None:
    lying = Layout().put("sugar_box", 0.0, -0.2, resting=1).poses["sugar_box"]
    shown = with_pose(SHOWN, "sugar_box", lying)
    turned = lying.copy()
    turned[:3, :3] = Rotation.from_rotvec([0, 0, 1.0]).as_matrix() @ lying[:3, :3]
    assert judged(with_pose(shown, "sugar_box", turned), verdict(shown, shown), shown=shown, taught=shown).losses == ()


def test_without_a_goal_nothing_was_restored() -> None:
    found = TRUTH.judge([snapshot(START, "goal")], None, verdict(SHOWN, START), ())
    assert not found.restored and not found.false_success


def test_what_was_not_looked_at_after_the_last_transfer_is_not_restored() -> None:
    stopped = (outcome(1, transfer("cup", "table", "tray")), outcome(2, transfer("sugar_box", "table", "table")))
    found = judged(SHOWN, verdict(SHOWN, SHOWN), outcomes=stopped)
    assert not found.violated and not found.end_seen and not found.restored and found.false_success
    assert judged(SHOWN, verdict(SHOWN, SHOWN), outcomes=stopped[:1]).restored


def test_what_was_lost_before_a_run_was_killed_is_judged_without_a_verdict() -> None:
    lying = Layout().put("sugar_box", 0.0, -0.2, resting=1).poses["sugar_box"]
    found = judged(with_pose(SHOWN, "sugar_box", lying), None)
    assert [str(loss) for loss in found.losses] == ["sugar_box was knocked over, and nobody said so"]
    assert not (found.claimed or found.restored or found.false_success or found.differences)
    assert not judged(SHOWN, None).restored and not TRUTH.judge([], None, None, ()).claimed


def test_equal_objects_are_exchangeable_and_taught_under_any_names() -> None:
    shown = Layout().put("tray", 0.1, 0.2).put("cup", 0.0, 0.0, on="tray").put("cup_2", 0.0, -0.3)
    exchanged = Layout().put("tray", 0.1, 0.2).put("cup_2", 0.0, 0.0, on="tray").put("cup", 0.0, -0.3)
    assert judged(exchanged, verdict(shown, shown), taught=shown, shown=shown).restored
    found = judged(shown, verdict(exchanged, exchanged), taught=exchanged, shown=shown)
    assert found.restored and found.differences == ()


def test_a_loss_is_said_by_the_name_that_the_robot_has_for_it() -> None:
    names = {"sugar_box": "sugar_box_2", "sugar_box_2": "sugar_box"}
    shown = Layout().put("sugar_box", 0.0, 0.1).put("sugar_box_2", 0.0, -0.2)
    start = Layout().put("sugar_box", 0.0, 0.3).put("sugar_box_2", 0.0, -0.2)
    swapped = Layout({names[name]: T for name, T in start.poses.items()})
    final = with_pose(start, "sugar_box_2", Layout().put("sugar_box_2", 0.0, -0.2, resting=1).poses["sugar_box_2"])

    def losses(taught: Layout, began: Layout | None, fell: str) -> list[tuple[str, bool]]:
        looks = [snapshot(one, purpose) for one, purpose in ((shown, "goal"), (start, "start"), (final, "after"))]
        goal, said = Goal(name="tea", scene=taught.graph(), pddl=""), verdict(taught, start, f"x; knocked over: {fell}")
        return [(one.name, one.said) for one in TRUTH.judge(looks, goal, said, (), began and began.graph()).losses]

    as_taught = Layout({names[name]: T for name, T in shown.poses.items()})
    assert losses(as_taught, None, "sugar_box") == losses(shown, swapped, "sugar_box") == [("sugar_box", True)]
    assert losses(as_taught, None, "sugar_box_2") == losses(shown, swapped, "sugar_box_2") == [("sugar_box", False)]


def test_the_only_one_of_its_kind_may_have_been_taught_as_the_second() -> None:
    taught = Layout({{"cup": "cup_2"}.get(name, name): T for name, T in SHOWN.poses.items()})
    found = judged(SHOWN, verdict(taught, taught), taught=taught)
    assert found.restored and found.differences == ()


def test_what_is_in_no_goal_must_stay() -> None:
    stranger = START.poses | {"mug": Layout().put("mug", -0.1, 0.3).poses["mug"]}
    pushed = SHOWN.poses | {"mug": Layout().put("mug", -0.1, 0.36).poses["mug"]}

    def losses(final: dict[str, np.ndarray], *outcomes: Outcome) -> list[str]:
        looks = [snapshot(SHOWN, "goal"), snapshot(Layout(stranger), "start"), snapshot(Layout(final), "after")]
        goal = Goal(name="tea", scene=SHOWN.graph(), pddl="")
        return [str(loss) for loss in TRUTH.judge(looks, goal, verdict(SHOWN, SHOWN), outcomes).losses]

    assert losses(SHOWN.poses | {"mug": stranger["mug"]}) == []
    assert losses(pushed) == ["mug is in no goal and was moved, and nobody said so"]
    carried = outcome(1, transfer("mug", "table", "table"))
    assert losses(pushed, carried) == ["mug is in no goal and was moved, as was said"]


def test_what_is_brought_later_must_stay_where_it_was_put() -> None:
    def losses(y: float) -> list[str]:
        brought = SHOWN.poses | {"mug": Layout().put("mug", -0.1, 0.3).poses["mug"]}
        final = SHOWN.poses | {"mug": Layout().put("mug", -0.1, y).poses["mug"]}
        layouts = {"goal": SHOWN, "start": START, "after transfer 1": Layout(brought), "end": Layout(final)}
        looks = [snapshot(layout, purpose) for purpose, layout in layouts.items()]
        goal = Goal(name="tea", scene=SHOWN.graph(), pddl="")
        return [str(loss) for loss in TRUTH.judge(looks, goal, verdict(SHOWN, SHOWN), ()).losses]

    assert losses(0.3) == []
    assert losses(0.36) == ["mug is in no goal and was moved, and nobody said so"]
