"""The demonstration's state machine, driven with the messages its neighbours send."""

from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from runner.contract import Command, Message, Refused
from stages.demonstrator import Demonstrator, KeepingDemonstrator, change_of_plan
from stages.geometry import regions
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, pose
from stages.messages import (
    Answer,
    Arrangement,
    Arrived,
    Brake,
    Go,
    Goal,
    Kept,
    Look,
    LookRequest,
    Observation,
    Pause,
    Question,
    Recover,
    Restore,
    RobotState,
    SceneGraph,
    Stop,
    Task,
    Teach,
    Transfer,
    TransferRequest,
    Verdict,
)
from stages.messages.scene import Doubt, SceneObject, UnknownRegion
from stages.messages.task import STOPPED
from stages.robots import BUILT_IN
from stages.scene.facing import faced, sides, turned_to
from stages.scene.virtual import without
from tests.stages.episodes import CATALOGUE, Recorded, outcome, plan, scene, transfer
from tests.stages.layouts import T_BASE_TABLE, Layout
from tests.stages.perception.scenes import K, camera, render, upright

GOAL = scene({"tray": "table", "cup": "tray", "soup_can": "table"}, beside={"soup_can": "tray"})
START = scene({"tray": "table", "soup_can": "table", "cup": "soup_can"}, beside={})
STEP = transfer("cup", "soup_can", "tray")
STILL = RobotState(joint_names=(), positions=np.zeros(0), gripper_width=0.1, time=0.0)
BLIND = Observation(
    depth=np.zeros((2, 2), np.float32), rgb=np.zeros((2, 2, 3), np.uint8), foreground=np.zeros((2, 2), np.bool_),
    K=np.eye(3), T_camera_table=np.eye(4), T_base_camera=None,
)  # fmt: skip
"""Shows nothing, not even that a place is empty."""
LOOK = camera()
LYING = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
CARTON = Layout({"milk_carton": upright("milk_carton", 0.0, -0.05, 0.0)})
HIDDEN = upright("salt_shaker", 0.0, 0.04, 0.0)
OPEN = upright("salt_shaker", 0.15, -0.1, 0.0)


def with_shaker(T_table_object: Floats) -> Layout:
    return Layout({**CARTON.poses, "salt_shaker": T_table_object})


def view(layout: Layout) -> Observation:
    """What the camera sees of a layout."""
    scene = render(layout.poses).scene
    return Observation(
        depth=scene.depth, rgb=np.zeros((*scene.depth.shape, 3), np.uint8), foreground=scene.foreground, K=K,
        T_camera_table=LOOK, T_base_camera=T_BASE_TABLE @ inverse(LOOK),
    )  # fmt: skip


class Episode:
    """A demonstrator and the messages it has sent."""

    def __init__(self, **settings: object) -> None:
        self.stage = Demonstrator(Demonstrator.Config(catalogue=CATALOGUE, **settings))  # type: ignore[arg-type]
        self.ctx = Recorded()
        self.sent: list[Message] = []

    def take(self, result: Message | Iterator[Message] | None) -> list[Message]:
        new = [] if result is None else [result] if isinstance(result, Message) else list(result)
        self.sent += new
        return new

    def arranged(self) -> list[Message]:
        return self.take(self.stage.on_robot_state(STILL, self.ctx))

    def seen(self, graph: SceneGraph, observation: Observation = BLIND) -> list[Message]:
        return self.take(self.stage.on_scene_graph(graph, observation, self.ctx))

    def planned(self, *transfers: Transfer, **fields: str) -> list[Message]:
        return self.take(self.stage.on_plan(plan(*transfers, **fields), self.ctx))

    def ended(self, number: int, item: Transfer, *, at: Floats | None = None, **fields: str) -> list[Message]:
        ending = msgspec.structs.replace(outcome(number, item, **fields), T_base_object=at)
        return self.take(self.stage.on_outcome(ending, self.ctx))

    def called(self, command: Command) -> list[Message]:
        handler = getattr(self.stage, f"on_{type(command).__name__.lower()}")
        return self.take(handler(command, self.ctx))

    def until_start(self, goal: SceneGraph) -> None:
        """Everything up to the look at the start scene."""
        self.take(self.stage.on_start(self.ctx))
        self.arranged()
        self.seen(goal)
        self.arranged()

    def until_task(self, goal: SceneGraph = GOAL, start: SceneGraph = START) -> Task:
        """Everything up to the first request for a plan."""
        self.until_start(goal)
        (task,) = self.seen(start)
        assert isinstance(task, Task)
        return task

    def until_transfer(self) -> TransferRequest:
        self.until_task()
        (request,) = self.planned(STEP)
        assert isinstance(request, TransferRequest)
        return request


def test_any_number_of_objects_is_accepted_where_it_is_to_be_found() -> None:
    episode = Episode(n_objects="auto")
    episode.until_task()
    with pytest.raises(Refused, match=r"demonstrator\.n_objects=-1: must be 0 or more, or auto"):
        Episode(n_objects=-1)


def the_verdict(messages: list[Message]) -> Verdict:
    (verdict,) = messages
    assert isinstance(verdict, Verdict)
    return verdict


def test_shows_disturbs_and_restores_a_goal() -> None:
    episode = Episode()
    request = episode.until_transfer()
    assert [type(message) for message in episode.sent] == [
        Arrangement, LookRequest, Goal, Arrangement, LookRequest, Task, TransferRequest,
    ]  # fmt: skip
    assert request.transfer == STEP and request.scene is START and request.number == 1
    (look,) = episode.ended(1, STEP)
    assert look == LookRequest(purpose="after transfer 1")
    verdict = the_verdict(episode.seen(GOAL))
    assert verdict.success and not verdict.violated and len(verdict.satisfied) == len(GOAL.assertions)
    assert (verdict.looks, verdict.plans, verdict.transfers) == (3, 1, 1)


def test_what_nobody_recognised_on_what_the_goal_wants_clear_is_no_success() -> None:
    layout = Layout().put("tea_box", 0.0, 0.0).put("cup", 0.2, 0.0)
    goal, top = layout.graph(), 0.08

    def with_thing(bottom: float) -> SceneGraph:
        """Something 4 cm high over the box's middle, metres above the table."""
        centre, extent = np.array([0.0, 0.0, bottom + 0.02]), np.array([0.05, 0.05, 0.04])
        thing = UnknownRegion(box=np.zeros(4), points=500, centre_table=centre, extent_table=extent)
        return msgspec.structs.replace(goal, unknown=(thing,))

    for taught, seen in ((goal, with_thing(top - 0.04)), (with_thing(top), with_thing(top))):
        episode = Episode(repeats=0)
        episode.until_start(taught)
        assert the_verdict(episode.seen(seen)).success, "it stands beside the box, or stood there in the goal"

    episode = Episode(repeats=1)
    episode.until_start(goal)
    (look,) = episode.seen(with_thing(top))
    assert look == LookRequest(purpose="start, look 2"), "it may be gone at the next look"
    verdict = the_verdict(episode.seen(with_thing(top)))
    assert (verdict.failed_stage, verdict.reason) == (
        "perception", "something unknown stands on tea_box, which the goal wants clear (2 looks at scene 'start'); "
        "every other relation of the goal holds",
    )  # fmt: skip
    assert [str(item) for item in verdict.violated] == ["clear(tea_box)"]
    assert len(verdict.satisfied) == len(goal.assertions) - 1

    episode = Episode(repeats=1)
    episode.until_start(goal)
    episode.seen(with_thing(top))
    assert the_verdict(episode.seen(goal)).success


@pytest.mark.parametrize(("probability", "stays"), [(0.02, False), (0.7, True)])
def test_what_one_look_at_a_goal_took_to_be_there_in_doubt_and_no_other_showed_is_no_part_of_it(
    probability: float, stays: bool
) -> None:
    laid = with_shaker(HIDDEN)
    both = laid.graph()
    doubted = tuple(
        msgspec.structs.replace(one, probability=probability if one.name == "salt_shaker" else 1.0)
        for one in both.objects
    )
    episode = Episode(scripted=False, repeats=1)
    episode.called(Teach(name="tea"))
    episode.seen(msgspec.structs.replace(both, objects=doubted), view(laid))
    (goal,) = episode.seen(CARTON.graph(), view(laid))
    assert isinstance(goal, Goal)
    assert ("salt_shaker" in {item.name for item in goal.scene.objects}) == stays
    assert any("salt_shaker" in item.arguments for item in goal.scene.assertions) == stays


def test_what_nobody_recognised_in_the_goal_must_be_there_again() -> None:
    """Of a bowl under a mug a ring shows; a mug by itself is not that goal, though nobody can say what it lacks."""

    def with_thing(x: float) -> SceneGraph:
        centre, extent = np.array([x, 0.2, 0.02]), np.array([0.05, 0.05, 0.04])
        return msgspec.structs.replace(
            GOAL, unknown=(UnknownRegion(box=np.zeros(4), points=90, centre_table=centre, extent_table=extent),)
        )

    for seen, there in ((with_thing(0.04), True), (with_thing(0.2), False), (GOAL, False)):
        episode = Episode(repeats=0)
        episode.until_start(with_thing(0.0))
        verdict = the_verdict(episode.seen(seen))
        assert (verdict.success, verdict.failed_stage) == (there, "" if there else "perception")
        assert ("no object explained when the goal was taught" in verdict.reason) is not there and not verdict.violated


@pytest.mark.parametrize("turn", [1, 3])
def test_a_goal_of_many_equal_objects_holds_whichever_is_which(turn: int) -> None:
    """Six shakers, one on each carrier, can be named in 720 ways."""
    carriers = ["tea_box", "sugar_box", "milk_carton", "soup_can", "tuna_can", "cereal_box"]
    shakers = ["salt_shaker", *(f"salt_shaker_{k}" for k in range(2, 7))]

    def laid_out(names: list[str]) -> SceneGraph:
        layout = Layout()
        for k, carrier in enumerate(carriers):
            layout.put(carrier, 0.12 * k - 0.3, 0.0)
        for name, carrier in sorted(zip(names, carriers, strict=True)):
            layout.put(name, 0.0, 0.0, on=carrier)
        return layout.graph()

    episode = Episode()
    episode.until_start(laid_out(shakers))
    assert the_verdict(episode.seen(laid_out(shakers[turn:] + shakers[:turn]))).success


UNUSABLE = msgspec.structs.replace(BLIND, unusable="look 3: no support plane")
"""What a look shows that somebody leans into; the scene graph that comes with it is empty."""
NOTHING = without(GOAL, {item.name for item in GOAL.objects})


def test_a_look_that_shows_nothing_is_taken_again_and_ends_in_a_verdict_if_all_do() -> None:
    """What was known before stays, and nothing is done by it."""
    episode = Episode(repeats=1)
    episode.until_transfer()
    episode.ended(1, STEP)
    assert episode.seen(NOTHING, UNUSABLE) == [LookRequest(purpose="after transfer 1, look 2")]
    verdict = the_verdict(episode.seen(GOAL))
    assert verdict.success and verdict.looks == 4

    episode = Episode(repeats=1)
    episode.until_start(GOAL)
    for _ in range(2):
        messages = episode.seen(NOTHING, UNUSABLE)
    verdict = the_verdict(messages)
    assert (verdict.failed_stage, verdict.reason, verdict.transfers) == (
        "perception", "look 3: no support plane (2 looks at scene 'start')", 0,
    )  # fmt: skip


def test_a_new_scene_is_looked_at_from_all_views_and_what_one_shows_is_there() -> None:
    episode = Episode(robot=BUILT_IN.with_name("ur5e_hand.yaml"))
    episode.take(episode.stage.on_start(episode.ctx))
    episode.arranged()
    part = without(GOAL, {"cup"})
    above = pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    somewhere = msgspec.structs.replace(BLIND, T_camera_table=above, T_base_camera=inverse(above))
    (aside,), (other,) = episode.seen(GOAL), episode.seen(part, somewhere)
    goal, _ = episode.seen(part, somewhere)
    assert isinstance(goal, Goal) and {item.name for item in goal.scene.objects} == {"tray", "cup", "soup_can"}
    episode.arranged()
    episode.seen(START)
    episode.seen(START)
    (task,) = episode.seen(START)
    looks = [message for message in episode.sent if isinstance(message, LookRequest)]
    assert [(look.purpose, look.view) for look in looks] == [
        (f"{kind}{where}", view)
        for kind in ("goal", "start")
        for where, view in ((", from view 1", 1), (", from view 2", 2), ("", 0))
    ]
    assert (aside, other) == (looks[1], looks[2]) and isinstance(task, Task)
    episode.planned(STEP)
    assert episode.ended(1, STEP) == [LookRequest(purpose="after transfer 1")], "what is known is looked at from home"
    assert episode.seen(part)[0] == LookRequest(purpose="after transfer 1, look 2, from view 1", view=1)


def test_equal_objects_of_which_each_view_shows_another_one_are_all_in_the_goal() -> None:
    both = view(Layout({**CARTON.poses, "salt_shaker": HIDDEN, "salt_shaker_2": OPEN}))
    episode = Episode(robot=BUILT_IN.with_name("ur5e_hand.yaml"), scripted=False)
    episode.called(Teach(name="shakers"))
    for shaker in (HIDDEN, HIDDEN, OPEN):
        goal, *_ = episode.seen(with_shaker(shaker).graph(), both)
    assert isinstance(goal, Goal)
    stand = {item.name: item.T_base_object for item in goal.scene.objects if item.label == "salt_shaker"}
    np.testing.assert_allclose(stand["salt_shaker"], T_BASE_TABLE @ HIDDEN, atol=1e-9)
    np.testing.assert_allclose(stand["salt_shaker_2"], T_BASE_TABLE @ OPEN, atol=1e-9)


def test_what_was_knocked_over_is_set_upright_and_named_where_it_cannot_be() -> None:
    episode = Episode(repeats=0)
    episode.until_transfer()
    episode.ended(1, STEP)
    name = GOAL.objects[-1].name

    def lain(item: SceneObject) -> SceneObject:
        return msgspec.structs.replace(item, T_base_object=pose(LYING, item.T_base_object[:3, 3]))

    objects = tuple(lain(item) if item.name == name else item for item in GOAL.objects)
    (task,) = episode.seen(msgspec.structs.replace(GOAL, objects=objects))
    assert isinstance(task, Task)
    verdict = the_verdict(episode.planned(status="refused", reason="no way to lift it"))
    assert verdict.reason.endswith(f"; knocked over: {name}")


@pytest.mark.parametrize(("R", "said"), [(LYING, "; knocked over: milk_carton"), (np.eye(3), "goal holds")])
def test_what_lies_and_nobody_had_seen_before_is_named(R: Floats, said: str) -> None:
    """It stood behind something, and is in no goal."""
    episode = Episode()
    episode.until_transfer()
    episode.ended(1, STEP)
    (carton,) = CARTON.graph().objects
    carton = msgspec.structs.replace(carton, T_base_object=pose(R, carton.T_base_object[:3, 3]))
    verdict = the_verdict(episode.seen(msgspec.structs.replace(GOAL, objects=(*GOAL.objects, carton))))
    assert verdict.success and verdict.reason.endswith(said)


def test_what_is_in_no_goal_and_not_seen_any_more_is_named() -> None:
    episode = Episode()
    carton, shaker = (Layout({name: upright(name, 0.0, 0.3, 0.0)}).graph() for name in ("milk_carton", "salt_shaker"))
    doubtful = msgspec.structs.replace(shaker.objects[0], probability=0.2)
    episode.until_task(start=msgspec.structs.replace(START, objects=(*START.objects, *carton.objects, doubtful)))
    episode.planned(STEP)
    episode.ended(1, STEP)
    verdict = the_verdict(episode.seen(GOAL, view(Layout({}))))
    assert verdict.success and verdict.reason.endswith("goal holds; not seen any more: milk_carton")


def test_remembers_the_goal_as_pddl_by_name() -> None:
    episode = Episode(goal_name="tea-time")
    episode.until_task()
    (goal,) = [message for message in episode.sent if isinstance(message, Goal)]
    assert goal.name == "tea-time" and goal.scene is GOAL
    assert "(in cup tray)" in goal.pddl and "tea-time" in goal.pddl


def test_a_start_that_is_the_goal_needs_no_plan() -> None:
    episode = Episode()
    episode.take(episode.stage.on_start(episode.ctx))
    episode.arranged()
    episode.seen(GOAL)
    episode.arranged()
    assert the_verdict(episode.seen(GOAL)).success


def test_robot_states_of_motions_are_not_arrangements() -> None:
    episode = Episode()
    episode.until_transfer()
    assert episode.arranged() == []
    episode.ended(1, STEP)
    assert episode.arranged() == []


def test_a_scene_nobody_asked_for_is_ignored() -> None:
    episode = Episode()
    episode.until_transfer()
    assert episode.seen(GOAL) == []


def test_where_the_planner_finds_nothing_to_do_the_relation_that_does_not_hold_is_named() -> None:
    episode = Episode(repeats=0)
    episode.until_task()
    verdict = the_verdict(episode.planned(status="satisfied"))
    expected = f"the planner finds nothing to do; {verdict.violated[0]} does not hold"
    assert verdict.failed_stage == "planner" and verdict.reason.startswith(expected)


def test_a_refused_plan_is_the_planners_verdict() -> None:
    episode = Episode(repeats=0)
    episode.until_task()
    verdict = the_verdict(episode.planned(status="refused", reason="no action frees spoon"))
    assert not verdict.success and verdict.failed_stage == "planner" and "no action frees spoon" in verdict.reason
    assert verdict.violated


def test_a_refusal_is_looked_at_again_before_it_counts() -> None:
    episode = Episode(repeats=1)
    episode.until_task()
    assert episode.planned(status="refused", reason="cup is on itself") == [LookRequest(purpose="start, look 2")]
    (task,) = episode.seen(START)
    assert isinstance(task, Task)
    assert the_verdict(episode.planned(status="refused", reason="cup is on itself")).plans == 2


def test_a_failed_transfer_is_tried_again_then_avoided() -> None:
    episode = Episode(tries=2)
    episode.until_transfer()
    episode.ended(1, STEP, failed_stage="grasp", reason="cup slipped")
    (task,) = episode.seen(START)
    assert isinstance(task, Task) and task.avoid == ()
    episode.planned(STEP)
    assert "plan 2 (kept): cup to tray" in episode.ctx.lines
    episode.ended(2, STEP, failed_stage="grasp", reason="cup slipped")
    (task,) = episode.seen(START)
    assert isinstance(task, Task) and task.avoid == (STEP.key,)
    for number, avoided in ((3, (STEP.key,)), (4, (STEP.key, STEP.key))):
        episode.planned(STEP)
        episode.ended(number, STEP, failed_stage="grasp", reason="cup slipped")
        (task,) = episode.seen(START)
        assert isinstance(task, Task) and task.avoid == avoided


def test_what_was_put_aside_after_failures_is_not_put_aside_again() -> None:
    """Its transfers go to other places, from where it stands now."""
    episode = Episode(tries=2)
    episode.until_task()
    for number in (1, 2, 3, 4):
        episode.planned(STEP)
        episode.ended(number, STEP, failed_stage="touch", reason="8 N at the hand")
        (task,) = episode.seen(START)
    assert isinstance(task, Task) and task.avoid == (STEP.key, STEP.key)
    aside = transfer("cup", "soup_can", "table")
    episode.planned(aside, STEP)
    episode.ended(5, aside)
    (task,) = episode.seen(scene({"tray": "table", "soup_can": "table", "cup": "table"}, beside={}))
    assert isinstance(task, Task) and task.avoid == (STEP.key,)


def test_a_transfer_that_ends_outside_its_region_counts_as_failed() -> None:
    def off(item: SceneObject) -> SceneObject:
        away = pose(item.T_base_object[:3, :3], item.T_base_object[:3, 3] + [0.0, 0.3, 0.0])
        return msgspec.structs.replace(item, T_base_object=away) if item.name == "soup_can" else item

    episode, beyond = Episode(tries=1), msgspec.structs.replace(GOAL, objects=tuple(map(off, GOAL.objects)))
    episode.until_task(start=beyond)
    place = "(place-at-region soup_can soup_can_near_tray tray table)"
    step = msgspec.structs.replace(transfer("soup_can", "table", "table"), place=place)
    episode.planned(step)
    episode.ended(1, step)
    (task,) = episode.seen(beyond)
    assert isinstance(task, Task) and task.avoid == (step.key,)


def test_a_transfer_that_misses_its_relation_counts_as_failed() -> None:
    episode = Episode(tries=1)
    episode.until_transfer()
    episode.ended(1, STEP)
    (task,) = episode.seen(START)
    assert isinstance(task, Task) and task.avoid == (STEP.key,)


def test_no_way_left_after_failures_blames_the_executor() -> None:
    episode = Episode(tries=1, repeats=0)
    episode.until_transfer()
    episode.ended(1, STEP, failed_stage="ik", reason="no grasp of cup is reachable")
    episode.seen(START)
    verdict = the_verdict(episode.planned(status="refused", reason="every plan is avoided"))
    assert verdict.failed_stage == "executor" and "ik: no grasp of cup is reachable" in verdict.reason


def test_an_object_that_is_not_seen_is_looked_for_then_named() -> None:
    episode = Episode(repeats=1)
    episode.until_transfer()
    episode.ended(1, STEP)
    without_cup = without(GOAL, {"cup"})
    assert episode.seen(without_cup) == [LookRequest(purpose="after transfer 1, look 2")]
    verdict = the_verdict(episode.seen(without_cup))
    assert verdict.failed_stage == "perception" and "not seen: cup" in verdict.reason
    assert "exist(cup)" in [str(item) for item in verdict.violated]


def test_everything_but_a_missing_object_is_restored() -> None:
    """The cup is missing; the can, which belongs on the box, is put there all the same, and the cup is named."""
    goal = scene({"tray": "table", "cup": "tray", "tea_box": "table", "soup_can": "tea_box"})
    found = {"tray": "table", "tea_box": "table", "soup_can": "table"}
    step = transfer("soup_can", "table", "tea_box")
    episode = Episode(repeats=0)
    task = episode.until_task(goal, scene(found))
    assert [item.name for item in task.goal.objects] == ["tray", "tea_box", "soup_can"]
    episode.planned(step)
    episode.ended(1, step)
    verdict = the_verdict(episode.seen(scene({**found, "soup_can": "tea_box"})))
    assert verdict.failed_stage == "perception" and "not seen: cup" in verdict.reason
    assert "exist(cup)" in [str(item) for item in verdict.violated]
    assert "on(soup_can, tea_box)" in [str(item) for item in verdict.satisfied]


def told(graph: SceneGraph, T_base_carton: Floats, facing: float) -> SceneGraph:
    """A scene in which the milk carton stands like that, and how well its side is told."""
    return msgspec.structs.replace(
        graph,
        objects=tuple(
            msgspec.structs.replace(item, T_base_object=T_base_carton, facing=facing)
            if item.label == "milk_carton"
            else item
            for item in graph.objects
        ),
    )


@pytest.mark.parametrize("facing", [0.99, 0.5])
def test_what_is_turned_is_done_once_the_right_side_is_seen(facing: float) -> None:
    """Where nobody sees the side it is turned as often as is tried, and the rest is restored all the same."""
    shown = {"milk_carton": "table", "soup_can": "milk_carton"}
    T = scene(shown).objects[0].T_base_object
    goal = faced(told(scene(shown), T, 0.99), "milk_carton", "back")
    found = scene({"milk_carton": "table", "soup_can": "table"})
    step = msgspec.structs.replace(
        transfer("milk_carton", "table", "table"), T_base_targets=turned_to(T, "back")[None], faces=True
    )
    episode = Episode(scripted=False)
    keeping = KeepingDemonstrator(Demonstrator.Config(catalogue=CATALOGUE, scripted=False))
    episode.stage = keeping
    keeping.on_kept(Kept(goals=(Goal(name="milk", scene=goal, pddl=""),)))
    episode.called(Restore(name="milk"))
    (task,) = episode.seen(told(found, T, 0.99))
    for number in (1, 2):
        assert isinstance(task, Task) and "faces(milk_carton, back)" in map(str, task.goal.assertions)
        episode.planned(step, transfer("soup_can", "table", "milk_carton"))
        episode.ended(number, step)
        (task,) = episode.seen(told(found, turned_to(T, "back"), facing))
        if facing > 0.9:
            assert isinstance(task, Task) and "transfer 1, milk_carton to table: done" in episode.ctx.lines
            return
    assert isinstance(task, Task) and not sides(task.goal) and "soup_can" in str(task.goal.assertions)
    lift = transfer("soup_can", "table", "milk_carton")
    episode.planned(lift)
    episode.ended(3, lift)
    verdict = the_verdict(episode.seen(told(scene(shown), turned_to(T, "back"), facing)))
    assert (verdict.success, verdict.failed_stage) == (False, "perception")
    assert verdict.reason == (
        "milk_carton is not seen to show the side that it should; every other relation of the goal holds"
    )
    assert [str(item) for item in verdict.violated] == ["faces(milk_carton, back)"]


def test_an_object_found_on_the_second_look_goes_on() -> None:
    episode = Episode(repeats=1)
    episode.until_transfer()
    episode.ended(1, STEP)
    episode.seen(scene({"tray": "table", "soup_can": "table"}))
    assert the_verdict(episode.seen(GOAL)).success


def until_hidden(*, at: Floats | None) -> Episode:
    """The shaker, which stood in the open, has been moved behind the carton; ``at`` is where the hand let go of it."""
    episode = Episode(repeats=1)
    episode.until_task(with_shaker(HIDDEN).graph(), with_shaker(OPEN).graph())
    step = transfer("salt_shaker", "table", "table")
    episode.planned(step)
    episode.ended(1, step, at=at)
    return episode


def test_an_object_that_is_hidden_counts_as_being_where_it_was_placed() -> None:
    episode = until_hidden(at=T_BASE_TABLE @ HIDDEN)
    verdict = the_verdict(episode.seen(CARTON.graph(), view(with_shaker(HIDDEN))))
    assert verdict.success and "remembered, not seen: salt_shaker" in verdict.reason


def test_an_object_that_was_neither_felt_to_stand_nor_seen_does_not_count_as_being_there() -> None:
    """Nor does it after another transfer, which went well."""
    episode = Episode(repeats=1)
    episode.until_task(with_shaker(HIDDEN).graph(), with_shaker(OPEN).graph())
    step, look = transfer("salt_shaker", "table", "table"), view(with_shaker(HIDDEN))
    episode.planned(step)
    episode.ended(1, step, at=T_BASE_TABLE @ HIDDEN, failed_stage="unknown", reason="nothing was felt")
    assert episode.seen(CARTON.graph(), look) == [LookRequest(purpose="after transfer 1, look 2")]
    verdict = the_verdict(episode.seen(CARTON.graph(), look))
    said = "let go of, neither felt to stand nor seen since: salt_shaker"
    assert (verdict.success, verdict.failed_stage) == (False, "perception") and said in verdict.reason

    episode, away, home = Episode(repeats=1), with_shaker(OPEN), with_shaker(HIDDEN)
    away.put("cup", -0.15, -0.1)
    home.put("cup", 0.0, 0.0, on="milk_carton")
    onto = transfer("cup", "table", "milk_carton")
    episode.until_task(home.graph(), away.graph())
    episode.planned(step, onto)
    episode.ended(1, step, at=T_BASE_TABLE @ HIDDEN, failed_stage="unknown", reason="nothing was felt")
    (task,) = episode.seen(less(away), look)
    assert isinstance(task, Task)
    episode.planned(onto)
    episode.ended(2, onto)
    assert episode.seen(less(home), look) == [LookRequest(purpose="after transfer 2, look 2")]
    assert the_verdict(episode.seen(home.graph(), look)).success


def less(layout: Layout) -> SceneGraph:
    """A look that does not show the shaker."""
    return Layout({name: T for name, T in layout.poses.items() if name != "salt_shaker"}).graph()


def test_an_object_that_something_was_placed_in_front_of_counts_as_being_where_it_was_seen() -> None:
    aside = Layout({"milk_carton": upright("milk_carton", -0.15, -0.1, 0.0), "salt_shaker": HIDDEN})
    episode = Episode()
    episode.until_task(with_shaker(HIDDEN).graph(), aside.graph())
    step = transfer("milk_carton", "table", "table")
    episode.planned(step)
    episode.ended(1, step)
    verdict = the_verdict(episode.seen(CARTON.graph(), view(with_shaker(HIDDEN))))
    assert verdict.success and "salt_shaker" in verdict.reason


def test_an_object_whose_place_is_seen_empty_is_looked_for_then_named() -> None:
    episode = until_hidden(at=None)
    seen = CARTON.graph(), view(CARTON)
    assert episode.seen(*seen) == [LookRequest(purpose="after transfer 1, look 2")]
    verdict = the_verdict(episode.seen(*seen))
    assert verdict.failed_stage == "perception" and "not seen: salt_shaker" in verdict.reason


@pytest.mark.parametrize(("probability", "left"), [(0.3, ()), (0.9, ("salt_shaker",))])
def test_what_nobody_asked_for_and_is_hardly_there_is_not_remembered(probability: float, left: tuple[str, ...]) -> None:
    """A shaker that one look makes out behind the carton, and the next one does not."""
    episode, goal = Episode(), Layout({"milk_carton": upright("milk_carton", 0.1, 0.0, 0.0)})
    goal.put("cup", 0.0, 0.0, on="milk_carton")
    everything = Layout({**with_shaker(HIDDEN).poses, "cup": OPEN})
    episode.until_task(goal.graph(), judged(everything.graph(), probability))
    assert episode.planned(status="refused", reason="no room") == [LookRequest(purpose="start, look 2")]
    (task,) = episode.seen(Layout({**CARTON.poses, "cup": OPEN}).graph(), view(everything))
    assert isinstance(task, Task) and {item.name for item in task.current.objects} == {"milk_carton", "cup", *left}


def test_memory_ends_where_somebody_lays_the_scene_out_anew() -> None:
    episode = Episode()
    episode.take(episode.stage.on_start(episode.ctx))
    episode.arranged()
    episode.seen(with_shaker(HIDDEN).graph(), view(with_shaker(HIDDEN)))
    episode.arranged()
    assert episode.seen(CARTON.graph(), view(with_shaker(HIDDEN))) == [LookRequest(purpose="start, look 2")]


def test_looks_at_one_scene_complete_each_other() -> None:
    episode = Episode(n_objects=2)
    episode.take(episode.stage.on_start(episode.ctx))
    episode.arranged()
    everything, shaker = with_shaker(HIDDEN), Layout({"salt_shaker": HIDDEN})
    assert episode.seen(shaker.graph(), view(everything)) == [LookRequest(purpose="goal, look 2")]
    goal, _ = episode.seen(CARTON.graph(), view(everything))
    assert isinstance(goal, Goal) and {item.name for item in goal.scene.objects} == {"milk_carton", "salt_shaker"}


def test_a_goal_with_too_few_objects_is_not_remembered() -> None:
    episode = Episode(n_objects=4, repeats=1)
    episode.take(episode.stage.on_start(episode.ctx))
    episode.arranged()
    assert episode.seen(GOAL) == [LookRequest(purpose="goal, look 2")]
    verdict = the_verdict(episode.seen(GOAL))
    assert verdict.failed_stage == "perception" and "3 of 4 objects" in verdict.reason
    assert not verdict.satisfied and not verdict.violated


def test_a_goal_in_which_something_hangs_in_the_air_is_not_remembered() -> None:
    episode = Episode(repeats=1)
    episode.take(episode.stage.on_start(episode.ctx))
    episode.arranged()
    tower = Layout().put("tuna_can", 0.1, 0.0).put("soup_can", 0.0, 0.0, on="tuna_can")
    gap = Layout({name: T for name, T in tower.poses.items() if name != "tuna_can"}).graph()
    assert episode.seen(gap) == [LookRequest(purpose="goal, look 2")]
    verdict = the_verdict(episode.seen(gap))
    assert (verdict.failed_stage, verdict.reason) == (
        "perception", "not seen: what carries soup_can (2 looks at scene 'goal')",
    )  # fmt: skip


def test_an_episode_that_never_succeeds_ends() -> None:
    episode = Episode(max_transfers=5)
    episode.until_task()
    for number in range(1, 6):
        episode.planned(STEP)
        episode.ended(number, STEP)
        answer = episode.seen(START)
    verdict = the_verdict(answer)
    assert verdict.failed_stage == "executor" and verdict.transfers == 5 and "5 transfers" in verdict.reason


def test_plans_that_keep_changing_end() -> None:
    episode = Episode(max_replans=2)
    episode.until_task()
    for number in range(1, 4):
        step = transfer(f"cup_{number}", "table", "tray")
        assert isinstance(episode.planned(step)[0], TransferRequest)
        episode.ended(number, step, failed_stage="grasp", reason="slipped")
        episode.seen(START)
    verdict = the_verdict(episode.planned(transfer("cup_4", "table", "tray")))
    assert verdict.failed_stage == "planner" and "replaced 3 times; " in verdict.reason
    assert verdict.reason.endswith(f"{verdict.violated[0]} does not hold")


def test_after_the_verdict_nothing_happens() -> None:
    episode = Episode()
    episode.until_transfer()
    episode.ended(1, STEP)
    episode.seen(GOAL)
    assert [*episode.arranged(), *episode.seen(START), *episode.planned(STEP), *episode.ended(1, STEP)] == []


def test_goals_are_taught_and_restored_by_name() -> None:
    episode = Episode(scripted=False)
    assert episode.take(episode.stage.on_start(episode.ctx)) == [Arrangement(kind="goal")]
    assert episode.arranged() == []
    for name, shown in (("tea", GOAL), ("mess", START)):
        assert episode.called(Teach(name=name)) == [LookRequest(purpose=f"goal {name}")]
        (goal,) = episode.seen(shown)
        assert isinstance(goal, Goal) and goal.name == name and goal.scene is shown
    assert episode.called(Restore(name="tea")) == [LookRequest(purpose="restore tea")]
    (task,) = episode.seen(START)
    assert isinstance(task, Task) and task.goal is GOAL and task.goal_name == "tea"
    episode.planned(STEP)
    episode.ended(1, STEP)
    assert the_verdict(episode.seen(GOAL)).success
    episode.called(Restore(name="mess"))
    verdict = the_verdict(episode.seen(START))
    assert (verdict.goal_name, verdict.success, verdict.transfers) == ("mess", True, 0)


def test_a_goal_that_cannot_be_seen_is_a_verdict_and_the_next_command_works() -> None:
    episode = Episode(scripted=False, n_objects=4, repeats=0)
    episode.called(Teach(name="tea"))
    assert the_verdict(episode.seen(GOAL)).failed_stage == "perception"
    assert episode.called(Teach(name="tea")) == [LookRequest(purpose="goal tea")]


def test_a_look_remembers_nothing_and_the_next_command_works() -> None:
    episode = Episode(scripted=False)
    assert episode.called(Look()) == [LookRequest(purpose="look")]
    with pytest.raises(Refused, match="busy: waits for a scene graph"):
        episode.called(Look())
    assert episode.seen(GOAL) == []
    assert episode.called(Teach(name="tea")) == [LookRequest(purpose="goal tea")]


def test_a_stop_ends_a_job_with_what_is_under_way_and_the_next_command_works() -> None:
    episode = Episode(scripted=False)
    with pytest.raises(Refused, match="nothing is under way"):
        episode.called(Stop())

    def stopped(messages: list[Message]) -> None:
        verdict = the_verdict(messages)
        assert (verdict.success, verdict.failed_stage, verdict.reason) == (False, STOPPED, "stopped, as asked")

    episode.called(Teach(name="tea"))
    assert episode.called(Stop()) == []
    stopped(episode.seen(GOAL))
    episode.called(Teach(name="tea"))
    episode.seen(GOAL)
    for until in ("plan", "outcome"):
        episode.called(Restore(name="tea"))
        episode.seen(START)
        if until == "outcome":
            episode.planned(STEP)
        assert episode.called(Stop()) == []
        stopped(episode.planned(STEP) if until == "plan" else episode.ended(1, STEP))
        assert episode.seen(GOAL) == []


def test_a_stop_while_the_arm_comes_home_ends_the_task_there() -> None:
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    episode.seen(GOAL)
    episode.called(Restore(name="tea"))
    episode.called(Stop(now=True))
    episode.seen(START)
    for _ in range(2):
        assert episode.called(Restore(name="tea")) == [Recover()]
        assert episode.called(Stop()) == []
        assert the_verdict(episode.ended(0, STEP)).failed_stage == STOPPED


@pytest.mark.parametrize("until", ["the scene is arranged", "scene", "plan"])
def test_the_verdict_of_a_stop_counts_what_ended_with_it(until: str) -> None:
    """The report waits for as many looks and plans; of a scene that was not looked at it says nothing."""
    episode = Episode()
    if until == "plan":
        episode.until_task()
        episode.called(Stop())
        verdict = the_verdict(episode.planned(STEP))
        assert (verdict.looks, verdict.plans) == (2, 1)
        return
    episode.take(episode.stage.on_start(episode.ctx))
    episode.arranged()
    episode.seen(GOAL)
    if until == "scene":
        episode.arranged()
    episode.called(Stop())
    verdict = the_verdict(episode.seen(START) if until == "scene" else episode.arranged())
    assert (verdict.looks, verdict.satisfied, verdict.violated) == (1 + (until == "scene"), (), ())


@pytest.mark.parametrize("until", ["plan", "outcome", "scene"])
def test_a_stop_at_once_brakes_the_arm_whatever_is_under_way_and_it_first_comes_home_after(until: str) -> None:
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    episode.seen(GOAL)
    episode.called(Restore(name="tea"))
    episode.seen(START)
    if until != "plan":
        episode.planned(STEP)
    if until == "scene":
        episode.ended(1, STEP)
    assert episode.called(Stop(now=True)) == [Brake()]
    match until:
        case "plan":
            ended = episode.planned(STEP)
        case "outcome":
            ended = episode.ended(1, STEP)
        case _:
            ended = episode.seen(START)
    assert the_verdict(ended).failed_stage == STOPPED
    assert episode.called(Restore(name="tea")) == [Recover()]


def test_an_arm_that_fails_on_its_way_to_a_look_ends_the_task_and_first_comes_home_after() -> None:
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    arrived = Arrived(
        success=False, reason="protective stop on the way to show 1", stopped="fault", joint_names=(),
        positions=np.zeros(0), robot_seconds=1.0,
    )  # fmt: skip
    verdict = the_verdict(episode.take(episode.stage.on_arrived(arrived, episode.ctx)))
    assert (verdict.failed_stage, verdict.reason) == ("executor", "protective stop on the way to show 1")
    assert episode.called(Teach(name="tea")) == [Recover()]


def test_nothing_is_no_goal() -> None:
    episode = Episode(scripted=False, repeats=0)
    episode.called(Teach(name="tea"))
    empty = msgspec.structs.replace(GOAL, objects=(), assertions=(), virtual_objects=())
    verdict = the_verdict(episode.seen(empty))
    assert (verdict.success, verdict.reason) == (False, "0 of 1 objects seen (1 looks at scene 'goal tea')")
    keeping = KeepingDemonstrator(Demonstrator.Config(catalogue=CATALOGUE, scripted=False))
    keeping.on_kept(Kept(goals=(Goal(name="void", scene=empty, pddl=""),)))
    with pytest.raises(Refused, match="name='void': names no object"):
        keeping.on_restore(Restore(name="void"), episode.ctx)


def test_what_is_kept_on_disk_can_be_restored_and_what_was_deleted_cannot() -> None:
    episode = Episode(scripted=False)
    keeping = KeepingDemonstrator(Demonstrator.Config(catalogue=CATALOGUE, scripted=False))
    episode.stage = keeping
    keeping.on_kept(Kept(goals=(Goal(name="tea", scene=GOAL, pddl=""), Goal(name="mess", scene=START, pddl=""))))
    assert episode.called(Restore(name="tea")) == [LookRequest(purpose="restore tea")]
    keeping.on_kept(Kept(goals=(Goal(name="mess", scene=START, pddl=""),)))
    (task,) = episode.seen(START)
    assert isinstance(task, Task) and task.goal is GOAL
    episode.called(Stop())
    episode.planned(STEP)
    with pytest.raises(Refused, match="name='tea': no such goal; valid: mess"):
        episode.called(Restore(name="tea"))
    assert episode.called(Restore(name="mess")) == [LookRequest(purpose="restore mess")]


# ------------------------------------------------------------------------------------------ somebody stands beside it

T_TURNED = np.diag([1.0, -1, -1, 1]) @ np.eye(4)
STANDS = Doubt(kind="stance", object="cup", stance="upside down", T_base_other=T_TURNED)
UNKNOWN = Doubt(kind="unknown", object="", choices=("leave", "again"))


def doubtful(graph: SceneGraph, *doubts: Doubt) -> SceneGraph:
    return msgspec.structs.replace(graph, doubts=doubts)


def test_a_plan_waits_for_go_where_somebody_wants_to_see_it() -> None:
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    episode.seen(GOAL)
    with pytest.raises(Refused, match="nothing waits for go"):
        episode.called(Go())
    episode.called(Restore(name="tea", ask=True))
    episode.seen(START)
    assert episode.planned(STEP) == []
    (request,) = episode.called(Go())
    assert isinstance(request, TransferRequest) and request.transfer == STEP
    episode.ended(1, STEP)
    episode.seen(START)
    (request,) = episode.planned(STEP)  # it was shown once
    assert isinstance(request, TransferRequest)


def test_after_a_pause_it_looks_before_it_goes_on() -> None:
    episode = Episode(scripted=False)
    with pytest.raises(Refused, match="nothing is under way"):
        episode.called(Pause())
    episode.called(Teach(name="tea"))
    episode.seen(GOAL)
    episode.called(Restore(name="tea"))
    episode.seen(START)
    episode.planned(STEP)
    episode.called(Pause())
    episode.ended(1, STEP)
    episode.seen(START)
    assert episode.planned(STEP) == []
    assert episode.called(Go()) == [LookRequest(purpose="after transfer 1")]
    episode.seen(START)
    assert isinstance(episode.planned(STEP)[0], TransferRequest)
    episode.called(Pause())
    assert episode.called(Go()) == []  # before it came to it


def test_what_waits_can_be_stopped_at_once() -> None:
    for graph in (doubtful(START, UNKNOWN), START):
        episode = Episode(scripted=False)
        episode.called(Teach(name="tea"))
        episode.seen(GOAL)
        episode.called(Restore(name="tea", ask=True))
        episode.seen(graph)
        if not graph.doubts:
            episode.planned(STEP)
        assert the_verdict(episode.called(Stop())).failed_stage == STOPPED
        assert episode.called(Look()) == [LookRequest(purpose="look")]


def test_a_doubt_is_asked_about_and_the_answer_is_used() -> None:
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea", ask=True))
    (question,) = episode.seen(doubtful(GOAL, STANDS, UNKNOWN))
    assert question == Question(number=1, doubt=STANDS)
    assert episode.ctx.lines[-1].endswith("runner call demonstrator answer question=1 choice=yes|no|again")
    for wrong, reason in (
        (Answer(question=2, choice="yes"), "question=2: 1 is asked now"),
        (Answer(question=1, choice="perhaps"), "choice='perhaps': valid: yes, no, again"),
    ):
        with pytest.raises(Refused, match=reason):
            episode.called(wrong)
    assert episode.called(Answer(question=1, choice="no")) == [Question(number=2, doubt=UNKNOWN)]
    (goal,) = episode.called(Answer(question=2, choice="leave"))
    assert isinstance(goal, Goal)
    cup = next(item for item in goal.scene.objects if item.name == "cup")
    assert cup.T_base_object is T_TURNED
    with pytest.raises(Refused, match="question=2: nothing is asked now"):
        episode.called(Answer(question=2, choice="leave"))
    episode.called(Teach(name="more", ask=True))
    assert episode.seen(doubtful(GOAL, STANDS)) == [Question(number=3, doubt=STANDS)]
    assert episode.called(Answer(question=3, choice="again")) == [LookRequest(purpose="goal more")]
    assert episode.seen(doubtful(GOAL, STANDS)) == [Question(number=4, doubt=STANDS)]
    (goal,) = episode.called(Answer(question=4, choice="yes"))
    assert isinstance(goal, Goal) and goal.scene.objects == GOAL.objects


def test_a_doubt_is_settled_for_the_whole_task_and_asked_about_only_where_somebody_is_there() -> None:
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    (goal,) = episode.seen(doubtful(GOAL, STANDS, UNKNOWN))
    assert isinstance(goal, Goal)
    episode.called(Restore(name="tea", ask=True))
    episode.seen(doubtful(START, UNKNOWN))
    (task,) = episode.called(Answer(question=1, choice="leave"))
    assert isinstance(task, Task)
    episode.planned(STEP)
    episode.called(Go())
    episode.ended(1, STEP)
    assert isinstance(episode.seen(doubtful(START, UNKNOWN))[0], Task)


CARTON_AND_CUP = Layout().put("milk_carton", 0.0, 0.0).put("cup", 0.1, 0.2).poses


def judged(graph: SceneGraph, probability: float) -> SceneGraph:
    objects = tuple(msgspec.structs.replace(one, probability=probability) for one in graph.objects)
    return msgspec.structs.replace(graph, objects=objects)


def test_a_goal_that_is_in_doubt_is_looked_at_again_before_it_is_remembered() -> None:
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    (again,) = episode.seen(judged(GOAL, 0.2))
    assert again == LookRequest(purpose="goal tea, look 2")
    names = ", ".join(one.name for one in GOAL.objects)
    assert any(f"in doubt: {names}; looking again" in line for line in episode.ctx.lines)
    (goal,) = episode.seen(judged(GOAL, 0.99))
    assert isinstance(goal, Goal)
    episode.called(Teach(name="tea"))
    episode.seen(judged(GOAL, 0.2))
    episode.seen(judged(GOAL, 0.2))
    assert not any("remembered all the same" in line for line in episode.ctx.lines)
    (goal,) = episode.seen(judged(GOAL, 0.2))
    assert isinstance(goal, Goal)  # with what there is, after as many looks as are taken
    said = ", ".join(f"{one.name} (20 %)" for one in GOAL.objects)
    assert f"still in doubt after 3 looks, remembered all the same: {said}" in episode.ctx.lines


def test_a_goal_with_something_unknown_is_looked_at_again_before_it_is_remembered() -> None:
    region = UnknownRegion(box=np.zeros(4), points=90, centre_table=np.zeros(3), extent_table=np.ones(3))
    open_goal = msgspec.structs.replace(GOAL, unknown=(region,))
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    assert episode.seen(open_goal) == [LookRequest(purpose="goal tea, look 2")]
    assert isinstance(episode.seen(GOAL)[0], Goal)
    episode.called(Teach(name="tea"))
    episode.seen(open_goal)
    episode.seen(open_goal)
    (goal,) = episode.seen(open_goal)
    assert isinstance(goal, Goal)
    assert any("remembered all the same: something is there that no object" in line for line in episode.ctx.lines)
    episode.called(Teach(name="tea", ask=True))
    assert isinstance(episode.seen(open_goal)[0], Goal)  # Somebody is there, and was asked about it if need be.


def test_a_goal_in_which_the_detector_sees_more_is_looked_at_again_before_it_is_remembered() -> None:
    contested = msgspec.structs.replace(GOAL, contested=("sponge",))
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    assert episode.seen(contested) == [LookRequest(purpose="goal tea, look 2")]
    assert "the detector also sees sponge; looking again" in episode.ctx.lines
    assert isinstance(episode.seen(GOAL)[0], Goal)
    episode.called(Teach(name="tea"))
    assert isinstance([episode.seen(contested) for _ in range(3)][-1][0], Goal)
    assert any("remembered all the same: the detector also sees sponge" in line for line in episode.ctx.lines)


@pytest.mark.parametrize("probability", [0.6, 0.95])
def test_no_success_is_claimed_where_a_place_turns_with_what_was_in_doubt(probability: float) -> None:
    """Beside the tray stands a can; which way the tray lies was in doubt, look after look."""
    episode, taught = Episode(repeats=0), judged(GOAL, probability)
    episode.until_start(taught)
    verdict = the_verdict(episode.seen(judged(GOAL, 0.99)))
    assert verdict.success == (probability > 0.9) and not verdict.violated
    assert ("tray was in doubt when the goal was taught" in verdict.reason) == (not verdict.success)


def test_no_success_is_claimed_where_an_object_is_less_likely_there_than_not() -> None:
    episode = Episode(repeats=1)
    episode.until_start(GOAL)
    assert episode.seen(judged(GOAL, 0.3)) == [LookRequest(purpose="start, look 2")]
    verdict = the_verdict(episode.seen(judged(GOAL, 0.3)))
    names = ", ".join(one.name for one in GOAL.objects)
    assert verdict.failed_stage == "perception" and not verdict.violated
    assert verdict.reason.startswith(f"in doubt: {names} (2 looks at scene 'start')")
    episode = Episode(repeats=1)
    episode.until_start(GOAL)
    episode.seen(judged(GOAL, 0.3))
    assert the_verdict(episode.seen(judged(GOAL, 0.6))).success


def test_what_is_in_doubt_is_looked_at_a_second_time_before_it_is_moved() -> None:
    episode = Episode()
    episode.until_task(start=judged(START, 0.3))
    (again,) = episode.planned(STEP)
    assert again == LookRequest(purpose="start, look 2")
    (task,) = episode.seen(judged(START, 0.3))
    assert isinstance(task, Task)
    (request,) = episode.planned(STEP)
    assert isinstance(request, TransferRequest) and request.number == 1


def with_a_second_cup(*names: str) -> SceneGraph:
    """Of a carton and a cup those with these ``names``, and another cup."""
    poses = {name: CARTON_AND_CUP[name] for name in names}
    graph = Layout({**poses, "cup_2": upright("cup", -0.1, -0.2, 0.0)}).graph()
    labelled = (msgspec.structs.replace(one, label="cup") if one.name == "cup_2" else one for one in graph.objects)
    return msgspec.structs.replace(graph, objects=tuple(labelled))


def test_where_an_equal_object_is_left_the_goal_lacks_nothing() -> None:
    """The cup that was called so was a mistake, and is not seen again."""
    episode, goal = Episode(), Layout().put("milk_carton", 0.0, 0.0).put("cup", 0.0, 0.0, on="milk_carton").graph()
    task = episode.until_task(goal, with_a_second_cup("milk_carton", "cup"))
    assert [one.name for one in task.current.objects] == ["milk_carton", "cup", "cup_2"]
    episode.planned(STEP)
    episode.ended(1, STEP)
    (task,) = episode.seen(with_a_second_cup("milk_carton"))
    assert isinstance(task, Task) and [one.name for one in task.current.objects] == ["milk_carton", "cup"]


def test_of_two_cups_the_person_says_which_is_meant() -> None:
    graph = with_a_second_cup("milk_carton", "cup")
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    episode.seen(Layout(CARTON_AND_CUP).graph())
    episode.called(Restore(name="tea", ask=True))
    (question,) = episode.seen(graph)
    assert isinstance(question, Question)
    assert (question.doubt.key, question.doubt.choices) == ("which cup", ("cup", "cup_2", "again"))
    (task,) = episode.called(Answer(question=1, choice="cup_2"))
    assert isinstance(task, (Task, Verdict))
    scene = task.current if isinstance(task, Task) else episode.stage._state.scene  # pyright: ignore[reportPrivateUsage]
    assert scene is not None
    places = {item.name: item.T_base_object for item in scene.objects}
    seen = {item.name: item.T_base_object for item in graph.objects}
    assert places["cup"] is seen["cup_2"] and places["cup_2"] is seen["cup"]


def test_commands_at_the_wrong_time_are_refused() -> None:
    episode = Episode(scripted=False)
    with pytest.raises(Refused, match=r"name='tea': no such goal; valid: none, teach one first"):
        episode.called(Restore(name="tea"))
    with pytest.raises(Refused, match=r"name='../tea': must consist of letters"):
        episode.called(Teach(name="../tea"))
    episode.called(Teach(name="tea"))
    with pytest.raises(Refused, match="busy: waits for a scene graph"):
        episode.called(Teach(name="tea"))
    with pytest.raises(Refused, match="busy: waits for the person's arrangement"):
        Episode().called(Teach(name="tea"))


@pytest.mark.parametrize(
    ("before", "after", "change"),
    [("ab", "ab", "kept"), ("ab", "b", "repaired"), ("ab", "cab", "repaired"), ("ab", "ba", "replaced")],
)
def test_says_how_a_plan_changed(before: str, after: str, change: str) -> None:
    def steps(names: str) -> list[Transfer]:
        return [transfer(name, "table", "tray") for name in names]

    assert change_of_plan(steps(before), steps(after)) == change


@pytest.mark.parametrize("bad", [{"tries": 0}, {"max_transfers": 0}, {"goal_name": "../x"}, {"repeats": -1}])
def test_refuses_bad_settings(bad: dict[str, object]) -> None:
    with pytest.raises(Refused, match=rf"demonstrator\.{next(iter(bad))}="):
        Demonstrator.Config(catalogue=CATALOGUE, **bad)  # type: ignore[arg-type]


def test_after_the_arm_was_stopped_it_comes_home_before_the_next_look() -> None:
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    episode.seen(GOAL)
    episode.called(Restore(name="tea"))
    episode.seen(START)
    episode.planned(STEP)
    verdict = the_verdict(episode.ended(1, STEP, failed_stage=STOPPED, reason="stopped, as asked; in the hand: cup"))
    assert (verdict.success, verdict.failed_stage) == (False, STOPPED)
    assert verdict.reason == "stopped, as asked; in the hand: cup"
    assert episode.called(Restore(name="tea")) == [Recover()]
    assert episode.ended(0, STEP) == [LookRequest(purpose="restore tea")]
    episode.seen(GOAL)
    assert episode.called(Look()) == [LookRequest(purpose="look")]


def test_what_the_hand_did_not_feel_the_look_decides() -> None:
    episode = Episode()
    episode.until_task()
    episode.planned(STEP)
    episode.ended(1, STEP, failed_stage="unknown", reason="nothing was felt below cup where it was let go of")
    assert the_verdict(episode.seen(GOAL)).success


def test_what_may_hide_a_missing_object_is_put_aside_before_it_is_given_up() -> None:
    goal, start = with_shaker(OPEN), Layout(dict(CARTON.poses))
    episode = Episode()
    episode.until_start(goal.graph())
    seen = msgspec.structs.replace(start.graph(), support=regions.rectangle([-0.3, -0.4], [0.3, 0.4]))
    assert episode.seen(seen, view(start)) == [LookRequest(purpose="start, look 2")]
    (task,) = episode.seen(seen, view(start))
    assert isinstance(task, Task) and task.aside == "milk_carton"
    aside = transfer("milk_carton", "table", "table")
    (request,) = episode.planned(aside)
    assert isinstance(request, TransferRequest) and request.transfer == aside
    assert episode.ended(1, aside) == [LookRequest(purpose="after transfer 1")]
    assert episode.seen(seen, view(start)) == [LookRequest(purpose="after transfer 1, look 2")]
    assert episode.seen(seen, view(start)) == [LookRequest(purpose="after transfer 1, look 3")]
    verdict = the_verdict(episode.seen(seen, view(start)))
    assert verdict.failed_stage == "perception" and "not seen: salt_shaker" in verdict.reason


def test_what_the_hand_failed_to_put_aside_is_tried_once_more_after_all_else() -> None:
    start = Layout(dict(CARTON.poses)).put("tea_box", 0.2, -0.3)
    goal = Layout(dict(start.poses) | {"salt_shaker": OPEN})
    seen = msgspec.structs.replace(start.graph(), support=regions.rectangle([-0.3, -0.4], [0.3, 0.4]))
    episode, asked = Episode(), list[str]()
    episode.until_start(goal.graph())
    for number in (1, 2, 3):
        episode.seen(seen, view(start))
        (task,) = episode.seen(seen, view(start))
        assert isinstance(task, Task)
        asked.append(task.aside)
        aside = transfer(task.aside, "table", "table")
        episode.planned(aside)
        episode.ended(number, aside, failed_stage="touch" if task.aside == "milk_carton" else "")
    assert asked == ["milk_carton", "tea_box", "milk_carton"]
    episode.seen(seen, view(start))
    assert episode.seen(seen, view(start)) == [LookRequest(purpose="after transfer 3, look 3")]


def test_what_is_in_the_way_of_that_is_put_aside_once() -> None:
    start = Layout(dict(CARTON.poses)).put("tea_box", 0.2, -0.3)
    goal = Layout(dict(start.poses) | {"salt_shaker": OPEN})
    seen = msgspec.structs.replace(start.graph(), support=regions.rectangle([-0.3, -0.4], [0.3, 0.4]))
    episode = Episode()
    episode.until_start(goal.graph())
    blocker = transfer("tea_box", "table", "table")
    for number in (1, 2):
        episode.seen(seen, view(start))
        (task,) = episode.seen(seen, view(start))
        assert isinstance(task, Task) and task.aside == "milk_carton"
        answer = episode.planned(blocker)
        if number == 1:
            assert isinstance(answer[0], TransferRequest) and answer[0].transfer == blocker
            episode.ended(1, blocker)
    assert answer == [LookRequest(purpose="after transfer 1, look 3")]


def test_what_slipped_is_tried_again_as_it_was() -> None:
    episode = Episode()
    task = episode.until_task()
    for number in (1, 2, 3):
        episode.planned(STEP)
        episode.ended(number, STEP, failed_stage="slip", reason="the fingers are 2 mm apart on the way to lift cup")
        (task,) = episode.seen(START)
        assert isinstance(task, Task) and task.avoid == ()


def test_whoever_stops_the_arm_while_it_shows_itself_wants_no_look() -> None:
    episode = Episode(scripted=False)
    episode.called(Look())
    on_its_way = Arrived(success=False, reason="", joint_names=(), positions=np.zeros(0), robot_seconds=1.0)
    assert episode.stage.on_arrived(on_its_way, episode.ctx) is None
    stopped = msgspec.structs.replace(on_its_way, stopped="stop", reason="as asked on the way to show the arm")
    verdict = episode.stage.on_arrived(stopped, episode.ctx)
    assert verdict is not None and (verdict.failed_stage, verdict.reason) == (STOPPED, stopped.reason)
    assert episode.called(Look()) == [Recover()]


def test_a_goal_is_taught_only_from_where_the_camera_looks_from() -> None:
    episode = Episode(scripted=False)
    episode.called(Teach(name="tea"))
    touched = Arrived(success=False, reason="touched", joint_names=(), positions=np.zeros(0), robot_seconds=1.0)
    episode.stage.on_arrived(touched, episode.ctx)
    (again,) = episode.seen(GOAL)
    assert isinstance(again, LookRequest)
    assert any("not where it looks from: touched; looking again" in line for line in episode.ctx.lines)
    episode.seen(GOAL)
    verdict = the_verdict(episode.seen(GOAL))
    assert "not where it looks from: touched" in verdict.reason
    episode.called(Teach(name="tea"))
    assert isinstance(episode.seen(GOAL)[0], LookRequest)
    episode.stage.on_arrived(msgspec.structs.replace(touched, success=True, reason=""), episode.ctx)
    assert isinstance(episode.seen(GOAL)[0], Goal)
