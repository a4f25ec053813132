"""What a stranger types wrong at each command is refused in one line that says what is valid."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from runner.cli.main import main
from runner.contract import Refused, Stage
from runner.graph.placement import Host
from runner.graph.reading import load_graph
from runner.hosts.keys import make_keys
from runner.live.tables import commands_text
from runner.supervise.calls import CommandType
from tests.runner.common.recordings import record_toys
from tests.runner.common.runs import TOYS

GRAPH = [str(TOYS), "--set", "sink.path=out.txt", "--set"]


class Moody(Stage):
    """Has settings that take words inside lists, and beside numbers."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        moods: tuple[Literal["glad", "grim"], ...] = ()
        pause: float | Literal["auto"] = "auto"

    def __init__(self, config: Config) -> None: ...

    def on_start(self) -> None: ...


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_toys(tmp_path_factory.mktemp("toys"), "view=tests.runner.common.toy_views:ToyViews")[0]


@pytest.fixture(autouse=True)
def no_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "runtime").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (
            ["check", *GRAPH, "worker.memory=2gb"],
            "memory: '2gb' does not fit (What a process may hold, for example 2GB)",
        ),
        (
            ["check", *GRAPH, "worker.heartbeat=0"],
            "heartbeat: Expected `float` > 0.0, got 0 (Seconds without a sign of",
        ),
        (["check", *GRAPH, "worker.replicas=many"], "replicas: Invalid enum value 'many'; valid: auto, a number (Proc"),
        (["check", *GRAPH, "name=a/b"], "--set name: 'a/b' does not fit (Letters, digits, _ and -: "),
        (["check", *GRAPH, "view=tests.runner.common.toy_views:ToyVews"], ": view: no class 'ToyVews' in"),
        (["check", *GRAPH, "score=toys"], "--set score: 'toys' does not fit (module:Class)"),
        (["doctor", "--recordings", __file__], f"recordings     {__file__} is no folder that can be written"),
        (["up", str(TOYS), "--arm"], "toys.yaml: --arm: no stage has the setting 'armed'"),
        (["logs", "--run", "toys", "--recordings", "."], "runner logs: --run NAME or --recordings DIR, not both"),
        (["page", "--port", "99999"], "argument --port: '99999': must be 0 to 65535"),
        (["call", "account", "add", "amount=1", "amount=2"], "amount=2: amount is given twice"),
        (["check", "a\udcff.yaml"], "'a\\udcff.yaml': is not UTF-8"),
        (["check", *GRAPH, "worker.seconds=\udcff"], "'worker.seconds=\\udcff': is not UTF-8"),
        (["logs", "--recordings", "a\udcff"], "'a\\udcff': is not UTF-8"),
        (["call", "account", "add", "note=\udcff"], "'note=\\udcff': is not UTF-8"),
        (["restart", "\udcff"], "'\\udcff': is not UTF-8"),
        (["check", *GRAPH, "view=!!timestamp 1"], "--set view: '!!timestamp 1' does not fit (module:Class)"),
        (["check", *GRAPH, "stages={1: 2}"], "--set stages: a stage's name is lower case letters"),
        (["check", *GRAPH, "stages=.nan", "--set", "worker.host=a"], "--set worker.host: no stage 'worker'"),
        (["check", *GRAPH, 'worker.seconds="\\ud800"'], "--set worker.seconds: Expected `float`, got "),
        (
            ["check", *GRAPH, f"view={__name__}:Moody"],
            f"view: {__name__}:Moody has no layout, static, draw; valid: a",
        ),
        (
            ["check", *GRAPH, f"story={__name__}:Moody"],
            f"story: {__name__}:Moody has no hear, recall, tell, say; ",
        ),
        (["check", *GRAPH, f"score={__name__}:Moody"], f"score: {__name__}:Moody has no score; valid: a class with sc"),
        (["check", *GRAPH, "migrations=..:x"], "--set migrations: no module '..'"),
        (["check", *GRAPH, "migrations=:x"], "--set migrations: no module ''"),
    ],
)
def test_it_is_said_in_one_line(typed: list[str], said: str, capsys: pytest.CaptureFixture[str]):
    code = status(typed)
    captured = capsys.readouterr()
    assert code in (1, 2)
    assert said in captured.out + captured.err


@pytest.mark.parametrize("stage", ["/home/somebody/toys.mcap", "**", "a[b"])
def test_the_log_of_no_stage(toys: Path, stage: str, capsys: pytest.CaptureFixture[str]):
    assert status(["logs", stage, "--recordings", str(toys.parent)]) == 2
    assert f"no stage {stage!r}; valid: counter, gatherer, recorder, sink, " in capsys.readouterr().err


def test_a_stage_that_has_said_nothing_has_an_empty_log(toys: Path, capsys: pytest.CaptureFixture[str]):
    assert status(["logs", "counter", "--recordings", str(toys.parent)]) == 0
    assert capsys.readouterr() == ("", "")


def test_a_message_that_is_not_there_has_neighbours(toys: Path, capsys: pytest.CaptureFixture[str]):
    assert status(["why", "counter.number#99", str(toys)]) == 2
    near = "counter.number#2, counter.number#3, counter.number#4 (of counter.number#0 to #4)"
    assert capsys.readouterr().err == f"{toys}: no message 'counter.number#99'; the nearest: {near}\n"


def test_a_viewer_is_not_opened_for_nothing(toys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert status(["view", "nothing.mcap", "--live"]) == 2
    assert "nothing.mcap: no such file" in capsys.readouterr().err
    for option, suffix in (("--save", ".rrd"), ("--png", ".png")):
        assert status(["view", str(toys), option, str(toys)]) == 2
        assert capsys.readouterr().err == f"{option} {toys}: must end in {suffix}\n"
    assert status(["view", "--live", "--png", "toys.png"]) == 2
    assert "--png shows a graph that has ended" in capsys.readouterr().err
    (tmp_path / "toys.rrd").touch()
    assert status(["view", str(toys), "--save", str(tmp_path / "toys.rrd")]) == 2
    assert "toys.rrd: cannot be written: File exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("moods=[grim, gay]", "moody.moods: Invalid enum value 'gay'; valid: glad, grim$"),
        ("pause=soon", "moody.pause: Invalid enum value 'soon'; valid: auto, a number$"),
    ],
)
def test_the_words_that_a_setting_takes(tmp_path: Path, setting: str, said: str):
    graph = tmp_path / "graph.yaml"
    graph.write_text(f"name: moody\nstages: {{moody: {{stage: {__name__}:Moody}}}}\n")
    with pytest.raises(Refused, match=said):
        load_graph(graph, (f"moody.{setting}",))


@pytest.mark.parametrize("names", [("a", "a"), ("a", "reader")])
def test_keys_have_one_owner_each(tmp_path: Path, names: tuple[str, ...]):
    with pytest.raises(Refused, match=f"{names[1]}: is named twice"):
        make_keys(tmp_path / "keys", [Host(name, "10.0.0.1") for name in names])
    assert not (tmp_path / "keys").exists()


def test_a_stage_without_a_name_has_no_commands():
    add = CommandType("account", "add", "", (), ())
    with pytest.raises(Refused, match="'' has no commands; valid: account"):
        commands_text([add], "")


def status(typed: list[str]) -> int:
    try:
        return main(typed)
    except SystemExit as end:  # argparse's
        return int(str(end.code))
