"""The paper's experiments: their graph is one, their perception finds the scene, and tables say what came of it."""

from pathlib import Path

import pytest
import yaml

from benchmarks.robot.episodes import Episode
from benchmarks.robot.paper.__main__ import EXPERIMENTS, Experiment, failures, table, with_features
from runner.graph.reading import load_graph
from stages.devices.suites.tray import GOALS
from stages.messages import Assertion
from stages.scene.truth import Judgement


@pytest.mark.parametrize("experiment", EXPERIMENTS, ids=lambda one: one.title)
def test_goals_are_those_of_the_suite(experiment: Experiment) -> None:
    assert experiment.paper == experiment.episodes and set(experiment.goals) <= set(GOALS)


def test_the_proof_of_concept_is_the_main_job_without_digest(tmp_path: Path) -> None:
    graph = load_graph(with_features(tmp_path / "proof.yaml"), EXPERIMENTS[0].settings("lunch"))
    assert {"features", "world", "planner", "executor", "report"} <= set(graph.nodes)
    assert not set(graph.nodes) & {"hypotheses", "particle_filter", "ranker", "refiner"}
    written = yaml.safe_load((tmp_path / "proof.yaml").read_text())["stages"]
    assert written["features"]["inputs"] == {"frame": "corrector.frame", "candidates": "detector.candidates"}


def episode(*, restored: bool, claimed: bool) -> Episode:
    judgement = Judgement(claimed=claimed, held=(Assertion(predicate="exist", arguments=("cup",)),) if restored else ())
    return Episode(0, int(not claimed), 20.0, None, judgement, (), True, "not seen: cup", Path("a.mcap"))


def test_the_table_counts_by_truth_and_failures_by_stage() -> None:
    good, bad = (episode(restored=each, claimed=each) for each in (True, False))
    line = table([(EXPERIMENTS[0], [good] * 7 + [bad])]).splitlines()[-1]
    assert "| 2 | 4 | 0 | 8 of 8 | 7 of 8 | 0 |" in line
    assert failures([good.summary()]) == "All of 1 episodes were restored."
    assert failures([good.summary(), bad.summary()]).splitlines()[-1] == "| runner | 1 of 2 | not seen: cup |"
