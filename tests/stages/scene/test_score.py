import numpy as np
import pytest

from stages.messages import Goal, SceneGraph, Snapshot
from stages.scene.score import Score
from tests.stages.episodes import CATALOGUE, scene

GOAL = scene({"tray": "table", "cup": "tray", "soup_can": "table"})
START = scene({"tray": "table", "soup_can": "table", "cup": "soup_can"})
REMEMBERED = Goal(name="breakfast", scene=GOAL, pddl="")


def truth(graph: SceneGraph, shift: float) -> Snapshot:
    poses = np.stack([item.T_base_object for item in graph.objects])
    poses[:, 0, 3] += shift
    names = tuple(item.name for item in graph.objects)
    return Snapshot(names=names, T_base_objects=poses, joint_names=(), joint_positions=np.zeros(0), time=1.0)


def score() -> Score:
    return Score({"camera": {}, "scene_graph": {"catalogue": CATALOGUE}})


def test_scores_the_poses_of_each_look_and_the_relations_of_the_last():
    found = score().score([("a#0", truth(GOAL, 0.002)), ("a#0", GOAL), ("a#0", REMEMBERED), ("a#1", GOAL)])
    assert found["relations satisfied"] == found["relations of the goal"] == len(GOAL.assertions)
    assert found["looks scored"] == 1
    assert found["objects found"] == found["objects there"] == 3
    assert found["position error, mm, median"] == pytest.approx(2.0)
    assert found["rotation error, degrees, worst"] == pytest.approx(0.0, abs=1e-3)


def test_a_scene_that_is_not_the_goal_satisfies_less():
    found = score().score([("a#0", GOAL), ("a#0", REMEMBERED), ("a#1", START)])
    assert found["relations satisfied"] < found["relations of the goal"]
    assert "looks scored" not in found


def test_there_may_be_nothing_to_score():
    assert score().score([]) == {}
