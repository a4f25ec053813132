"""How episodes are told: a row, an object of JSON, and what is counted over all."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.robot import episodes
from benchmarks.robot.episodes import HEADER, Episode, main, row, totals
from stages.messages import Assertion, Goal, Snapshot, Verdict
from stages.scene.truth import Judgement, Loss
from tests.stages.episodes import outcome, transfer
from tests.stages.layouts import Layout
from tests.stages.scene.test_truth import snapshot

HELD, BROKEN = (Assertion(predicate="on", arguments=(name, "table")) for name in ("cup", "mug"))


def episode(*, claimed: bool, true: bool) -> Episode:
    verdict = Verdict(
        goal_name="tea", success=claimed, failed_stage="" if claimed else "planner", reason="", satisfied=(HELD,),
        violated=() if claimed else (BROKEN,), looks=3,
    )  # fmt: skip
    losses = () if true else (Loss("mug", "left the table", said=False),)
    judgement = Judgement(claimed, (HELD,), () if true else (BROKEN,), (), losses, (HELD,))
    done = (outcome(1, transfer("mug", "tray", "table")),)
    code = 0 if claimed and true else 1
    return Episode(7, code, 31.234, verdict, judgement, done, True, "why | not", Path("tray.mcap"))


def test_a_summary_says_what_was_claimed_and_what_is_true() -> None:
    found = episode(claimed=True, true=False).summary()
    expected = {
        "seed": 7, "restored_by_truth": False, "restored_as_claimed": True, "false_success": True, "objects_lost": 1,
        "objects_lost_unsaid": 1, "transfers": 1, "relations_regained": 1, "robot_seconds": 12.25,
        "wall_seconds": 31.23, "failing_stage": "perception", "reason": "why | not",
    }  # fmt: skip
    assert expected.items() <= found.items()


def test_a_refusal_is_one_where_nothing_moved() -> None:
    refused = replace(episode(claimed=False, true=False), outcomes=())
    assert refused.refused and not episode(claimed=False, true=False).refused
    assert not replace(episode(claimed=True, true=True), outcomes=()).refused


def test_a_failure_names_the_stage_of_the_verdict_and_a_success_none() -> None:
    assert episode(claimed=False, true=True).summary()["failing_stage"] == "planner"
    good = episode(claimed=True, true=True).summary()
    assert (good["failing_stage"], good["reason"], good["restored_by_truth"]) == ("", "", True)


def test_rows_fit_their_header_and_all_is_counted() -> None:
    bad = episode(claimed=False, true=False)
    assert "| 7 | 1 | 1 of 2 | 1 of 2 | 1 | 1 of 1 | 3 | 31 s | COMPLETE |" in row(bad)
    assert row(episode(claimed=True, true=True)).count("|") == HEADER.splitlines()[0].count("|")
    assert totals([bad, episode(claimed=True, true=False), episode(claimed=True, true=True)]) == (
        "1 of 3 restored, 0 refused before anything moved; "
        "in truth 1, false successes 1, objects lost 2, 2 of them unsaid; "
        "12.2 robot seconds and 31.2 wall seconds per relation regained"
    )


def test_what_was_lost_is_counted_where_a_run_was_killed_before_its_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = Layout().put("sugar_box", 0.0, 0.0)
    lies = Layout().put("sugar_box", 0.0, 0.0, resting=1)
    looks = [snapshot(one, purpose) for one, purpose in ((shown, "goal"), (shown, "start"), (lies, "after transfer 1"))]
    said = {Snapshot: looks, Goal: [Goal(name="tea", scene=shown.graph(), pddl="")]}
    monkeypatch.setattr(episodes, "Recording", lambda path: SimpleNamespace(verdict=SimpleNamespace(complete=False)))
    monkeypatch.setattr(episodes, "messages", lambda _, kind: iter(said.get(kind, ())))
    found = episodes.judged(Path("killed.mcap"), seed=7, code=-9, seconds=1.0, reason="killed").summary()
    assert (found["objects_lost"], found["restored_by_truth"], found["end_seen"]) == (1, False, False)


def test_an_unknown_suite_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--suite", "nowhere", "1"])
    assert "choose from 'tray'" in capsys.readouterr().err
