"""Goals on disk: kept by one stage, found again by the next, edited, and carried to another robot."""

from __future__ import annotations

import base64
import contextlib
import io
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from runner.contract import Command, Refused
from runner.message.codec import decode, encode
from runner.supervise.calls import read_command
from stages.goals import Goals
from stages.messages import Add, Face, Forget, Goal, Kept, Loosen, Rename, SceneGraph, Strike
from stages.planning.symbolic.pddl import goal_pddl
from stages.planning.symbolic.problem import Problem
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.goals import packed, without
from stages.scene.virtual import satisfied
from tests.stages.episodes import Recorded, scene
from tests.stages.story.test_story import NOTHING, frame

TEA = scene({"tray": "table", "cup": "tray", "tea_box": "table"}, beside={"tea_box": "tray"})


class Robot:
    """A stage that keeps goals in a folder, and what it emitted last."""

    def __init__(self, folder: Path) -> None:
        self.stage, self.ctx = Goals(Goals.Config(folder=folder)), Recorded()
        self.kept = self.stage.on_start(self.ctx)

    def taught(self, name: str) -> None:
        self.stage.on_frame(frame())
        goal = Goal(name=name, scene=TEA, pddl=goal_pddl(name, TEA))
        self.kept = self.stage.on_goal(goal, self.ctx)

    def called(self, command: Command) -> None:
        self.kept = getattr(self.stage, f"on_{type(command).__name__.lower()}")(command, self.ctx)

    def goals(self) -> dict[str, Goal]:
        return {goal.name: goal for goal in self.kept.goals}

    def scene(self) -> SceneGraph:
        (goal,) = self.kept.goals
        return goal.scene


def facts(graph: SceneGraph) -> set[str]:
    return set(map(str, graph.assertions))


def test_what_was_taught_today_is_there_tomorrow(tmp_path: Path) -> None:
    today = Robot(tmp_path / "goals")
    assert today.kept == Kept(goals=())
    today.taught("tea")
    (kept,) = Robot(tmp_path / "goals").kept.goals
    assert encode(kept) == encode(today.kept.goals[0])
    assert encode(kept.scene) == encode(TEA) and encode(decode(SceneGraph, encode(kept.scene))) == encode(TEA)
    folder = tmp_path / "goals" / "tea"
    assert {path.name for path in folder.iterdir()} == {"scene.json", "goal.pddl", "picture.jpg"}
    assert (folder / "goal.pddl").read_text() == goal_pddl("tea", TEA)
    assert cv2.imread(str(folder / "picture.jpg")).shape == (480, 640, 3)
    assert today.ctx.lines == [f'goal "tea" kept in {folder}']


def test_a_goal_is_renamed_and_deleted(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    robot.called(Rename(name="tea", to="frühstück"))
    assert list(robot.goals()) == ["frühstück"] and "(problem fr_hst_ck)" in robot.kept.goals[0].pddl
    robot.taught("tea")
    with pytest.raises(Refused, match=r"to='frühstück': there is a goal of that name"):
        robot.called(Rename(name="tea", to="frühstück"))
    with pytest.raises(Refused, match=r"to='../x': must consist of letters"):
        robot.called(Rename(name="tea", to="../x"))
    robot.called(Forget(name="tea"))
    assert list(robot.goals()) == ["frühstück"] and [path.name for path in tmp_path.iterdir()] == ["frühstück"]
    for command in (Forget(name="tea"), Rename(name="../tea", to="x"), Strike(name="tea", what="cup")):
        with pytest.raises(Refused, match=rf"no such goal in {tmp_path}; valid: frühstück"):
            robot.called(command)


def test_a_goal_goes_to_another_robot(tmp_path: Path) -> None:
    here, there = Robot(tmp_path / "here"), Robot(tmp_path / "there")
    here.taught("tea")
    file = packed(here.kept.goals[0])
    assert file == packed(here.kept.goals[0])
    typed = {"file": base64.b64encode(file).decode()}
    there.called(read_command("goals add", Add, typed))
    assert encode(there.kept) == encode(here.kept)
    with pytest.raises(Refused, match="name='tea': there is a goal of that name"):
        there.called(Add(file=file))
    there.called(Add(file=file, name="lunch"))
    assert list(there.goals()) == ["lunch", "tea"]
    zipfile.ZipFile(io.BytesIO(file)).extractall(tmp_path / "third")
    assert encode(Robot(tmp_path / "third").kept) == encode(here.kept)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"nothing", "expected a file that was exported"),
        ({"tea/other.txt": b""}, "it has neither scene.json nor goal.pddl"),
        ({"tea/scene.json": b"{}"}, "missing required field `objects`"),
        ({"tea/scene.json": b'{"objects": 1'}, "is no goal"),
        (packed(Goal(name="tea", scene=NOTHING, pddl="")), "it names no object"),
        ({"../scene.json": b"{}"}, "is no goal"),
        ({"tea/scene.json": b"0" * 20_000_000}, "more than 10000000 bytes"),
    ],
)
def test_what_is_no_goal_is_refused(tmp_path: Path, content: bytes | dict[str, bytes], reason: str) -> None:
    if isinstance(content, dict):
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in content.items():
                archive.writestr(name, data)
        content = file.getvalue()
    with pytest.raises(Refused, match=f"file: is no goal.*{reason}|file: {reason}"):
        Robot(tmp_path / "goals").called(Add(file=content))
    assert not (tmp_path / "goals").exists()


def test_the_last_object_of_a_goal_is_not_left_out(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    first, *others = (item.name for item in TEA.objects)
    for name in others:
        robot.called(Strike(name="tea", what=name))
    with pytest.raises(Refused, match=rf"what='{first}': is the only object of the goal; delete the goal instead"):
        robot.called(Strike(name="tea", what=first))
    assert [item.name for item in robot.scene().objects] == [first]


def test_what_lies_beside_the_goals_is_named_and_left_alone(tmp_path: Path) -> None:
    Robot(tmp_path).taught("tea")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "scene.json").write_text('{"objects": []}')
    (tmp_path / "notes.txt").touch()
    robot = Robot(tmp_path)
    assert list(robot.goals()) == ["tea"]
    (line,) = robot.ctx.lines
    assert line.startswith(f"{tmp_path}/broken: is no goal: Object missing required field `virtual_objects`")


def test_a_name_is_at_most_as_long_as_a_folder_can_have(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    robot.called(Rename(name="tea", to="ü" * 50))
    with pytest.raises(Refused, match=r"to='ü{51}': must have at most 100 bytes as UTF-8"):
        robot.called(Rename(name="ü" * 50, to="ü" * 51))
    assert list(robot.goals()) == ["ü" * 50]


def test_what_the_disk_does_not_take_is_said_and_ends_nothing(tmp_path: Path) -> None:
    Robot(tmp_path / "here").taught("tea")
    file = packed(Robot(tmp_path / "here").kept.goals[0])
    (tmp_path / "goals").write_text("no folder")
    robot = Robot(tmp_path / "goals")
    robot.taught("tea")
    why = f"{tmp_path}/goals/tea: cannot be written: Not a directory"
    assert robot.kept == Kept(goals=(), faults=(why,)) and robot.ctx.lines == [why]
    with pytest.raises(Refused, match=why):
        robot.called(Add(file=file))


def test_what_cannot_be_read_is_never_written_over(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    (tmp_path / "dinner").mkdir()
    (tmp_path / "dinner" / "goal.pddl").write_text("an hour of work")
    for place, command in (
        ("to", Rename(name="tea", to="dinner")),
        ("name", Add(name="dinner", file=packed(robot.kept.goals[0]))),
    ):
        with pytest.raises(Refused, match=rf"{place}='dinner': there is a folder of that name in {tmp_path} that is"):
            robot.called(command)
    robot.taught("dinner")
    assert list(robot.goals()) == ["dinner", "tea"]
    assert (tmp_path / "dinner_unread_1" / "goal.pddl").read_text() == "an hour of work"
    (fault,) = robot.kept.faults
    assert fault.startswith(f"{tmp_path}/dinner_unread_1: goal.pddl: line 1")


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_a_write_that_is_broken_off_loses_no_goal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    robot, left = Robot(tmp_path), iter(range(steps))
    robot.taught("tea")

    def breaking(step: Callable[..., object]) -> Callable[..., object]:
        def taken(*arguments: object) -> object:
            if next(left, None) is None:
                raise KeyboardInterrupt
            return step(*arguments)

        return taken

    with monkeypatch.context() as patch, contextlib.suppress(KeyboardInterrupt):
        patch.setattr(Path, "rename", breaking(Path.rename))
        patch.setattr(shutil, "rmtree", breaking(shutil.rmtree))
        robot.called(Strike(name="tea", what="cup"))
    again = Robot(tmp_path)
    assert again.kept.faults == () and facts(again.scene()) == facts(TEA if steps < 2 else without(TEA, "cup"))
    again.called(Forget(name="tea"))
    assert Robot(tmp_path).kept == Kept(goals=())


def test_of_a_goal_that_is_a_link_only_the_link_is_deleted(tmp_path: Path) -> None:
    Robot(tmp_path / "there").taught("tea")
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "tea").symlink_to(tmp_path / "there" / "tea")
    robot = Robot(tmp_path / "here")
    robot.called(Strike(name="tea", what="cup"))
    robot.called(Forget(name="tea"))
    (tmp_path / "here" / "tea").symlink_to(tmp_path / "there" / "tea")
    robot.called(Forget(name="tea"))
    assert robot.goals() == {} and not any((tmp_path / "here").iterdir())
    assert facts(Robot(tmp_path / "there").scene()) == facts(TEA)


# ------------------------------------------------------------------------------------------ what does not matter


def test_an_object_that_is_struck_out_may_be_anywhere_or_missing(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    robot.called(Strike(name="tea", what="tea_box"))
    goal = robot.scene()
    assert [item.name for item in goal.objects] == ["tray", "cup"] and goal.virtual_objects == ()
    assert facts(goal) == {"exist(tray)", "exist(cup)", "on(tray, table)", "in(cup, tray)"}
    held, violated = satisfied(goal, scene({"tray": "table", "cup": "tray"}), Catalogue.shared(BUILT_IN))
    assert len(held) == 4 and violated == ()
    assert "tea_box" not in robot.kept.goals[0].pddl


def test_a_relation_that_is_struck_out_is_not_planned_for(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    robot.called(Strike(name="tea", what="in(cup, tray)"))
    assert "in(cup, tray)" not in facts(robot.scene()) and "exist(cup)" in facts(robot.scene())
    now = scene({"tray": "table", "tea_box": "table", "cup": "tea_box"})
    problem = Problem.between(now, robot.scene(), held=frozenset({"tea_box"}), graspable=frozenset({"cup"}))
    assert "cup" not in problem.goal and problem.supports["cup"] == "tea_box" and problem.satisfied()


@pytest.mark.parametrize("what", ["in(tea_box_near_tray, tea_box)", "on(tea_box, table)"])
def test_next_to_is_struck_out_alone_or_with_what_carries_it(tmp_path: Path, what: str) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    robot.called(Strike(name="tea", what=what))
    assert robot.scene().virtual_objects == () and not any("near" in fact for fact in facts(robot.scene()))
    assert ("on(tea_box, table)" in facts(robot.scene())) == ("near" in what)


def test_next_to_is_loosened(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    robot.called(Loosen(name="tea", region="tea_box_near_tray", radius=0.08))
    assert [item.radius for item in robot.scene().virtual_objects] == [0.08]
    with pytest.raises(Refused, match="region='cup': no such region; valid: tea_box_near_tray"):
        robot.called(Loosen(name="tea", region="cup", radius=0.08))
    with pytest.raises(Refused, match=r"radius=0.0: must be more than 0 and at most 0.5 metres"):
        robot.called(Loosen(name="tea", region="tea_box_near_tray", radius=0.0))


def test_the_side_that_matters_is_chosen_and_kept(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    with pytest.raises(Refused, match="object='tea_box': no object of the goal whose side can be told; valid: none"):
        robot.called(Face(name="tea", object="tea_box", side="back"))
    told = tuple(msgspec.structs.replace(item, facing=0.99) for item in TEA.objects)
    robot.kept = robot.stage.on_goal(
        Goal(name="tea", scene=msgspec.structs.replace(TEA, objects=told), pddl=""), robot.ctx
    )
    robot.called(Face(name="tea", object="tea_box", side="back"))
    (again,) = Robot(tmp_path).kept.goals
    assert facts(again.scene) == facts(TEA) | {"faces(tea_box, back)"} and "(not (turned tea_box))" in again.pddl
    robot.called(Face(name="tea", object="tea_box", side="any"))
    assert facts(robot.scene()) == facts(TEA)


def test_what_is_not_in_a_goal_cannot_be_struck_out(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.taught("tea")
    for what in ("spoon", "on(cup, spoon)", "exist(cup)"):
        with pytest.raises(Refused, match=r"neither an object nor a relation of the goal; valid: tray, cup, tea_box"):
            robot.called(Strike(name="tea", what=what))
    assert np.all(robot.scene().T_base_table == TEA.T_base_table)


# ----------------------------------------------------------------------------------------------- written by hand


DOCUMENT = Path(__file__).parents[2] / "docs" / "page.md"


def written(folder: Path, name: str) -> Path:
    """The example of the documentation, as a goal of that name."""
    (example,) = re.findall(r"```lisp\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    (folder / name).mkdir(parents=True)
    file = folder / name / "goal.pddl"
    file.write_text(example)
    return file


def asked_for(robot: Robot) -> str:
    (goal,) = robot.kept.goals
    return goal.pddl.partition("(:goal")[2]


def test_a_goal_written_by_hand_is_kept_like_one_that_was_taught(tmp_path: Path) -> None:
    file = written(tmp_path, "tea-for-two")
    robot = Robot(tmp_path)
    assert robot.ctx.lines == []
    goal = robot.goals()["tea-for-two"]
    assert goal.pddl == file.read_text() and goal.picture == b""
    assert [item.name for item in goal.scene.objects] == ["tray", "cup", "cup_2", "tea_box", "salt_shaker"]
    assert {"in(cup, tray)", "in(cup_2, tray)", "on(salt_shaker, tea_box)", "clear(cup)"} <= facts(goal.scene)
    robot.called(Strike(name="tea-for-two", what="clear(cup)"))
    assert "clear(cup)" not in facts(robot.scene()) and "(clear cup)" not in asked_for(robot)
    assert all(item.anywhere for item in robot.scene().objects) and "xyz" not in robot.kept.goals[0].pddl
    robot.called(Rename(name="tea-for-two", to="tea"))
    there = Robot(tmp_path / "there")
    there.called(Add(file=packed(robot.kept.goals[0])))
    assert encode(there.kept) == encode(robot.kept)
    robot.called(Forget(name="tea"))
    assert robot.kept.goals == () and list(tmp_path.iterdir()) == [tmp_path / "there"]


def test_a_goal_written_by_hand_goes_to_another_robot_as_it_is(tmp_path: Path) -> None:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.write(written(tmp_path / "here", "tea"), "tea/goal.pddl")
    there = Robot(tmp_path / "there")
    there.called(Add(file=file.getvalue()))
    assert facts(there.scene()) == facts(Robot(tmp_path / "here").scene())


def test_what_is_wrong_with_a_goal_written_by_hand_is_named_and_others_are_kept(tmp_path: Path) -> None:
    Robot(tmp_path).taught("tea")
    file = written(tmp_path, "mess")
    file.write_text(file.read_text().replace("(clear cup)", "(clear fork)"))
    robot = Robot(tmp_path)
    assert list(robot.goals()) == ["tea"]
    (line,) = robot.ctx.lines
    assert re.fullmatch(
        rf"{tmp_path}/mess: goal.pddl: line \d+: 'fork': not among the objects; valid: table, tray, cup, .*", line
    )
    assert robot.kept.faults == (line,)
