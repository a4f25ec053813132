"""Goals written by hand: what they say, and the line of what they cannot mean."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.contract import Refused
from stages.messages import SceneGraph
from stages.planning.symbolic.pddl import goal_pddl
from stages.scene import virtual
from stages.scene.catalogue import Catalogue
from stages.scene.domain import TABLE
from stages.scene.stance import Standing, is_tipped
from stages.scene.written import scene_of
from tests.stages.layouts import Layout, asserted, breakfast, catalogue, label_of, stances

TEA = """\
; Tea for one.
(define (problem tea)
  (:domain scene)
  (:objects Cup tray tea_box - item)
  (:init)
  (:goal (and (in cup tray)      ; the cup
              (on tray table)
              (clear tea_box))))
"""
CARRIERS = {"tray": "in", "tea_box": "on", "cereal_box": "on"}
CARRIED = ("cup", "soup_can", "tuna_can", "salt_shaker", "cup_2")


def read(text: str) -> SceneGraph:
    return scene_of(text, catalogue())


def without_poses(text: str) -> str:
    return re.sub(r"^;.*\n", "", text, flags=re.MULTILINE)


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    """Carriers far from each other on the table, each with at most one object, turned as it comes."""
    layout = Layout()
    free = list(CARRIED)
    for k, carrier in enumerate(draw(st.lists(st.sampled_from(sorted(CARRIERS)), unique=True, min_size=1))):
        layout.put(carrier, 0.0, -0.4 + 0.4 * k, yaw=draw(st.floats(-3, 3)))
        if draw(st.booleans()):
            layout.put(free.pop(draw(st.integers(0, len(free) - 1))), 0.0, 0.0, yaw=draw(st.floats(-3, 3)), on=carrier)
    return layout


@settings(max_examples=12, deadline=None)
@given(layouts(), st.booleans())
def test_a_taught_goal_is_read_back_from_its_pddl(layout: Layout, poses: bool) -> None:
    taught = layout.graph()
    text = goal_pddl("taught", taught)
    again = read(text if poses else without_poses(text))
    assert asserted(again) == asserted(taught)
    assert [(item.name, item.label) for item in again.objects] == [(item.name, item.label) for item in taught.objects]
    for now, shown in zip(again.objects, taught.objects, strict=True):
        assert now.anywhere is not poses
        assert not is_tipped(catalogue()[now.label], now.T_base_object, shown.T_base_object)
        if poses:
            assert np.allclose(now.T_base_object, shown.T_base_object, atol=2e-4)
    assert asserted(read(goal_pddl("again", again))) == asserted(taught)


def test_what_is_beside_what_is_read_from_the_poses_of_both() -> None:
    taught = breakfast().put("milk_carton", -0.05, 0.42).graph()
    assert taught.virtual_objects
    text = goal_pddl("taught", taught)
    again = read(text)
    assert set(map(str, again.assertions)) == set(map(str, taught.assertions))
    for now, shown in zip(again.virtual_objects, taught.virtual_objects, strict=True):
        assert (now.name, now.parent, now.child, now.radius) == (shown.name, shown.parent, shown.child, shown.radius)
        assert np.allclose(now.T_parent_virtual, shown.T_parent_virtual, atol=5e-4)
    with pytest.raises(Refused, match=r"line \d+: '\(in \w+_near_\w+ \w+\)': .*valid: poses of both in comments"):
        read(without_poses(text))


@pytest.mark.parametrize("called", ["024_bowl", "Öl", "jam jar"])
def test_a_goal_of_objects_of_any_name_is_read_back(called: str) -> None:
    ours = Catalogue({called: replace(catalogue()["milk_carton"], name=called), "tray": catalogue()["tray"]})
    names = {"milk_carton": called, "milk_carton_2": f"{called}_2", "tray": "tray"}
    taught = renamed(
        Layout().put("tray", 0, 0).put("milk_carton", 0.0, 0.30).put("milk_carton_2", 0.0, 0.39).graph(), names
    )
    assert taught.virtual_objects
    again = scene_of(goal_pddl("taught", taught), ours)
    assert set(map(str, again.assertions)) == set(map(str, taught.assertions))
    for now, shown in zip(again.objects, taught.objects, strict=True):
        assert (now.name, now.label) == (shown.name, shown.label)
        assert np.allclose(now.T_base_object, shown.T_base_object, atol=2e-4)


def renamed(scene: SceneGraph, names: Mapping[str, str]) -> SceneGraph:
    """The same scene of objects of other names; equal ones have the label of the first."""
    regions = tuple(
        virtual.region(names[item.parent], names[item.child], item.T_parent_virtual, item.radius)
        for item in scene.virtual_objects
    )
    before = [item.name for item in scene.virtual_objects]
    names = {**names, **dict(zip(before, [item.name for item in regions], strict=True)), TABLE: TABLE}
    return msgspec.structs.replace(
        scene,
        objects=tuple(
            msgspec.structs.replace(item, name=names[item.name], label=names[item.label]) for item in scene.objects
        ),
        virtual_objects=regions,
        assertions=tuple(
            msgspec.structs.replace(item, arguments=tuple(names[one] for one in item.arguments))
            for item in scene.assertions
        ),
    )


def test_a_goal_asks_only_for_what_it_names() -> None:
    tea = read(TEA)
    assert [item.name for item in tea.objects] == ["cup", "tray", "tea_box"]
    exist = {"exist(cup)", "exist(tray)", "exist(tea_box)"}
    assert asserted(tea) == exist | {"in(cup, tray)", "on(tray, table)", "clear(tea_box)"}
    assert tea.virtual_objects == () and tea.frame == "base"
    one = read(re.sub(r"\(and (\(in cup tray\)).*", r"\1))", TEA, flags=re.DOTALL))
    assert asserted(one) == exist | {"in(cup, tray)"}


def test_without_poses_objects_stand_upright_on_what_carries_them() -> None:
    stack = TEA.replace("Cup tray", "Cup soup_can tray").replace("(clear tea_box)", "(on soup_can tea_box)")
    for item in read(stack).objects:
        assert item.anywhere
        assert np.allclose(item.T_base_object[:3, :3], catalogue()[item.label].resting[0])
    placed = {
        item.name: Standing.at(item.name, stances(item.label), item.T_base_object) for item in read(stack).objects
    }
    assert placed["soup_can"].z_bottom == pytest.approx(placed["tea_box"].z_top)
    assert placed["cup"].z_bottom == pytest.approx(placed["tray"].z_floor, abs=0.002)
    assert placed["tray"].z_bottom == pytest.approx(0.0)


def test_what_has_no_pose_stands_in_the_middle_of_what_has_one_and_turned_like_that() -> None:
    tray = Layout().put("tray", 0.1, -0.2, yaw=0.5)
    (pose,) = (line for line in goal_pddl("tray", tray.graph()).splitlines() if line.startswith("; goal_tray"))
    goal = read(f"{pose}\n{TEA}")
    assert [item.name for item in goal.objects if not item.anywhere] == ["tray"]
    placed = {item.name: item.T_base_object for item in goal.objects}
    assert np.allclose(placed["tray"][:2, 3], placed["cup"][:2, 3], atol=0.01)
    assert np.allclose(placed["tray"][:3, :3], placed["cup"][:3, :3], atol=1e-3)
    assert goal.T_base_table[2, 3] == pytest.approx(0.7, abs=1e-3)


def test_names_are_labels_or_numbered_labels() -> None:
    two = read(TEA.replace("tea_box", "cup_2"))
    assert [(item.name, item.label) for item in two.objects] == [("cup", "cup"), ("tray", "tray"), ("cup_2", "cup")]
    assert {label_of(item.name) for item in two.objects} == {"cup", "tray"}


OBJECTS = "table, cup, tray, tea_box"
VALID = rf"valid: \(on A B\), \(in A B\), \(clear A\), \(exist A\) of {OBJECTS}"


POSE = "goal_tray xyz 0.6 -0.2 0.7 quaternion_xyzw 0 0 0 1"


@pytest.mark.parametrize("init", [f"; {POSE}\n(:init)", f"  \t;;;{POSE}\n(:init)", f"(:init) ; the tray ; {POSE}\r\n"])
def test_a_place_may_stand_wherever_a_comment_may(init: str) -> None:
    goal = read(TEA.replace("  (:init)", init))
    (tray,) = (item for item in goal.objects if item.name == "tray")
    assert not tray.anywhere and np.allclose(tray.T_base_object[:3, 3], [0.6, -0.2, 0.7])


@pytest.mark.parametrize(
    "comment",
    [
        *("; goal_tray xyz 0.5 quaternion_xyzw 0 0 0 1", "; goal_tray 0.6 -0.2 0.7 quaternion_xyzw 0 0 0 1"),
        *("; goal_tray xyz 0.6 -0.2 0.7", "; goal_tray xyz 0.6 -0.2 0.7 quaternion_xyzw 0 0 0 1 0", "; goal_"),
        *("; goal_tray xyz 0.6 -0.2 high quaternion_xyzw 0 0 0 1", "; goal_fork xyz 0 0 0 quaternion_xyzw 0 0 0 1"),
        *("; goal_tray xyz 0.6 -0.2 nan quaternion_xyzw 0 0 0 1", "; goal_tray xyz 0 0 0 quaternion_xyzw 0 0 0 0"),
    ],
)
def test_a_place_that_is_none_is_refused_wherever_it_stands(comment: str) -> None:
    form = r"no pose of an item; valid: ; goal_ITEM xyz X Y Z quaternion_xyzw X Y Z W, for each of cup, tray, tea_box"
    with pytest.raises(Refused, match=rf"line 7: '{comment}': {form}"):
        read(TEA.replace("(on tray table)", f"(on tray table) {comment}"))


def test_an_item_has_one_place() -> None:
    with pytest.raises(Refused, match=f"line 2: '; {POSE}': a second pose of tray; valid: one for each item"):
        read(f"; {POSE}\n; {POSE}\n{TEA}")


@pytest.mark.parametrize(
    ("old", "new", "refused"),
    [
        ("tray tea_box -", "tray spoon -", r"line 8: 'tea_box': not among the objects; valid: table, cup, tray, spoon"),
        (
            "tea_box",
            "spoon",
            r"line 4: 'spoon': no object of the catalogue; valid: a label, .*: tray, plate, bowl, cup",
        ),
        ("tea_box", "cup_1", r"line 4: 'cup_1': no object of the catalogue"),
        ("(clear", "(free", rf"line 8: '\(free tea_box\)': no relation that a goal may have; {VALID}"),
        ("(in cup", "(in fork", rf"line 6: 'fork': not among the objects; valid: {OBJECTS}"),
        (
            "(on tray table)",
            "(on table tray)",
            rf"line 7: '\(on table tray\)': the table rests on nothing; {VALID}",
        ),
        ("(on tray table)", "(in table tray)", r"line 7: '\(in table tray\)': the table rests on nothing"),
        ("(clear tea_box)", "(clear tea_box cup)", rf"line 8: '\(clear tea_box cup\).*arity 1.*; {VALID}"),
        ("(clear tea_box)", "(on cup table)", r"line 8: '\(on cup table\)': contradicts \(in cup tray\) on line 6"),
        ("(clear tea_box)", "(clear tray)", r"line 8: '\(clear tray\)': contradicts \(in cup tray\) on line 6"),
        ("(clear tea_box)", "(clear table)", r"line 8: '\(clear table\)': .*; valid: tray, tea_box, cup"),
        ("(on tray table)", "(on tray cup)", r"line 7: '\(in cup tray\) \(on tray cup\)': a circle"),
        ("(in cup tray)", "(on cup tray)", r"line 6: '\(on cup tray\)': tray is hollow; valid: \(in cup tray\)"),
        ("(in cup tray)", "(in cup tea_box)", r"line 6: .*tea_box is not hollow; valid: \(on cup tea_box\)"),
        (
            "(clear tea_box)",
            "(not (on cup table))",
            rf"line 6: '\(not on\(cup, table\)\)': more than .*; {VALID}",
        ),
        ("(and", "(or", r"line 6: .*: more than an `and` of relations"),
        ("- item", "- gadget", r"line 4: 'gadget': no type of an object; valid: item, region, label"),
        (" - item", "", r"line 4: 'tea_box': without a type; valid: tea_box - item"),
        ("Cup tray", "Cup cup tray", r"line 4: 'cup': declared more than once; valid: each name once"),
        ("  (:init)\n", "", r"line 5: '\(:goal .*Expected ':init'"),
        ("(:goal", "(:aim", r"Expected|Missing goal"),
        (
            "; Tea for one.",
            "; goal_cup xyz 1 2 quaternion_xyzw 0 0 0 1",
            r"line 1: '; goal_cup .*': no pose of an item",
        ),
        (
            "; Tea for one.",
            "; goal_cup xyz 1 2 3 quaternion_xyzw 0 0 0 1",
            r"line 1: 'goal_cup': without goal_tray; valid",
        ),
    ],
)
def test_what_cannot_be_meant_is_refused_with_its_line(old: str, new: str, refused: str) -> None:
    with pytest.raises(Refused, match=refused):
        read(TEA.replace(old, new))


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_a_file_with_a_piece_missing_is_read_or_refused(data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(TEA)))
    end = data.draw(st.integers(start, len(TEA)))
    try:
        read(TEA[:start] + TEA[end:])
    except Refused as refusal:
        assert re.match(r"line \d+: ", str(refusal))
