"""Real runs of stages that do what they had better not: each replays as what it was."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from runner.cli.main import main
from runner.contract import Context, Refused, Stage
from runner.recording.recording import Recording
from tests.runner.common.runs import DOUBLES, run
from tests.runner.common.toys import Double, Number
from tests.runner.common.waiting import wait_until
from tests.runner.replay.test_replay import replay, verify


class Failing(Stage):
    """Fails at the third number, of which it has said something."""

    def on_number(self, number: Number) -> Iterator[Double]:
        yield Double(value=2 * number.value)
        if number.value == 2:
            raise ValueError("no more")


class Killed(Failing):
    """The same, and its process with it."""

    def on_number(self, number: Number) -> Iterator[Double]:
        yield Double(value=2 * number.value)
        if number.value == 2:
            time.sleep(1)  # until the recorder has that
            os.kill(os.getpid(), signal.SIGKILL)


class Mended(Stage):
    def on_number(self, number: Number) -> Double:
        return Double(value=2 * number.value)


class Unclosed(Mended):
    def close(self) -> None:
        raise ValueError("cannot be closed")


class Endless(Mended):
    def close(self) -> None:
        print("closes", flush=True)
        time.sleep(600)


class Leftover(Mended):
    """Leaves a file to be removed at its end."""

    def __init__(self) -> None:
        Path(os.environ["LEFTOVER"]).touch()

    def close(self) -> None:
        Path(os.environ["LEFTOVER"]).unlink()


class OtherBytes(Stage):
    """Refuses a file whose name is not UTF-8."""

    def on_number(self, number: Number) -> Double:
        if number.value == 2:
            raise Refused(os.fsdecode(b"d\xffd.png"))
        return Double(value=2 * number.value)


class Logs(Stage):
    """Logs what is no text."""

    def on_number(self, number: Number, ctx: Context) -> Double:
        ctx.log(cast("Any", ValueError("no text")))
        return Double(value=2 * number.value)


def recorded(stage: str, folder: Path, *settings: str) -> Path:
    """What a run of the doubling graph with this stage in the middle records."""
    graph = folder / "graph.yaml"
    graph.write_text(DOUBLES.read_text().replace("tests.runner.common.toys:Doubler", f"{__name__}:{stage}"))
    done = run(graph, folder, *settings)
    assert Recording(done.recording).verdict.complete, done.output
    return done.recording


@pytest.mark.parametrize("restarts", [0, 1])
@pytest.mark.parametrize("stage", ["Failing", "Killed"])
def test_a_run_that_a_stage_ended_is_the_same_again(tmp_path: Path, stage: str, restarts: int):
    path = recorded(stage, tmp_path, f"doubler.restarts={restarts}")
    code, said = replay(path, "--from", "doubler")
    assert code == 0, said
    assert said.splitlines()[-1] == f"NOTHING CHANGES: {3 if stage == 'Failing' else 2} identical, of 1 stages"


def test_a_mended_stage_goes_on_where_the_recorded_one_failed(tmp_path: Path):
    path = recorded("Failing", tmp_path, "doubler.restarts=0")
    code, said = replay(path, "--swap", f"doubler={__name__}:Mended")
    assert code == 0, said
    assert "3 identical" in said and "appeared: doubler.double#3, doubler.double#4" in said


@pytest.mark.parametrize("stage", ["Unclosed", "Endless"])
def test_how_a_stage_closes_does_not_matter(tmp_path: Path, stage: str):
    code, said = verify(recorded(stage, tmp_path))
    assert code == 0, said
    assert "IDENTICAL: 5 messages of 1 stages" in said


def test_a_refusal_with_other_bytes_is_the_same_again(tmp_path: Path):
    path = recorded("OtherBytes", tmp_path)
    for way in (("--verify",), ("--from", "doubler")):
        code, said = replay(path, *way)
        assert code == 0, said


def test_what_is_no_text_is_not_logged_in_a_replay_either(tmp_path: Path):
    path = recorded("Logs", tmp_path, "doubler.restarts=0")
    errors = [step.error for step in Recording(path).steps if step.outcome == "failed"]
    assert [error.partition(" (")[0] for error in errors] == ["BrokenContract: logged a ValueError; valid: a text"]
    code, said = replay(path, "--from", "doubler")
    assert code == 0, said


def test_stages_to_which_one_travelled_are_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    left = tmp_path / "left"
    monkeypatch.setenv("LEFTOVER", str(left))
    path = recorded("Leftover", tmp_path)
    code, said = replay(path, "--until", "doubler.double#2")
    assert code == 0, said
    assert not left.exists()


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("way", [("--verify",), ("--from", "doubler")])
def test_a_replay_that_is_ended_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, signum: signal.Signals, way: tuple[str, ...]
):
    path, temporary = recorded("Endless", tmp_path), tmp_path / "tmp"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    heard = "import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_DFL); os.execv(sys.argv[1], sys.argv[1:])"
    command = (sys.executable, "-c", heard, sys.executable, "-m", "runner.cli", "replay", str(path), *way)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        wait_until(lambda: any(log.read_text() for log in temporary.glob("*/*.txt")))
        process.send_signal(signum)
    assert process.returncode == 128 + signum
    assert list(temporary.iterdir()) == []


def test_a_module_that_ends_the_program_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    (tmp_path / "script_without_guard.py").write_text("import sys\nsys.exit(0)\n")
    monkeypatch.chdir(tmp_path)
    graph = tmp_path / "graph.yaml"
    graph.write_text("name: script\nstages:\n  one: {stage: script_without_guard:Stage}\n")
    assert main(["check", str(graph)]) == 2
    said = "stages.one.stage: script_without_guard cannot be imported: it calls sys.exit(0)"
    assert said in capfd.readouterr().err
