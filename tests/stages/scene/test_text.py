"""Scene graphs and episodes as text."""

from stages.messages import Verdict
from stages.scene.episode import Episode, plain, table
from stages.scene.text import support, tree
from tests.stages.episodes import scene

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
    text = plain(Episode(verdict=verdict, looks=(), plans=(), outcomes=()))
    for expected in ("NOT restored. perception:", "not perceived", "none was needed", "nothing was moved"):
        assert expected in text
    assert max(map(len, text.splitlines())) <= 100
