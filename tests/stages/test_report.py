"""The report: complete whatever the order of arrival, written beside the recording, with the right exit code."""

import random
import tempfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.contract import Finished, Restarted
from stages.messages import Candidates, Goal, SceneEstimate, SceneGraph, Snapshot, Verdict
from stages.report import Report
from tests.stages.episodes import CATALOGUE, K, Recorded, outcome, plan, transfer
from tests.stages.layouts import Layout

TRAY = Layout().put("tray", 0.0, 0.0).put("soup_can", 0.0, 0.2)
GOAL = Layout(dict(TRAY.poses)).put("cup", 0.0, 0.0, on="tray").graph()
START = Layout(dict(TRAY.poses)).put("cup", 0.0, 0.0, on="soup_can").graph()
STEP = transfer("cup", "soup_can", "tray")
Arrival = Callable[[Report, Recorded], Finished | None]


def truth(graph: SceneGraph, purpose: str, *, shift: float = 0.002) -> Snapshot:
    """The simulator's truth for a perceived scene that is ``shift`` metres off."""
    poses = np.stack([item.T_base_object for item in graph.objects])
    poses[:, 0, 3] += shift
    return Snapshot(
        names=tuple(item.name for item in graph.objects),
        T_base_objects=poses,
        joint_names=(),
        joint_positions=np.zeros(0),
        time=1.0,
        purpose=purpose,
    )


def look(time_ns: int, purpose: str, graph: SceneGraph, *, true: SceneGraph | None = None) -> Arrival:
    def arrive(report: Report, ctx: Recorded) -> Finished | None:
        ctx.time_ns = time_ns
        candidates = Candidates(candidates=(), labels=("cup",), confidences=np.zeros((0, 1)))
        estimate = SceneEstimate(
            objects=(),
            winner=0,
            log_weights=np.array([-1.0, -2.0]),
            left_out=3,
            T_camera_table=np.eye(4),
            T_base_camera=None,
            K=K,
        )
        return report.on_look(truth(true or graph, purpose), candidates, estimate, graph, ctx)

    return arrive


def verdict(*, success: bool) -> Verdict:
    final = GOAL.assertions
    return Verdict(
        goal_name="breakfast",
        success=success,
        failed_stage="" if success else "executor",
        reason="every relation holds" if success else "ik: no grasp of cup is reachable",
        satisfied=final if success else final[1:],
        violated=() if success else final[:1],
        looks=3,
        plans=1,
        transfers=1,
    )


def episode(*, success: bool = True, true: SceneGraph | None = None) -> list[Arrival]:
    """Everything that reaches the report, in causal order; in the end the ``true`` scene is the perceived one."""
    failure = {} if success else {"failed_stage": "ik", "reason": "no grasp of cup is reachable"}
    return [
        look(10, "goal", GOAL),
        lambda report, ctx: report.on_goal(Goal(name="breakfast", scene=GOAL, pddl="(define (problem goal))"), ctx),
        look(20, "start", START),
        lambda report, ctx: report.on_plan(plan(STEP), ctx),
        lambda report, ctx: report.on_outcome(outcome(1, STEP, **failure), ctx),
        look(30, "after transfer 1", GOAL if success else START, true=true),
        lambda report, ctx: report.on_verdict(verdict(success=success), ctx),
    ]


def run(arrivals: list[Arrival], directory: Path) -> tuple[list[Finished], Recorded]:
    report = Report(Report.Config(catalogue=CATALOGUE))
    ctx = Recorded(directory=directory)
    return [end for arrive in arrivals if (end := arrive(report, ctx)) is not None], ctx


def test_writes_goal_problem_plan_and_report(tmp_path: Path) -> None:
    (finished,), ctx = run(episode(), tmp_path)
    assert finished.code == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "domain.pddl", "goal-breakfast.pddl", "problem-01.pddl", "plan-01.txt", "report.txt", "report.md",
    }  # fmt: skip
    assert (tmp_path / "plan-01.txt").read_text() == "(pick cup soup_can)\n(place cup tray)\n"
    assert (tmp_path / "report.txt").read_text().strip() in ctx.lines[-1]


def test_a_failed_episode_exits_with_the_failing_stage(tmp_path: Path) -> None:
    (finished,), _ = run(episode(success=False), tmp_path)
    assert finished.code == 1
    assert "executor" in finished.reason and "no grasp of cup is reachable" in finished.reason
    assert "FAILED at ik" in (tmp_path / "report.txt").read_text()


def test_a_success_that_the_truth_denies_exits_with_what_does_not_hold(tmp_path: Path) -> None:
    (finished,), _ = run(episode(true=START), tmp_path)
    assert finished.code == 1
    assert "FALSE SUCCESS" in finished.reason and "in(cup, tray)" in finished.reason
    text = (tmp_path / "report.txt").read_text()
    assert "in(cup, tray) holds by perception and does not hold in truth" in text
    assert "objects lost or knocked over: 0, 0 of them unsaid" in text


@settings(max_examples=25)
@given(st.randoms(use_true_random=False), st.booleans())
def test_any_order_of_arrival_gives_the_same_report_once(shuffle: random.Random, success: bool) -> None:
    arrivals = episode(success=success)
    shuffle.shuffle(arrivals)
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
        (finished,), _ = run(arrivals, Path(first))
        (expected,), _ = run(episode(success=success), Path(second))
        assert finished == expected
        assert (Path(first) / "report.txt").read_text() == (Path(second) / "report.txt").read_text()


@pytest.mark.parametrize("missing", range(7))
def test_waits_for_everything_behind_the_verdict(missing: int, tmp_path: Path) -> None:
    arrivals = episode()
    del arrivals[missing]
    finished, _ = run(arrivals, tmp_path)
    assert finished == []


def test_a_verdict_of_no_relations_ends_an_episode_of_which_a_goal_is_there(tmp_path: Path) -> None:
    """Somebody stopped it before its scene was looked at."""
    stopped = msgspec.structs.replace(verdict(success=False), satisfied=(), violated=(), looks=1, plans=0, transfers=0)
    arrivals = [*episode()[:2], lambda report, ctx: report.on_verdict(stopped, ctx)]
    (finished,), _ = run(arrivals, tmp_path)
    assert finished.code == 1


def test_shows_scenes_scores_and_restarts(tmp_path: Path) -> None:
    def crash(report: Report, ctx: Recorded) -> Finished | None:
        report.on_restarted(Restarted(stage="particle_filter", replica=1, reason="killed by signal 9"), ctx)

    run([crash, *episode()], tmp_path)
    text = (tmp_path / "report.txt").read_text()
    for expected in ("└─ in cup", "soup_can beside tray", "3 of 3", "2.0 (2.0) mm", "particle_filter 1 (killed by"):
        assert expected in text
    assert max(len(line) for line in text.splitlines()) <= 100
