"""What people are told of an episode, message by message, without a page."""

from __future__ import annotations

import re
import string
from pathlib import Path
from typing import Any, get_args

import cv2
import msgspec
import numpy as np
import pytest
import yaml

from runner.contract import Message, Refused
from runner.message.codec import encode
from runner.page.story import Heard, Language, Notice, Told
from stages.messages import (
    Answer,
    Arrange,
    Assertion,
    Frame,
    Go,
    Goal,
    Kept,
    Look,
    LookRequest,
    Move,
    ObjectPose,
    Pause,
    Question,
    Recover,
    Restore,
    SceneEstimate,
    SceneGraph,
    Stop,
    Task,
    Teach,
    TransferRequest,
    Verdict,
)
from stages.messages.correction import CAMERAS_WAY, OWN_ARM
from stages.messages.scene import Doubt, SceneObject, Stance, UnknownRegion
from stages.messages.task import STOPPED
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.goals import GoalFolder, unpacked, without
from stages.story import Story, words
from stages.story.story import STEP_SECONDS
from stages.story.words import words_of
from tests.stages.episodes import K, outcome, plan, scene, transfer, translation

CONFIGS: dict[str, dict[str, Any]] = {"demonstrator": {"catalogue": BUILT_IN, "scripted": False}, "world": {}}
GOAL = scene({"tray": "table", "cup": "tray", "tea_box": "table"}, beside={"tea_box": "tray"})
START = scene({"tray": "table", "cup": "table", "tea_box": "table"})
NOTHING = msgspec.structs.replace(GOAL, objects=(), virtual_objects=(), assertions=())
STEP = transfer("cup", "table", "tray")
T_CAMERA_CUP = np.array([[1.0, 0, 0, 0], [0, -0.6, -0.8, 0], [0, 0.8, -0.6, 0.8], [0, 0, 0, 1]])
LANGUAGES: tuple[Language, ...] = get_args(Language)


class Listener:
    """A story that is told messages with ids of their own."""

    def __init__(self, **configs: dict[str, Any]) -> None:
        self.story = Story({**CONFIGS, **configs})
        self._heard = 0

    def hear(self, *messages: Message, causes: tuple[str, ...] = ()) -> str:
        """Tells it messages; returns the id of the last."""
        for message in messages:
            self._heard += 1
            id = f"stage.port#{self._heard}"
            self.story.hear(Heard(message, id, causes, 1_000_000_000 * self._heard))
        return f"stage.port#{self._heard}"

    def idle(self, seconds: int) -> None:
        """Nothing is heard meanwhile."""
        self._heard += seconds

    @property
    def now(self) -> int:
        """Seconds, at which something was heard last."""
        return self._heard

    def called(self, command: Teach | Restore | Look) -> None:
        """A command, and the look that follows it."""
        self.hear(LookRequest(purpose="look"), causes=(self.hear(command),))

    def seen(self, graph: SceneGraph, **fields: object) -> None:
        self.hear(frame(), estimate(**fields), graph)

    def taught(self) -> None:
        self.called(Teach(name="tea"))
        self.seen(GOAL)
        self.hear(Goal(name="tea", scene=GOAL, pddl=""))

    def told(self, language: Language = "en") -> Told:
        return self.story.tell(language)

    @property
    def doing(self) -> str:
        return self.told().doing.text

    @property
    def notice(self) -> Notice:
        notice = self.told().notice
        assert notice is not None
        return notice

    def offered(self) -> dict[str, bool]:
        return {action.command: action.now for action in self.told().actions}


def frame() -> Frame:
    rgb, depth = np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32)
    return Frame(rgb=rgb, depth=depth, K=K, T_base_camera=None, robot_mask=None, name="", index=0, total=0)


def estimate(probability: float | None = 0.97, *, contradicted: bool = False, unknown: int = 0) -> SceneEstimate:
    cup = ObjectPose(
        name="cup",
        label="cup",
        T_camera_object=T_CAMERA_CUP,
        confidence=0.9,
        cost=1.5,
        box=np.array([300.0, 200, 360, 280]),
        probability=probability,
        contradicted=contradicted,
    )
    region = UnknownRegion(
        box=np.array([10.0, 20, 60, 80]), points=90, centre_table=np.zeros(3), extent_table=np.array([0.07, 0.05, 0.09])
    )
    return SceneEstimate(
        objects=(cup,),
        winner=0,
        log_weights=np.zeros(1),
        left_out=0,
        T_camera_table=np.eye(4),
        T_base_camera=None,
        K=K,
        unknown=(region,) * unknown,
    )


def verdict(failed_stage: str = "", reason: str = "", violated: tuple[Assertion, ...] = ()) -> Verdict:
    return Verdict(
        goal_name="tea",
        success=not failed_stage,
        failed_stage=failed_stage,
        reason=reason,
        satisfied=(),
        violated=violated,
    )


# ------------------------------------------------------------------------------------------ what is there


def test_before_the_first_look_there_is_nothing_to_see_and_something_to_do() -> None:
    told = Listener().told()
    assert (told.doing.text, told.doing.busy, told.view, told.statements) == (
        "The robot waits for you",
        False,
        None,
        (),
    )
    assert Listener().offered() == {"teach": True, "look": True, "arrange": True, "stop": True}


def test_a_scene_is_sentences_and_outlines() -> None:
    listener = Listener()
    listener.called(Look())
    listener.seen(GOAL, unknown=1)
    told = listener.told()
    assert [one.text for one in told.statements] == [
        "The tray is on the table.",
        "The cup is in the tray.",
        "The tea box is on the table, next to the tray.",
        "There is something that I do not know, about 7 x 5 x 9 cm large.",
    ]
    assert [one.how_sure for one in told.statements] == ["", "Sure", "", "Unknown"]
    assert told.view is not None
    cup, unknown = told.view.outlines
    assert (cup.name, cup.label, unknown.label, unknown.surety) == ("cup", "cup", "Unknown", "unknown")
    assert {one.name for one in told.view.outlines} <= {one.about for one in told.statements}


def test_an_outline_encloses_what_the_object_covers() -> None:
    listener = Listener()
    listener.seen(GOAL)
    view = listener.told().view
    assert view is not None
    corners = np.array(view.outlines[0].points)
    mesh = Catalogue.load(BUILT_IN)["cup"].mesh
    points = mesh.vertices @ T_CAMERA_CUP[:3, :3].T + T_CAMERA_CUP[:3, 3]
    pixels = (points @ K.T)[:, :2] / points[:, 2:]
    assert np.abs(corners.min(0) - pixels.min(0)).max() < 3 and np.abs(corners.max(0) - pixels.max(0)).max() < 3


def test_what_is_behind_the_camera_or_beside_the_image_has_no_outline() -> None:
    for shift in ([0, 0, -2.0], [9.0, 0, 0]):
        listener, elsewhere = Listener(), estimate()
        elsewhere.objects[0].T_camera_object[:3, 3] += shift
        try:
            listener.hear(frame(), elsewhere, GOAL)
            view = listener.told().view
            assert view is not None and view.outlines == ()
        finally:
            elsewhere.objects[0].T_camera_object[:3, 3] -= shift


@pytest.mark.parametrize(
    ("probability", "contradicted", "surety", "words"),
    [
        (0.97, False, "sure", "Sure"),
        (None, False, "unsure", "Not judged yet"),
        (0.72, False, "unsure", "Not quite sure (72 %)"),
        (0.2, False, "doubtful", "Probably wrong"),
        (0.97, True, "doubtful", "Probably wrong"),
    ],
)
def test_how_sure_it_is_is_said(probability: float | None, contradicted: bool, surety: str, words: str) -> None:
    listener = Listener()
    listener.seen(GOAL, probability=probability, contradicted=contradicted)
    cup = next(one for one in listener.told().statements if one.about == "cup")
    assert (cup.surety, cup.how_sure) == (surety, words)


def test_a_picture_says_when_it_is_outdated() -> None:
    listener = Listener()
    listener.seen(GOAL)
    captions: list[str] = []
    for message in (Look(), Arrange(kind="start"), frame()):
        listener.hear(message)
        view = listener.told().view
        assert view is not None
        captions.append(view.caption)
    assert [one.text for one in listener.told().statements] == []
    seen, moved = "What the robot saw last", "What the robot saw before something was moved"
    assert captions == [seen, moved, seen]


def test_what_was_moved_is_not_claimed_to_be_where_it_was() -> None:
    listener = Listener()
    listener.called(Look())
    listener.seen(START)
    for message in (Move(name="cup", x=0.6, y=0.1), Arrange(kind="goal")):
        listener.hear(message)
        (only,) = listener.told().statements
        assert only.text == "Something was moved since. Let the robot look again."


def test_the_map_shows_what_can_be_moved_and_where_it_was_put() -> None:
    listener = Listener()
    listener.called(Look())
    assert listener.told().map is None
    listener.seen(GOAL)
    found = listener.told("de").map
    assert found is not None
    assert [(one.label, one.movable) for one in found.places] == [
        *(("Tablett", False), ("Teeschachtel", True), ("Tasse", True))
    ]
    cup = Catalogue.load(BUILT_IN)["cup"]
    edge = np.array(found.places[2].points) - [found.places[2].x, found.places[2].y]
    assert np.allclose(edge.min(0), cup.bounds[0, :2], atol=0.002) and np.allclose(
        edge.max(0), cup.bounds[1, :2], atol=0.002
    )
    assert np.array(found.ground).min() < min(one.y for one in found.places)
    listener.hear(Move(name="cup", x=0.61, y=0.15))
    moved = listener.told().map
    assert moved is not None and (moved.places[2].x, moved.places[2].y) == (0.61, 0.15)
    listener.hear(Arrange(kind="start"))
    assert listener.told().map is None


def test_where_nothing_is_seen_there_is_no_map_and_all_else_is_told() -> None:
    listener = Listener()
    listener.called(Look())
    listener.seen(msgspec.structs.replace(NOTHING, support=None))
    assert (listener.told().map, listener.offered()["teach"]) == (None, True)


def test_every_disturbance_is_another() -> None:
    listener = Listener()
    listener.hear(Arrange(kind="start"), Arrange(kind="goal"), Arrange(kind="start"))
    disturb = next(one for one in listener.told().actions if one.arguments.get("kind") == "start")
    assert disturb.arguments == {"kind": "start", "draw": "2"}


def test_a_goal_that_cannot_be_shown_says_so_and_takes_nothing_else_away(tmp_path: Path) -> None:
    listener = Listener(goals={"folder": tmp_path})
    listener.hear(
        Kept(goals=tuple(Goal(name=name, scene=one, pddl="") for name, one in (("nil", NOTHING), ("tea", GOAL))))
    )
    broken, whole = listener.told().cards
    assert broken.text.startswith("This scene cannot be shown: ")
    assert ([one.command for one in broken.more], broken.actions) == (["rename", "forget"], ())
    assert whole.actions and listener.offered()["stop"]


# ------------------------------------------------------------------------------------------ what goes on


def test_a_goal_is_taught_and_becomes_a_card() -> None:
    listener = Listener()
    listener.called(Teach(name="tea"))
    assert listener.doing == "Looks at the scene to remember it as “tea”"
    assert listener.offered() == {"teach": False, "look": False, "arrange": False, "stop": True}
    listener.seen(GOAL)
    assert listener.doing == "Recognises what is there"
    listener.hear(Goal(name="tea", scene=GOAL, pddl=""))
    assert (listener.doing, listener.notice.text) == (
        "The robot waits for you",
        "“tea” is remembered: the tray, the cup and the tea box.",
    )
    (card,) = listener.told().cards
    assert (card.title, card.text) == ("tea", "3 objects: the tray, the cup and the tea box")
    assert card.photo is not None and card.photo in listener.told().photos
    assert [(one.command, one.arguments, one.now) for one in card.actions] == [
        ("restore", {"name": "tea", "ask": "true"}, True)
    ]
    assert card.more == card.lines == listener.told().cards_actions == ()


def test_a_goal_that_is_kept_can_be_edited_and_carried_away(tmp_path: Path) -> None:
    listener = Listener(goals={"folder": tmp_path})
    picture = cv2.imencode(".jpg", np.full((480, 640, 3), 90, np.uint8))[1].tobytes()
    goal = Goal(name="tea", scene=GOAL, pddl="", picture=picture)
    listener.hear(Kept(goals=(goal,)))
    (card,) = listener.told().cards
    assert card.photo is not None and card.photo.rgb.shape == (480, 640, 3) and abs(card.photo.rgb - 90.0).max() < 3
    assert [(one.command, one.arguments, one.confirm) for one in card.more] == [
        ("rename", {"name": "tea"}, ""),
        ("forget", {"name": "tea"}, "Delete “tea” for good?"),
    ]
    assert card.file is not None and card.file.name == "tea.zip"
    assert encode(unpacked(card.file.data.tobytes(), Catalogue.shared(BUILT_IN))) == encode(goal)
    assert [(line.text, *(one.arguments.get("what") or one.label for one in line.actions)) for line in card.lines] == [
        ("The tray is on the table.", "on(tray, table)", "tray"),
        ("The cup is in the tray.", "in(cup, tray)", "cup"),
        ("The tea box is on the table.", "on(tea_box, table)", "tea_box"),
        (
            "The tea box is next to the tray, within 3 cm of where it was shown.",
            *("Allow 7 cm", "in(tea_box_near_tray, tea_box)"),
        ),
    ]
    loose = msgspec.structs.replace(goal, scene=without(GOAL, "in(cup, tray)"))
    listener.hear(Kept(goals=(loose,)))
    line = listener.told("de").cards[0].lines[1]
    assert (line.text, [one.label for one in line.actions]) == ("Die Tasse darf überall sein.", ["Die Tasse weglassen"])
    listener.hear(Kept(goals=()))
    assert listener.told().cards == ()


def test_a_goal_may_be_recorded_after_it_was_kept(tmp_path: Path) -> None:
    listener = Listener(goals={"folder": tmp_path})
    goal = Goal(name="tea", scene=GOAL, pddl="")
    listener.hear(Kept(goals=(goal,)), goal)
    (card,) = listener.told().cards
    assert card.file is not None and card.lines


def test_what_is_on_disk_is_told_without_a_run(tmp_path: Path) -> None:
    GoalFolder(tmp_path, Catalogue.shared(BUILT_IN)).write(Goal(name="tea", scene=GOAL, pddl=""))
    listener = Listener(goals={"folder": tmp_path})
    assert listener.told().cards == ()
    listener.story.recall()
    assert [card.title for card in listener.told("de").cards] == ["tea"]


def test_what_is_no_goal_is_told_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "mess").mkdir()
    (tmp_path / "mess" / "goal.pddl").write_text("(define (problem mess)")
    listener = Listener(goals={"folder": tmp_path})
    listener.story.recall()
    (card,) = listener.told().cards
    assert card.title == "mess" and card.text.startswith("goal.pddl: line 1: ") and card.actions == ()
    listener.hear(Kept(goals=()))
    assert listener.told().cards == ()


@pytest.mark.parametrize("command_first", [True, False])
def test_a_command_may_be_recorded_before_or_after_what_it_causes(command_first: bool) -> None:
    listener = Listener()
    heard = [
        Heard(Restore(name="tea"), "supervisor.demonstrator_restore#0", (), 5),
        Heard(LookRequest(purpose="x"), "demonstrator.look_request#0", ("supervisor.demonstrator_restore#0",), 6),
    ]
    for one in heard if command_first else reversed(heard):
        listener.story.hear(one)
    assert listener.doing == "Looks at what there is to do for “tea”"


@pytest.mark.parametrize(
    ("shown", "doing"),
    [
        (f"{OWN_ARM}, posture 1 of 4", "Shows its arm to the camera"),
        (CAMERAS_WAY, "Takes its camera elsewhere"),
    ],
)
def test_what_the_arm_moves_for_before_a_look_is_said(shown: str, doing: str) -> None:
    listener = Listener()
    listener.called(Look())
    look = LookRequest(purpose="look")
    listener.hear(LookRequest(purpose=shown), msgspec.structs.replace(frame(), name=shown))
    assert listener.doing == doing
    listener.story.hear(Heard(look, "corrector.look_request#1", ("demonstrator.look_request#0",), 6))
    listener.hear(frame())
    assert listener.doing == "Recognises what is there"


def test_a_command_that_was_refused_changes_nothing() -> None:
    listener = Listener()
    listener.hear(Restore(name="lunch"), Stop())
    assert (listener.doing, listener.told().notice) == ("The robot waits for you", None)


def test_who_is_refused_meanwhile_ends_no_job_and_never_the_stop() -> None:
    listener = Listener()
    refused = verdict("demonstrator", "busy: waits for the outcome of a transfer; ask again after the verdict")
    listener.called(Restore(name="tea"))
    listener.hear(plan(STEP), TransferRequest(transfer=STEP, scene=START, number=1), refused)
    assert (listener.doing, listener.told().notice) == ("Puts the cup on the tray", None)
    listener.hear(verdict("executor", "no"), refused)
    assert listener.offered()["stop"] and not listener.notice.good


def test_a_restore_is_told_step_by_step() -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea"))
    assert listener.told().notice is None
    listener.seen(START)
    listener.hear(Task(goal_name="tea", goal=GOAL, current=START))
    assert listener.doing == "Thinks about what to move first"
    other = transfer("tea_box", "table", "table")
    listener.hear(plan(STEP, other), TransferRequest(transfer=STEP, scene=START, number=1))
    doing = listener.told().doing
    assert (doing.text, doing.step, doing.busy) == ("Puts the cup into the tray", 1, True)
    assert doing.steps == ("Puts the cup into the tray", "Puts the tea box on the table")
    listener.hear(outcome(1, STEP), LookRequest(purpose="after transfer 1"))
    assert (listener.doing, listener.told().doing.step) == ("Looks whether it is where it belongs", 2)
    listener.seen(START)
    listener.hear(plan(other), TransferRequest(transfer=other, scene=START, number=2))
    assert listener.doing == "Puts the tea box on the table"
    assert listener.told("de").doing.text == "Stellt die Teeschachtel auf den Tisch"
    listener.hear(verdict())
    assert (listener.notice.good, listener.notice.text) == (True, "“tea” is restored: everything is where it belongs.")


def test_a_success_says_what_is_hidden_lies_or_is_gone_all_the_same() -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea"))
    ending = "remembered, not seen: cup; knocked over: mug; not seen any more: milk_carton"
    listener.hear(verdict(reason=f"every relation of the goal holds; {ending}"))
    notes = ("Hidden from here: the cup; fallen over: the mug; not there any more: the milk carton.",)
    assert (listener.notice.good, listener.notice.help) == (True, notes)


def test_a_stop_is_told_until_it_has_come() -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea"))
    listener.hear(Stop())
    assert (listener.doing, listener.offered()["stop"]) == ("Finishes this, then stops", True)
    listener.hear(verdict(STOPPED, "stopped, as asked"))
    assert (listener.notice.text, listener.notice.good) == ("Stopped, as you asked.", True)


def test_a_plan_is_shown_before_go_and_a_pause_holds_the_next() -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea", ask=True))
    listener.seen(START)
    listener.hear(Task(goal_name="tea", goal=GOAL, current=START))
    target = msgspec.structs.replace(STEP, T_base_targets=translation(0.8, 0.3, 0.7)[None])
    listener.hear(plan(target, transfer("tea_box", "table", "table")))
    assert listener.doing == "Waits for your go; left to move: 2, about 1 min"
    view = listener.told().view
    assert view is not None and view.arrows[0].label == "Puts the cup into the tray"
    assert view.arrows[0].start != view.arrows[0].end
    assert listener.offered()["go"] and "pause" not in listener.offered()
    listener.hear(Go(), TransferRequest(transfer=STEP, scene=START, number=1))
    assert "go" not in listener.offered() and listener.offered()["pause"]
    assert 39 < listener.told().doing.expected_s < 60
    listener.hear(Pause())
    assert listener.doing == "Puts the cup into the tray; then waits for you" and "pause" not in listener.offered()
    listener.hear(outcome(1, STEP), LookRequest(purpose="after transfer 1"))
    listener.seen(START)
    listener.hear(plan(transfer("tea_box", "table", "table")))
    assert listener.doing == "Waits for your go; left to move: 1, about 1 min" and listener.offered()["go"]


@pytest.mark.parametrize("command", [Restore(name="tea", ask=True), Teach(name="lunch", ask=True)])
def test_after_a_stop_the_next_job_is_told_from_the_way_home_on(command: Restore | Teach) -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea"))
    listener.hear(Stop(now=True), verdict(STOPPED, "stopped, as asked"))
    listener.hear(Recover(), causes=(listener.hear(command),))
    assert (listener.told().notice, listener.offered()["teach"]) == (None, False)
    home = listener.hear(outcome(0, STEP))
    listener.hear(LookRequest(purpose="look"), causes=(home,))
    listener.seen(START)
    listener.hear(Question(number=1, doubt=Doubt(kind="stance", object="cup")))
    assert listener.told().question is not None
    if isinstance(command, Restore):
        listener.hear(Answer(question=1, choice="yes"), Task(goal_name="tea", goal=GOAL, current=START), plan(STEP))
        assert listener.doing.startswith("Waits for your go") and listener.offered()["go"]
        listener.hear(Go(), TransferRequest(transfer=STEP, scene=START, number=1))
        assert listener.doing == "Puts the cup into the tray"


def test_an_arm_that_does_not_come_home_is_no_transfer_that_failed() -> None:
    listener = Listener()
    listener.hear(Recover(), causes=(listener.hear(Restore(name="tea")),))
    listener.hear(outcome(0, STEP, failed_stage="place", reason="no free way back"), verdict("executor", "no"))
    assert (listener.notice.good, listener.notice.tried) == (False, ())


def test_what_a_person_takes_is_not_expected_of_the_robot() -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea", ask=True))
    listener.hear(plan(STEP, STEP, STEP), Go(), TransferRequest(transfer=STEP, scene=START, number=1))
    listener.hear(Pause(), outcome(1, STEP), LookRequest(purpose="after transfer 1"), plan(STEP, STEP))
    listener.idle(600)
    listener.hear(Go(), TransferRequest(transfer=STEP, scene=START, number=2))
    doing = listener.told().doing
    assert doing.since_ns * 1e-9 + doing.expected_s - listener.now == 2 * STEP_SECONDS


def test_what_is_hidden_and_still_to_be_moved_has_no_arrow() -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea"))
    listener.seen(START)
    listener.hear(
        plan(STEP, transfer("tea_box", "table", "tray")), TransferRequest(transfer=STEP, scene=START, number=1)
    )
    listener.hear(outcome(1, STEP), LookRequest(purpose="after transfer 1"))
    listener.seen(scene({"tray": "table", "cup": "tray"}))
    view = listener.told().view
    assert view is not None and view.arrows == () and listener.offered()["stop"]


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_doubt_is_a_question_until_it_is_answered(language: Language) -> None:
    doubts = [
        *(Doubt(kind="stance", object="cup", stance=stance) for stance in get_args(Stance)),
        Doubt(kind="unknown", object="", choices=("leave", "again")),
        Doubt(kind="which", object="cup", choices=("cup", "tea_box", "again")),
    ]
    listener, texts = Listener(), set[str]()
    listener.called(Restore(name="tea", ask=True))
    listener.seen(GOAL)
    for number, doubt in enumerate(doubts, 1):
        listener.hear(Question(number=number, doubt=doubt))
        asked = listener.told(language).question
        assert asked is not None and asked.about == {"unknown": "unknown_1", "which": ""}.get(doubt.kind, doubt.object)
        texts.add(asked.text)
        assert [one.arguments for one in asked.answers] == [
            {"question": str(number), "choice": choice} for choice in doubt.choices
        ]
        assert len({one.label for one in asked.answers}) == len(doubt.choices)
        listener.hear(Answer(question=number, choice="perhaps"), Answer(question=number - 1, choice="again"))
        assert listener.told().question is not None
        listener.hear(Answer(question=number, choice="again"))
        assert listener.told().question is None
    assert len(texts) == len(doubts)


def test_who_is_meant_has_the_name_in_the_picture_of_the_plan() -> None:
    left, right = (T_CAMERA_CUP + translation(x, 0, 0) - np.eye(4) for x in (-0.2, 0.2))
    (item,) = estimate().objects
    cups = tuple(
        msgspec.structs.replace(item, name=name, T_camera_object=T) for name, T in (("cup", left), ("cup_2", right))
    )
    named = tuple(SceneObject(name=name, label="cup", T_base_object=T) for name, T in (("cup", right), ("cup_2", left)))
    listener = Listener()
    listener.called(Restore(name="tea", ask=True))
    listener.hear(frame(), msgspec.structs.replace(estimate(), objects=cups, T_base_camera=np.eye(4)), START)
    doubt = Doubt(kind="which", object="cup", choices=("cup", "cup_2", "again"))
    listener.hear(Question(number=1, doubt=doubt), Answer(question=1, choice="cup_2"))
    current = msgspec.structs.replace(START, objects=named, T_base_camera=np.eye(4))
    listener.hear(Task(goal_name="tea", goal=GOAL, current=current))
    listener.hear(plan(msgspec.structs.replace(STEP, T_base_targets=left[None])))
    view = listener.told().view
    assert view is not None
    assert {one.name: one.points[0][0] > 320 for one in view.outlines} == {"cup": True, "cup_2": False}
    assert view.arrows[0].start[0] > 320


def test_a_stop_is_at_once_and_what_is_in_the_hand_is_told() -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea"))
    listener.hear(plan(STEP), TransferRequest(transfer=STEP, scene=START, number=1))
    (stop,) = (action for action in listener.told().actions if action.kind == "stop")
    assert (stop.stage, stop.command, stop.arguments) == ("demonstrator", "stop", {"now": "true"})
    listener.hear(verdict(STOPPED, "stopped, as asked; in the hand: cup"))
    assert listener.notice.text == "Stopped, as you asked; in the hand is still the cup."


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("stage", ["perception", "planner", "executor"])
def test_a_failure_says_what_is_wrong_and_what_helps(stage: str, language: Language) -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea"))
    violated = (
        Assertion(predicate="in", arguments=("cup", "tray")),
        Assertion(predicate="in", arguments=("tea_box_near_tray", "tea_box")),
        Assertion(predicate="clear", arguments=("cup",)),
    )
    id = listener.hear(verdict(stage, "no room", violated))
    notice = listener.told(language).notice
    assert notice is not None
    assert (notice.good, notice.message, len(notice.help), "no room" in notice.text) == (False, id, 4, True)
    assert language != "en" or notice.help[1:3] == (
        "The cup should be in the tray.",
        "The tea box should be next to the tray.",
    )


def test_what_was_tried_in_vain_is_told() -> None:
    listener = Listener()
    listener.taught()
    listener.called(Restore(name="tea"))
    listener.seen(START)
    listener.hear(plan(STEP), TransferRequest(transfer=STEP, scene=START, number=1))
    listener.hear(outcome(1, STEP, failed_stage="grasp", reason="no way to lift it"), verdict("executor", "no"))
    assert listener.notice.help[0] == "It came to an end while moving things."
    assert listener.notice.tried == (
        "What was tried:",
        "Puts the cup on the tray: while grasping, it cannot be lifted without touching something",
    )
    listener.called(Look())
    assert listener.told().notice is None


def test_what_was_not_remembered_is_said_so() -> None:
    listener = Listener()
    listener.called(Teach(name="tea"))
    listener.hear(verdict("perception", "2 of 6 objects seen"))
    assert listener.notice.text == "“tea” is not remembered: only 2 of 6 objects were seen."


def test_a_scripted_robot_takes_no_commands() -> None:
    listener = Listener(demonstrator={"catalogue": BUILT_IN, "scripted": True})
    listener.hear(Goal(name="tea", scene=GOAL, pddl=""))
    told = listener.told()
    assert (told.actions, told.cards[0].actions, told.doing.text) == ((), (), "The robot follows its script")


def test_a_graph_without_objects_has_no_story() -> None:
    with pytest.raises(Refused, match="story: none of the stages camera has a setting `catalogue`; objects need one"):
        Story({"camera": {}})


# ------------------------------------------------------------------------------------------ languages


def test_both_languages_say_the_same_things_with_the_same_parts() -> None:
    texts = {language: yaml.safe_load(_file(language).read_text()) for language in LANGUAGES}
    english, german = texts["en"]["texts"], texts["de"]["texts"]
    assert english.keys() == german.keys() and texts["en"]["nouns"].keys() == texts["de"]["nouns"].keys()
    for key, text in english.items():
        assert _parts(text) == _parts(german[key]), key
    said = {
        key
        for path in Path(words.__file__).parent.glob("*.py")
        for key in re.findall(r'say\("(\w+)"', path.read_text())
    }
    assert said <= english.keys()


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_object_of_our_catalogue_has_a_name(language: Language) -> None:
    nouns = yaml.safe_load(_file(language).read_text())["nouns"]
    assert {"table", "unknown", *Catalogue.load(BUILT_IN).objects} == nouns.keys()


def test_names_are_bent_counted_and_found_for_what_is_not_known() -> None:
    german, english = words_of("de"), words_of("en")
    assert (
        f"{german.noun('tray')}, {german.noun('tray'):dat}, {german.noun('mug'):acc}"
        == "das Tablett, dem Tablett, den Becher"
    )
    assert [format(words.noun("cup_2")) for words in (english, german)] == ["the cup 2", "die Tasse 2"]
    assert [format(words.noun("obj_000005"), "dat") for words in (english, german)] == [
        "the obj 000005",
        "„obj“ 000005",
    ]
    assert [words.bare("power_drill") for words in (english, german)] == ["power drill", "„power drill“"]
    assert f"{german.nouns(['cup', 'tray', 'mug']):dat}" == "der Tasse, dem Tablett und dem Becher"


def _file(language: str) -> Path:
    return Path(words.__file__).with_name(f"{language}.yaml")


def _parts(text: str) -> set[str | None]:
    return {name for _, name, *_ in string.Formatter().parse(text) if name}
