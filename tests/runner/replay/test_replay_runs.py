"""Recordings of real runs, replayed to the byte: replicas, a killed one, a loaded machine, again and again."""

from pathlib import Path

import pytest

from benchmarks.runner.replays import busy, replay_once
from tests.runner.common.runs import DOUBLES, TOYS, Run, changed, run
from tests.runner.replay.test_replay import replay, verify


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run in which the replica that works on the third number is killed."""
    return run(TOYS, tmp_path_factory.mktemp("killed"), "worker.replicas=3", "worker.die_at=2", "counter.period=0.3")


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run(TOYS, tmp_path_factory.mktemp("alone"), "worker.replicas=1")


def survivor(run: Run) -> Path:
    """Its recording; the stage must not die again, in whichever process it is replayed."""
    assert run.code == 0, run.output
    return run.recording


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_a_run_with_a_killed_replica_replays_to_the_byte(killed: Run, workers: int):
    path = survivor(killed)
    assert "restarts (1 of 3)" in killed.output
    code, said = verify(path, "worker.die_at=-1", workers=workers)
    assert code == 0, said
    assert "IDENTICAL: 45 messages of 4 stages" in said


def test_without_replicas_and_under_load_it_replays_to_the_byte(alone: Run):
    with busy(4):
        code, said = verify(survivor(alone), workers=3)
    assert code == 0, said
    assert "IDENTICAL: 45 messages" in said


@pytest.mark.parametrize("way", ["quit", "interrupt"])
def test_a_handler_that_leaves_the_process_leaves_it_again(tmp_path: Path, way: str):
    graph = changed(DOUBLES, tmp_path, Doubler="Quitter")
    left = run(graph, tmp_path, f"doubler.way={way}", "doubler.each=true", "doubler.restarts=1")
    assert left.code == 1, left.output
    code, said = verify(left.recording)
    assert code == 0, said
    assert "IDENTICAL: 2 messages of 1 stages" in said


def test_another_number_of_replicas_changes_nothing(killed: Run):
    """What three replicas did, one of them killed, is what one does, gathered in the order of the look."""
    code, said = replay(survivor(killed), "--set", "worker.replicas=1", "--set", "worker.die_at=-1")
    assert code == 0, said
    assert said.splitlines()[-1].startswith("NOTHING CHANGES: 25 identical")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_twenty_of_twenty_replays_under_load_are_identical(killed: Run):
    path = survivor(killed)
    with busy(4):
        outcomes = [replay_once(path, settings=("worker.die_at=-1",)) for _ in range(20)]
    assert [outcome.identical for outcome in outcomes] == [True] * 20, outcomes
    assert {outcome.messages for outcome in outcomes} == {45}
