"""Objects that are not seen stay where they were last seen or placed, unless their place is seen empty."""

import msgspec
import numpy as np
import pytest

from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse, pose
from stages.messages import Candidate, Frame, Observation, SceneGraph
from stages.messages.scene import SceneObject
from stages.perception.confidence.memory import Memory
from stages.perception.observation.preprocessing import preprocess
from stages.scene import virtual
from tests.stages.layouts import T_BASE_TABLE, Layout, asserted
from tests.stages.perception.scenes import CATALOGUE, K, camera, render, upright

MEMORY = Memory(CATALOGUE)
CARTON = upright("milk_carton", 0.0, -0.05, 0.0)
BEHIND = upright("salt_shaker", 0.0, 0.04, 0.0)
HALF_BEHIND = upright("cup", 0.07, 0.04, 0.0)


def graph(placed: dict[str, Floats]) -> SceneGraph:
    return Layout(placed).graph()


def known(placed: dict[str, Floats]) -> dict[str, SceneObject]:
    return {item.name: item for item in graph(placed).objects}


def observation(placed: dict[str, Floats]) -> Observation:
    scene = render(placed).scene
    return Observation(
        depth=scene.depth,
        rgb=np.zeros((*scene.depth.shape, 3), np.uint8),
        foreground=scene.foreground,
        K=K,
        T_camera_table=scene.T_camera_table,
        T_base_camera=T_BASE_TABLE @ inverse(camera()),
    )


def looked_at(true: dict[str, Floats], found: str) -> Observation:
    """What a camera keeps of a scene that finds one object of it: little but the surroundings of that one."""
    rendered = render(true)
    depth = rendered.scene.depth
    frame = Frame(
        rgb=np.zeros((*depth.shape, 3), np.uint8), depth=depth, K=K, T_base_camera=None, robot_mask=None,
        name="look", index=0, total=1,
    )  # fmt: skip
    candidate = Candidate(box=rendered.boxes[found], label=found, confidence=0.9)
    kept = preprocess(frame, [candidate], np.random.default_rng(0), max_height=0.6)
    return msgspec.structs.replace(kept, T_base_camera=T_BASE_TABLE @ inverse(camera()))


def completed(seen: dict[str, Floats], before: dict[str, Floats], true: dict[str, Floats]) -> SceneGraph:
    """The scene that shows ``seen`` of what is truly there, to somebody who knew of ``before``."""
    remembered = known(before)
    look = observation(true)
    return MEMORY.complete(MEMORY.named(graph(seen), remembered, look), remembered, look)


def names(scene: SceneGraph) -> list[str]:
    return [item.name for item in scene.objects]


def test_what_is_hidden_stays_where_it_was() -> None:
    everything = {"milk_carton": CARTON, "salt_shaker": BEHIND}
    scene = completed({"milk_carton": CARTON}, everything, everything)
    assert names(scene) == ["milk_carton", "salt_shaker"]
    np.testing.assert_allclose(scene.objects[1].T_base_object, T_BASE_TABLE @ BEHIND, atol=1e-9)
    assert {"exist(salt_shaker)", "on(salt_shaker, table)", "clear(salt_shaker)"} <= asserted(scene)


def test_what_shows_half_but_was_not_recognised_stays() -> None:
    everything = {"milk_carton": CARTON, "cup": HALF_BEHIND}
    assert names(completed({"milk_carton": CARTON}, everything, everything)) == ["milk_carton", "cup"]


def test_what_is_taken_away_from_an_open_place_is_forgotten() -> None:
    cup = upright("cup", 0.15, -0.1, 0.0)
    scene = completed({"milk_carton": CARTON}, {"milk_carton": CARTON, "cup": cup}, {"milk_carton": CARTON})
    assert names(scene) == ["milk_carton"] and asserted(scene) == asserted(graph({"milk_carton": CARTON}))


def test_a_half_hidden_place_that_is_empty_is_seen_empty() -> None:
    before = {"milk_carton": CARTON, "cup": HALF_BEHIND}
    assert names(completed({"milk_carton": CARTON}, before, {"milk_carton": CARTON})) == ["milk_carton"]


def test_a_tray_that_is_taken_away_is_forgotten_and_one_that_was_pushed_is_not() -> None:
    can = {"tuna_can": upright("tuna_can", 0.25, -0.1, 0.0)}
    tray = {**can, "tray": upright("tray", 0.0, -0.15, 0.0)}
    assert names(completed(can, tray, can)) == ["tuna_can"]
    for x, y in ((0.0, -0.15), (-0.01, -0.15), (0.01, -0.15), (0.0, -0.16), (0.0, -0.14), (0.015, -0.14)):
        pushed = {**can, "tray": upright("tray", x, y, 0.05)}
        assert names(completed(can, tray, pushed)) == ["tuna_can", "tray"]


@pytest.mark.parametrize(
    ("instead", "left"),
    [({}, ["cup"]), ({"mug": 0.153}, ["cup", "mug"]), ({"milk_carton": 0.15}, ["cup", "mug"])],
)
def test_what_is_taken_away_far_from_what_is_left_is_forgotten(instead: dict[str, float], left: list[str]) -> None:
    """The mug's place is outside the working area, which is around the cup; the mug is kept where something that is not
    recognised hides its place, or where it is itself, pushed a little."""
    cup = {"cup": upright("cup", -0.2, 0.0, 0.0)}
    before = known({**cup, "mug": upright("mug", 0.15, 0.0, 0.0)})
    true = {**cup, **{name: upright(name, x, 0.0, 0.0) for name, x in instead.items()}}
    look = looked_at(true, "cup")
    assert names(MEMORY.complete(graph(cup), before, look)) == left


def test_what_is_seen_elsewhere_is_there() -> None:
    moved = {"milk_carton": CARTON, "salt_shaker": upright("salt_shaker", 0.15, -0.1, 0.0)}
    scene = completed(moved, {"milk_carton": CARTON, "salt_shaker": BEHIND}, moved)
    assert asserted(scene) == asserted(graph(moved)) and len(scene.objects) == 2


def test_what_was_taken_for_a_stranger_is_what_stood_there() -> None:
    everything = {"milk_carton": CARTON, "cup": HALF_BEHIND}
    stranger = {"milk_carton": CARTON, "soup_can": upright("soup_can", 0.06, 0.05, 0.0)}
    scene = completed(stranger, everything, everything)
    assert names(scene) == ["milk_carton", "cup"]
    assert not any("soup_can" in text for text in asserted(scene))


@pytest.mark.parametrize(
    ("visible", "probability", "before", "believed"),
    [
        (0.2, None, None, True),
        (0.8, None, None, False),
        (0.8, 0.95, None, True),
        (0.8, 0.5, None, False),
        (1.0, 0.95, None, False),
        (1.0, 0.95, 0.99, False),
        (1.0, 0.95, 0.88, True),
        (1.0, 0.56, 0.22, True),
        (1.0, 0.20, 0.22, False),
        (1.0, 0.60, 0.55, False),
    ],
)
def test_a_stranger_of_which_more_shows_or_that_is_surer_is_believed(
    visible: float, probability: float | None, before: float | None, believed: bool
) -> None:
    """A can that was called a salt shaker while a carton hid some of it."""
    can = {"soup_can": upright("soup_can", 0.06, 0.05, 0.0)}
    shaker = known({"salt_shaker": HALF_BEHIND})["salt_shaker"]
    shaker = msgspec.structs.replace(shaker, visible=visible, probability=before)
    (now,) = graph(can).objects
    seen = msgspec.structs.replace(
        graph(can), objects=(msgspec.structs.replace(now, visible=0.9, probability=probability),)
    )
    scene = MEMORY.complete(seen, {"salt_shaker": shaker}, observation(can))
    assert names(scene) == ["soup_can" if believed else "salt_shaker"]


@pytest.mark.parametrize(
    ("wanted", "elsewhere", "visible", "probability", "believed"),
    [
        ({"soup_can"}, False, 0.2, 0.95, True),
        ({"soup_can"}, False, 0.2, 0.85, False),
        ({"soup_can", "salt_shaker"}, False, 0.2, 0.95, False),
        ({"soup_can", "salt_shaker"}, True, 0.2, 0.95, True),
        (set(), False, 0.2, 0.95, False),
        (set(), False, 0.5, 0.95, True),
        ({"salt_shaker"}, False, 0.5, 0.95, False),
        ({"salt_shaker"}, False, 0.9, 0.95, True),
        ({"salt_shaker"}, True, 0.5, 0.95, True),
    ],
)
def test_of_a_stranger_and_what_it_was_taken_for_the_one_is_believed_that_the_goal_wants(
    wanted: set[str], elsewhere: bool, visible: float, probability: float, believed: bool
) -> None:
    """A can behind a carton that was called a salt shaker, of which 40 % showed; a shaker may stand elsewhere, too."""
    placed = {"soup_can": upright("soup_can", 0.06, 0.05, 0.0)}
    placed |= {"salt_shaker": upright("salt_shaker", -0.2, 0.05, 0.0)} if elsewhere else {}
    shaker = known({"salt_shaker": HALF_BEHIND})["salt_shaker"]
    shaker = msgspec.structs.replace(shaker, visible=0.4, probability=0.99)
    seen = [msgspec.structs.replace(item, visible=visible, probability=probability) for item in graph(placed).objects]
    if elsewhere:
        seen[1] = msgspec.structs.replace(seen[1], name="salt_shaker_2")
    scene = msgspec.structs.replace(graph(placed), objects=tuple(seen))
    scene = MEMORY.complete(scene, {"salt_shaker": shaker}, observation(placed), wanted)
    others = ["salt_shaker_2"] if elsewhere else []
    assert names(scene) == (["soup_can", *others] if believed else [*others, "salt_shaker"])


def test_what_stands_on_a_box_does_not_say_that_there_is_none() -> None:
    """Of a box under a sponge so little shows that it is taken for a can; the sponge is seen a millimetre too low."""
    layout = Layout().put("tea_box", 0.0, 0.0).put("sponge", 0.0, 0.0, on="tea_box")
    box = msgspec.structs.replace(known(layout.poses)["tea_box"], probability=0.995, visible=1.0)
    low = layout.poses["sponge"].copy()
    low[2, 3] -= 0.001
    sponge, can = graph({"sponge": low, "soup_can": upright("soup_can", 0.0, 0.0, 0.0)}).objects
    sponge = msgspec.structs.replace(sponge, probability=0.998)
    can = msgspec.structs.replace(can, probability=0.97, visible=0.26)
    seen = msgspec.structs.replace(graph({"sponge": low}), objects=(sponge, can))
    assert names(MEMORY.complete(seen, {"tea_box": box}, observation(layout.poses))) == ["sponge", "tea_box"]


def test_a_stranger_elsewhere_is_kept() -> None:
    everything = {"milk_carton": CARTON, "salt_shaker": BEHIND, "tuna_can": upright("tuna_can", 0.15, -0.1, 0.0)}
    seen = {"milk_carton": CARTON, "tuna_can": everything["tuna_can"]}
    scene = completed(seen, {"milk_carton": CARTON, "salt_shaker": BEHIND}, everything)
    assert names(scene) == ["milk_carton", "tuna_can", "salt_shaker"]


def test_what_is_in_a_tray_is_no_stranger_to_it() -> None:
    layout = Layout().put("tray", 0.0, 0.0).put("cup", 0.0, 0.0, on="tray")
    seen = {"cup": layout.poses["cup"]}
    scene = completed(seen, {"tray": layout.poses["tray"]}, layout.poses)
    assert names(scene) == ["cup", "tray"] and "in(cup, tray)" in asserted(scene)


def test_relations_include_what_is_remembered() -> None:
    layout = Layout({"milk_carton": CARTON}).put("tea_box", 0.05, 0.06).put("tuna_can", 0.0, 0.0, on="tea_box")
    seen = {name: T for name, T in layout.poses.items() if name != "tuna_can"}
    scene = completed(seen, layout.poses, layout.poses)
    assert "on(tuna_can, tea_box)" in asserted(scene) and "clear(tea_box)" not in asserted(scene)


def test_regions_of_what_is_seen_stay() -> None:
    pair = {"milk_carton": CARTON, "sugar_box": upright("sugar_box", 0.1, -0.05, 0.0), "salt_shaker": BEHIND}
    seen = {name: pair[name] for name in ("milk_carton", "sugar_box")}
    scene = completed(seen, pair, pair)
    assert {item.name for item in scene.virtual_objects} == {item.name for item in graph(seen).virtual_objects} != set()
    assert {text for text in asserted(graph(seen)) if "_near_" in text} <= asserted(scene)


def test_what_stands_on_something_that_is_remembered_leaves_its_place_to_that() -> None:
    layout = Layout().put("sponge", -0.05, 0.0).put("tuna_can", 0.05, 0.0).put("tea_box", 0.0, 0.0, on="tuna_can")
    seen = {name: layout.poses[name] for name in ("sponge", "tea_box")}
    seen["tea_box"] = upright("tea_box", 0.05, 0.0, 0.0)  # perception puts on the table what it sees nothing below
    scene = MEMORY.related(graph(seen), graph(layout.poses).objects)
    assert "has(sponge, tuna_can_near_sponge)" in asserted(scene) == asserted(graph(layout.poses))
    (region,), (expected,) = scene.virtual_objects, graph(layout.poses).virtual_objects
    assert region.T_parent_virtual == pytest.approx(expected.T_parent_virtual)


def test_two_on_one_that_is_remembered_leave_it_one_place() -> None:
    layout = Layout().put("tray", 0.0, 0.0).put("cup", 0.0, -0.06, on="tray").put("soup_can", 0.0, 0.06, on="tray")
    layout.put("milk_carton", 0.3, 0.0)
    beside = tuple(virtual.region("milk_carton", name, np.eye(4), 0.04) for name in ("cup", "soup_can"))
    scene = msgspec.structs.replace(graph(layout.poses), virtual_objects=beside)
    found = [item.name for item in MEMORY.related(scene, scene.objects).virtual_objects]
    assert found == ["tray_near_milk_carton"]


def test_what_stands_beside_an_equal_object_that_is_renamed_stays_beside_it() -> None:
    here, there, box = (
        upright("sponge", 0.2, 0.0, 0.0),
        upright("sponge", -0.2, 0.0, 0.0),
        upright("tea_box", 0.29, 0.0, 0.0),
    )
    seen = graph({"sponge": here, "sponge_2": there, "tea_box": box})
    scene = MEMORY.named(seen, known({"sponge_2": here, "sponge": there}), observation({}))
    (region,) = scene.virtual_objects
    assert {region.parent, region.child} == {"sponge_2", "tea_box"}


def test_the_only_one_of_its_kind_keeps_the_name_that_is_known_where_it_stands() -> None:
    here, there = upright("sponge", 0.15, 0.0, 0.0), upright("sponge", -0.15, 0.0, 0.0)
    for seen, expected in ((here, "sponge"), (there, "sponge_2")):
        assert names(MEMORY.named(graph({"sponge_2": seen}), known({"sponge": here}), observation({}))) == [expected]


def test_the_only_one_that_is_seen_of_two_is_the_one_that_is_known_where_it_stands() -> None:
    here, there = upright("sponge", 0.15, 0.0, 0.0), upright("sponge", -0.15, 0.0, 0.0)
    before = known({"sponge": here, "sponge_2": there})
    assert names(MEMORY.named(graph({"sponge": there}), before, observation({}))) == ["sponge_2"]


@pytest.mark.parametrize(
    ("probability", "off", "kept"), [(0.6, 0.01, True), (0.95, 0.01, False), (0.6, 0.03, False), (None, 0.01, False)]
)
def test_a_doubtful_pose_gives_way_to_a_sure_one_of_before(probability: float | None, off: float, kept: bool) -> None:
    """A mug whose handle is hidden now."""
    true, doubted = upright("mug", 0.1, 0.1, 0.0), upright("mug", 0.1 + off, 0.1, 0.5)
    doubtful = msgspec.structs.replace(known({"mug": doubted})["mug"], probability=probability)
    sure = msgspec.structs.replace(known({"mug": true})["mug"], probability=0.99)
    seen = msgspec.structs.replace(graph({"mug": doubted}), objects=(doubtful,))
    (mug,) = MEMORY.complete(seen, {"mug": sure}, observation({"mug": true})).objects
    np.testing.assert_allclose(mug.T_base_object, T_BASE_TABLE @ (true if kept else doubted), atol=1e-9)


@pytest.mark.parametrize(("off", "kept"), [(0.03, True), (0.1, False)])
@pytest.mark.parametrize("probability", [0.6, 0.95])
def test_a_doubtful_look_turns_nothing_upside_down_where_it_stood(probability: float, off: float, kept: bool) -> None:
    """A mug at the edge of the picture, of which only the rim shows."""
    true, over = upright("mug", 0.1, 0.1, 0.0), upright("mug", 0.1 + off, 0.1, 0.0)
    over[:3, :3] = np.diag([1.0, -1.0, -1.0])
    doubtful = msgspec.structs.replace(known({"mug": over})["mug"], probability=probability)
    sure = msgspec.structs.replace(known({"mug": true})["mug"], probability=0.99)
    seen = msgspec.structs.replace(graph({"mug": over}), objects=(doubtful,))
    (mug,) = MEMORY.complete(seen, {"mug": sure}, observation({"mug": true})).objects
    believed = true if kept and probability < 0.9 else over
    np.testing.assert_allclose(mug.T_base_object, T_BASE_TABLE @ believed, atol=1e-9)


@pytest.mark.parametrize("name", ["sugar_box", "tea_box"])
def test_a_region_is_told_by_the_pose_that_is_believed(name: str) -> None:
    true = {"sugar_box": upright("sugar_box", 0.1, 0.0, 0.3), "tea_box": upright("tea_box", 0.0, 0.1, 0.0)}
    doubted = {**true, name: true[name] @ pose(upright(name, 0.0, 0.0, 0.5)[:3, :3], np.array([0.01, 0.01, 0.0]))}
    before = {one: msgspec.structs.replace(item, probability=0.99) for one, item in known(true).items()}
    scene = graph(doubted)
    doubtful = [msgspec.structs.replace(item, probability=0.6 if item.name == name else 0.99) for item in scene.objects]
    completed = MEMORY.complete(msgspec.structs.replace(scene, objects=tuple(doubtful)), before, observation(true))
    (region,), (expected,) = completed.virtual_objects, graph(true).virtual_objects
    assert region.name == expected.name
    np.testing.assert_allclose(region.T_parent_virtual, expected.T_parent_virtual, atol=1e-9)


def test_a_doubtful_pose_that_reaches_into_what_is_remembered_gives_way_to_a_sure_one_of_before() -> None:
    """Two sponges on each other, taken for one on its edge."""
    layout = Layout().put("sponge_2", 0.0, 0.0).put("sponge", 0.0, 0.0, on="sponge_2")
    before = {name: msgspec.structs.replace(one, probability=0.99) for name, one in known(layout.poses).items()}
    on_edge = pose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.array([0.02, 0.03, 0.035]))
    (edge,) = graph({"sponge": on_edge}).objects
    edge = msgspec.structs.replace(edge, name="sponge_2", probability=0.85)
    seen = msgspec.structs.replace(graph(layout.poses), objects=(edge,))
    scene = MEMORY.complete(seen, before, observation(layout.poses))
    assert {one.name: one.T_base_object.tolist() for one in scene.objects} == {
        name: one.T_base_object.tolist() for name, one in before.items()
    }


@pytest.mark.parametrize(("probability", "left"), [(0.3, ["tea_box"]), (0.99, ["tea_box", "tuna_can"])])
def test_what_reaches_into_what_is_surely_there_was_a_mistake(probability: float, left: list[str]) -> None:
    """Part of a box was taken for a can; then the box is seen as it is."""
    box, can = upright("tea_box", 0.1, 0.1, 0.0), upright("tuna_can", 0.12, 0.1, 0.0)
    before = known({"tea_box": box, "tuna_can": can})
    before["tuna_can"] = msgspec.structs.replace(before["tuna_can"], probability=probability)
    sure = tuple(msgspec.structs.replace(item, probability=0.98) for item in graph({"tea_box": box}).objects)
    seen = msgspec.structs.replace(graph({"tea_box": box}), objects=sure)
    scene = MEMORY.complete(seen, before, observation({"tea_box": box, "tuna_can": can}))
    assert names(scene) == left


def test_what_is_in_a_container_does_not_reach_into_it() -> None:
    for container in ("tray", "bowl", "plate"):
        layout = Layout().put(container, 0.0, 0.0).put("tuna_can", 0.0, 0.0, on=container)
        before = known(layout.poses)
        before["tuna_can"] = msgspec.structs.replace(before["tuna_can"], probability=0.9)
        sure = tuple(msgspec.structs.replace(item, probability=0.98) for item in graph(layout.poses).objects[:1])
        seen = msgspec.structs.replace(graph({container: layout.poses[container]}), objects=sure)
        scene = MEMORY.complete(seen, before, observation(layout.poses))
        assert names(scene) == [container, "tuna_can"]


def test_what_surely_stands_in_a_mug_does_not_say_that_there_is_none() -> None:
    layout = Layout().put("mug", 0.0, 0.0).put("water_bottle", -0.0115, 0.0, on="mug")
    before = known(layout.poses)
    before["mug"] = msgspec.structs.replace(before["mug"], probability=0.77)
    sure = tuple(msgspec.structs.replace(item, probability=0.99) for item in graph(layout.poses).objects[1:])
    seen = msgspec.structs.replace(graph({"water_bottle": layout.poses["water_bottle"]}), objects=sure)
    assert names(MEMORY.complete(seen, before, observation(layout.poses))) == ["water_bottle", "mug"]


@pytest.mark.parametrize(
    ("gone", "before", "expected"),
    [
        (False, {"salt_shaker": BEHIND}, ["milk_carton", "salt_shaker_2", "salt_shaker"]),
        (True, {"salt_shaker": HALF_BEHIND}, ["milk_carton", "salt_shaker"]),
        (False, {"salt_shaker_2": BEHIND}, ["milk_carton", "salt_shaker", "salt_shaker_2"]),
    ],
)
def test_what_another_view_showed_keeps_its_name_while_it_may_be_hidden(
    gone: bool, before: dict[str, Floats], expected: list[str]
) -> None:
    """An equal one is seen elsewhere from here: it is another one, unless the place of the first is seen empty."""
    seen = {"milk_carton": CARTON, "salt_shaker": upright("salt_shaker", 0.2, 0.0, 0.0)}
    look = observation(seen if gone else {**seen, "salt_shaker_2": BEHIND})
    remembered = known({"milk_carton": CARTON, **before})
    scene = MEMORY.named(graph(seen), remembered, look, remembered.keys())
    assert names(MEMORY.complete(scene, remembered, look)) == expected


def test_two_that_another_view_showed_in_each_others_places_keep_their_names() -> None:
    here, there = (0.15, -0.1, 0.0), (-0.15, -0.1, 0.0)
    before = known({"mug": upright("mug", *here), "soup_can": upright("soup_can", *there)})
    now = {"mug": upright("mug", *there), "soup_can": upright("soup_can", *here)}
    assert names(MEMORY.named(graph(now), before, observation(now), before.keys())) == ["mug", "soup_can"]


def test_equal_objects_are_those_that_are_known_where_they_stand() -> None:
    """Two sponges, of which the hand has put the first where the look now calls it another one."""
    here, there = upright("sponge", 0.15, 0.0, 0.0), upright("sponge", -0.15, 0.0, 0.0)
    seen = {"sponge_3": there, "sponge_2": here, "milk_carton": CARTON}
    before = {"sponge": there, "sponge_2": here, "milk_carton": CARTON}
    scene = completed(seen, before, {"milk_carton": CARTON})
    assert names(scene) == ["sponge", "sponge_2", "milk_carton"]
    assert "on(sponge, table)" in asserted(scene)


def test_one_more_than_are_known_keeps_out_of_their_names() -> None:
    here, there, new = (upright("sponge", x, 0.1, 0.0) for x in (0.2, -0.2, 0.0))
    seen = {"sponge_2": new, "sponge": there, "sponge_3": here}
    scene = completed(seen, {"sponge": here, "sponge_2": there}, {})
    assert names(scene) == ["sponge_3", "sponge_2", "sponge"]


def test_a_mug_of_which_a_part_was_taken_for_a_cup_is_no_mug_with_a_cup_in_it() -> None:
    layout = Layout().put("mug", 0.0, 0.0).put("cup", -0.0115, 0.0)
    before = known(layout.poses)["cup"]
    before = msgspec.structs.replace(before, probability=0.96, visible=0.28)
    sure = tuple(msgspec.structs.replace(item, probability=0.99) for item in graph(layout.poses).objects[:1])
    mug = {"mug": layout.poses["mug"]}
    seen = msgspec.structs.replace(graph(mug), objects=sure)
    assert names(MEMORY.complete(seen, {"cup": before}, observation(mug))) == ["mug"]
