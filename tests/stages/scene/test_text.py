"""Scene graphs and episodes as text."""

import msgspec
import numpy as np

from stages.messages import SceneEstimate, Verdict
from stages.messages.scene import UnknownRegion
from stages.scene.episode import Episode, plain, table
from stages.scene.text import certainty, support, tree
from stages.scene.truth import Judgement
from tests.stages.episodes import scene
from tests.stages.layouts import Layout

SCENE = scene(
    {"tray": "table", "bowl": "tray", "soup_can": "bowl", "mug": "tray", "tea_box": "table"}, beside={"mug": "bowl"}
)


def test_a_tree_shows_what_is_on_in_and_beside_what() -> None:
    assert tree(SCENE) == [
        "table",
        "├─ tray",
        "│  ├─ in bowl",
        "│  │  └─ in soup_can",
        "│  └─ in mug beside bowl",
        "└─ tea_box",
    ]


def test_an_empty_scene_is_a_table() -> None:
    assert tree(scene({})) == ["table"]


def test_support_tells_on_from_in_and_ignores_regions() -> None:
    assert support(SCENE)["mug"] == ("tray", "in")
    assert support(SCENE)["tea_box"] == ("table", "on")


def judged(**changes: object) -> SceneEstimate:
    estimate = Layout().put("mug", 0.0, 0.0).put("tea_box", 0.2, 0.0).estimate()
    chances = {"mug": 0.71, "tea_box": 0.98}
    objects = tuple(msgspec.structs.replace(item, probability=chances[item.name]) for item in estimate.objects)
    return msgspec.structs.replace(estimate, **({"objects": objects, "probabilities": np.ones(1)} | changes))


def test_certainty_names_the_least_sure_object() -> None:
    assert certainty(judged()) == "sure of 1 of 2 objects; least sure: mug 0.71"


def test_certainty_counts_what_is_unknown_and_names_what_is_contradicted() -> None:
    region = UnknownRegion(box=np.zeros(4), points=1, centre_table=np.zeros(3), extent_table=np.zeros(3))
    floating = tuple(msgspec.structs.replace(item, contradicted=True) for item in judged().objects[:1])
    text = certainty(judged(objects=floating, unknown=(region,)))
    assert text == "sure of 0 of 1 objects; least sure: mug 0.71; contradicted: mug; unknown: 1"


def test_a_scene_that_was_not_judged_has_no_certainty() -> None:
    assert certainty(Layout().put("mug", 0.0, 0.0).estimate()) == ""


def test_tables_align_numbers_to_the_right() -> None:
    assert table(["name", "n"], [["a", "5"], ["long name", "12"]], right=(1,)) == [
        "name        n",
        "a           5",
        "long name  12",
    ]


def test_an_episode_that_saw_nothing_still_reads() -> None:
    verdict = Verdict(
        goal_name="breakfast",
        success=False,
        failed_stage="perception",
        reason="4 of 6 objects seen " * 8,
        satisfied=(),
        violated=(),
    )
    text = plain(Episode(verdict=verdict, looks=(), plans=(), outcomes=(), judgement=Judgement(claimed=False)))
    for expected in ("NOT restored. perception:", "not perceived", "none was needed", "nothing was moved"):
        assert expected in text
    assert max(map(len, text.splitlines())) <= 100
