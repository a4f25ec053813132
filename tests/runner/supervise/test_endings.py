"""What a stage does at its end is let happen, within limits, and what goes wrong there is said."""

import re
import signal
import subprocess
from pathlib import Path

import pytest

from runner.recording.recording import Recording
from runner.testing import read_until
from tests.runner.common.runs import DOUBLES, Run, finish, processes_of, run, start
from tests.runner.common.waiting import wait_until


def graph_with(folder: Path, stage: str) -> Path:
    """The graph of doubles with another doubler."""
    path = folder / "doubles.yaml"
    text = DOUBLES.read_text().replace("tests.runner.common.toys:Doubler", f"tests.runner.common.endings:{stage}")
    path.write_text(text)
    return path


def run_with(folder: Path, stage: str, *settings: str) -> Run:
    return run(graph_with(folder, stage), folder, f"doubler.marks={folder}", *settings)


def interrupted(folder: Path, stage: str) -> Run:
    """A run that hears Ctrl-C in a step of the doubler."""
    process = start(graph_with(folder, stage), folder, f"doubler.marks={folder}")
    wait_until((folder / "moves").exists)
    process.send_signal(signal.SIGINT)
    return finish(process, folder)


@pytest.mark.slow
def test_an_exception_that_is_hard_to_tell_is_a_failure_like_any_other(tmp_path: Path):
    told = run_with(tmp_path, "Unspeakable")
    assert (told.code, told.result) == (0, ["0", "2", "4", "6", "8"]), told.output
    assert "doubler restarts (1 of 3): Speechless:  (" in told.output
    assert re.search(
        r"\(2 of 3\): ValueError: the folder is gone and this is its second line \(/.*endings.py", told.output
    )
    recording = Recording(told.recording)
    assert [step.outcome for step in recording.steps if step.stage == "doubler"].count("failed") == 2
    assert recording.verdict.complete


@pytest.mark.slow
def test_what_a_stage_has_started_works_until_the_stage_is_closed(tmp_path: Path):
    graph = graph_with(tmp_path, "Slow")
    graph.write_text(graph.read_text().replace("toys:DoubleSink", "endings:PatientSink"))
    ended = run(graph, tmp_path, f"doubler.marks={tmp_path}")
    assert (ended.code, (tmp_path / "worked").exists()) == (0, True), ended.output
    assert (tmp_path / "helper.txt").read_text() == "park\n"
    assert "the stages left behind, ended now: 1 x sleep 611" in ended.output
    assert processes_of(tmp_path) == []
    recording = Recording(ended.recording)
    assert recording.verdict.complete
    assert {step.outcome for step in recording.steps if step.stage == "doubler"} == {"done"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("way", "said"),
    [
        ("raise", "doubler died meanwhile: RuntimeError: the arm is not parked (tests/runner/common/endings.py:"),
        ("leave", "doubler died meanwhile: ended with exit code 3"),
        ("hang", "doubler is killed: not gone 10 s after its last step"),
    ],
)
def test_what_fails_while_a_stage_is_closed_is_said(tmp_path: Path, way: str, said: str):
    ended = run_with(tmp_path, "Closing", f"doubler.way={way}")
    assert ended.code == 0
    assert said in ended.output, ended.output
    assert Recording(ended.recording).verdict.complete


@pytest.mark.slow
def test_a_device_comes_to_rest_before_it_is_closed(tmp_path: Path):
    ended = interrupted(tmp_path, "Mover")
    assert (ended.code, (tmp_path / "rests").exists(), (tmp_path / "closed").exists()) == (130, True, True)
    assert "killed" not in ended.output, ended.output
    assert Recording(ended.recording).verdict.complete


@pytest.mark.slow
def test_a_step_that_is_cut_off_at_the_end_is_named(tmp_path: Path):
    ended = interrupted(tmp_path, "Stuck")
    assert ended.code == 130
    assert ended.output.count("doubler is killed: not at its end after 2 s") == 1, ended.output
    assert "died meanwhile" not in ended.output


@pytest.mark.slow
def test_what_fails_after_the_graph_has_ended_is_said(tmp_path: Path):
    ended = run_with(tmp_path, "TooLate")
    assert (ended.code, ended.output.splitlines()[-1]) == (0, "first")
    assert ended.output.count("doubler died meanwhile: ValueError: too late (tests/runner") == 1, ended.output


@pytest.mark.slow
def test_the_reason_is_not_what_a_process_happens_to_print_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TESTS_SAY_GOODBYE", "1")
    told = run_with(tmp_path, "Unspeakable")
    assert "doubler restarts (1 of 3): Speechless:  (" in told.output
    assert f"recording {told.recording}: COMPLETE" in told.output


@pytest.mark.slow
def test_an_interrupt_while_all_processes_start_leaves_a_complete_recording(tmp_path: Path):
    process: subprocess.Popen[str] = start(DOUBLES, tmp_path)
    before = read_until(process, "starts 3 processes")
    process.send_signal(signal.SIGINT)
    ended = finish(process, tmp_path, before)
    assert ended.code == 130
    verdict = Recording(ended.recording).verdict
    assert verdict.complete, verdict
