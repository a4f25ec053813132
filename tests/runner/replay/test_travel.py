"""Stops within recordings, as a user types it."""

import io
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from runner.cli.main import main
from runner.process.forks import clean_environment
from tests.runner.common.recordings import record_toys


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_toys(tmp_path_factory.mktemp("toys"))[0]


@pytest.fixture(autouse=True)
def one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is forked here: this process will do."""
    for name, value in clean_environment().items():
        monkeypatch.setenv(name, value)


Typed = Callable[..., tuple[int, str]]


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Typed:
    """The exit status and all that ``runner replay`` says to somebody who types ``lines``."""

    def run(path: Path, *arguments: str, lines: str = "") -> tuple[int, str]:
        monkeypatch.setattr(sys, "stdin", io.StringIO(lines))
        code = main(["replay", str(path), *arguments])
        printed = capsys.readouterr()
        return code, printed.out + printed.err

    return run


def test_stops_at_a_message_and_shows_it_with_its_causes(toys: Path, typed: Typed):
    code, said = typed(toys, "--until", "gatherer.total#2")
    assert code == 0, said
    lines = [line.strip() for line in said.splitlines()]
    assert lines[0] == "gatherer.total#2  Total, of counter.number#2"
    assert lines[1] == "step 2 of gatherer[0], on_answers"
    assert lines[2] == "executed again: identical to the recording"
    assert lines[3].startswith("samples = float64 (12) [")
    assert "last = False" in lines
    assert "number   counter.number#2  Number" in lines


def test_stops_inside_a_handler_that_goes_on(toys: Path, typed: Typed):
    show = "print(message.index, arrivals['number'].value)\n"
    _, said = typed(toys, "--until", "splitter.piece#6", "--prompt", lines=show)
    assert ">>> 2 1" in said


def test_a_message_of_a_device_is_shown_as_recorded(toys: Path, typed: Typed):
    code, said = typed(toys, "--until", "counter.number#3")
    assert code == 0
    assert "taken from the recording: a device" in said
    assert "value = 3" in said


def test_a_changed_stage_is_stopped_at_the_same_message(toys: Path, typed: Typed):
    _, said = typed(toys, "--until", "splitter.piece#1", "--set", "splitter.parts=3")
    assert "executed again: 1 fields differ from the recording" in said
    assert "count: recorded 4, replayed 3" in said
    _, said = typed(toys, "--until", "splitter.piece#3", "--set", "splitter.parts=3")
    assert "recorded, and not emitted in the replay" in said


def test_a_message_of_another_step_is_shown_with_that_step(toys: Path, typed: Typed):
    _, said = typed(toys, "--until", "splitter.piece#4", "--set", "splitter.parts=5")
    lines = [line.strip() for line in said.splitlines()]
    assert lines[:3] == [
        "splitter.piece#4  Piece, of counter.number#0",
        "step 0 of splitter[0], on_number",
        "recorded in another: step 1 of splitter[0], on_number",
    ]
    assert lines[-2:] == ["causes", "number  counter.number#0  Number"]


def test_breaks_where_a_condition_first_holds_and_opens_a_prompt_with_the_state(toys: Path, typed: Typed):
    condition = "counter.number.value == 3 and worker.answer.index == 1"
    show = "print(type(stage).__name__, message.index)\nexit()\n"
    _, said = typed(toys, "--break", condition, "--prompt", lines=show)
    assert said.startswith("worker.answer#13  Answer, of counter.number#3")
    assert ">>> Worker 1" in said


def test_a_condition_that_never_holds_says_so(toys: Path, typed: Typed):
    code, said = typed(toys, "--break", "counter.number.value > 99")
    assert code == 1
    assert "holds for no message" in said


def test_steps_from_message_to_message(toys: Path, typed: Typed):
    _, said = typed(toys, "--step", "--until", "counter.number#4", lines="\np\nprint(message.count)\n")
    assert said.startswith("counter.number#4")
    assert said.count("[Enter] next message") == 3
    assert "splitter.piece#0" in said
    assert ">>> 4" in said


def test_a_setting_of_a_device_is_no_obstacle(toys: Path, typed: Typed):
    code, said = typed(toys, "--until", "worker.answer#3", "--set", "counter.period=1")
    assert code == 0, said


@pytest.mark.parametrize("arguments", [["--step"], ["--until", "a.b#1"], ["--break", "counter.number.last"]])
def test_without_messages_there_is_none_to_stop_at(tmp_path: Path, typed: Typed, arguments: list[str]):
    empty, _ = record_toys(tmp_path, keep=lambda _: None)
    assert typed(empty, *arguments) == (2, f"{empty}: holds no messages: there is none to stop at\n")


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["--until", "gatherer.total#9"], "the nearest: gatherer.total#2, gatherer.total#3, gatherer.total#4"),
        (["--until", "gatherer.totl#1"], "no message 'gatherer.totl#1'; did you mean 'gatherer.total'"),
        (["--break", "gatherer.totl.last"], "gatherer has no output 'totl'; did you mean 'total'? valid: total"),
        (["--break", "gatherer.total.lst"], "Total has no field 'lst'; did you mean 'last'? valid: last, samples"),
        (["--break", "gatherer.total.last >"], "is no expression of Python: invalid syntax"),
        (["--until", ""], "no message ''; valid: counter.number, gatherer.total"),
        (["--break", ""], "--break '': is no expression of Python"),
        (["--until", "a.b#1", "--break", ""], "--until and --break each say where to stop; give one"),
        (["--until", "a.b#1", "--break", "x"], "--until and --break each say where to stop; give one"),
        (["--until", "gatherer.total#1", "--from", "nonsense"], "valid with them: --set and --swap, not --from"),
        (["--until", "a.b#1", "--verify"], "--verify goes through the whole recording"),
    ],
)
def test_what_does_not_exist_is_refused_with_what_does(toys: Path, typed: Typed, arguments: list[str], error: str):
    code, said = typed(toys, *arguments)
    assert code == 2
    assert error in said
