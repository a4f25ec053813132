"""Graph files are checked to the last key, each mistake in one line with its place and the valid choices."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml

from runner.cli.main import main
from runner.contract import Refused, Stage
from runner.graph.graph import Graph, graph_to_json, mermaid
from runner.graph.ports import inspect_stage
from runner.graph.reading import graph_from_json, graph_schema, load_graph
from tests.runner.common.runs import ACCOUNT, TOYS
from tests.runner.common.toys import Add, Answer, Collect, Counter, Number, Piece, Splitter

ROOT = Path(__file__).parents[3]
OUT = "sink.path=out.txt"


def load(folder: Path, *settings: str, old: str = "", new: str = "") -> Graph:
    text = TOYS.read_text()
    assert old in text
    path = folder / "graph.yaml"
    path.write_text(text.replace(old, new) if old else text)
    return load_graph(path, settings)


def test_a_good_graph_loads(tmp_path: Path):
    graph = load(tmp_path, OUT)
    assert graph.processes().count(("worker", 1)) == 1
    assert graph.nodes["worker"].inputs["number"].queue == 8
    assert graph.nodes["worker"].shares("piece")
    assert not graph.nodes["worker"].shares("number")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("replicas: 2", "replica: 2", ":11: stages.worker.replica: unknown key 'replica'; did you mean 'replicas'"),
        ("seed: 7", "sed: 7", ":2: sed: unknown key 'sed'; did you mean 'seed'"),
        ("seed: 7", "seed: [", ":4: not YAML"),
        ("seed: 7", "seed: 2026-13-45", ":2: seed: month must be in"),
        ("seed: 7", "2026-13-45: 7", ":2: graph: month must be in"),
        ("seed: 7", "view: !!timestamp 1", ":2: view: '1' is no timestamp"),
        ("seed: 7", "page: !!bool x", ":2: page: 'x' is no bool"),
        ("seed: 7", 'view: "\\ud800"', ":2: view: 'utf-8' codec can't encode character"),
        ("seed: 7", "seed: !wheat 7", ":2: not YAML: .*!wheat"),
        ("seed: 7", "seed: &self {seed: *self}", ": not YAML: a mapping contains itself"),
        ("seed: 7", "name: again", ":2: name: this key appears twice"),
        ("seed: 7", "seed: many", ":2: seed: Expected `int`, got 'many'"),
        ("toys:Sink", "toys:Snk", ":19: stages.sink.stage: no class 'Snk' in .*; did you mean 'Sink'"),
        ("toys:Sink", "toyz:Sink", ":19: stages.sink.stage: no module 'tests.runner.common.toyz'; did"),
        (
            "tests.runner.common.toys:Sink",
            "hello:Sink",
            r":19: stages.sink.stage: no module 'hello': hello is neither in /\S+ nor installed; run",
        ),
        ("toys:Sink", "toys:Number", ":19: stages.sink.stage: .* is not"),
        ("total: gatherer.total", "total: gatherr.total", ":22: stages.sink.inputs.total: no stage 'gatherr'; did"),
        (
            "total: gatherer.total",
            "total: gatherer.totl",
            ":22: stages.sink.inputs.total: gatherer has no output 'totl'; did",
        ),
        ("total: gatherer.total", "total: sink.total", ":22: stages.sink.inputs.total: sink cannot be its own input"),
        (
            "total: gatherer.total",
            "total: worker.answer",
            ":22: .*total: expected Total, .* is Answer; valid: gatherer.total",
        ),
        (
            "total: gatherer.total",
            "totl: gatherer.total",
            ":22: stages.sink.inputs.totl: .*:Sink has no input 'totl'; did you mean 'total'",
        ),
        (
            "total: gatherer.total",
            "total: gatherer",
            ":22: stages.sink.inputs.total: 'gatherer' is not of the form stage.port",
        ),
        ("{total: gatherer.total}", "{}", r":22: stages.sink.inputs: not connected: total \(Total\)"),
        ("queue: 8", "queue: 0", ":14: stages.worker.inputs.number.queue: Expected `int` >= 1"),
        ("queue: 8", "policy: newest", ":14: stages.worker.inputs.number.policy: .*'newest'; valid: block, latest"),
        (
            "seed: 7",
            "migrations: tests.runner.weather:MIGRATION",
            ":2: migrations: no table 'MIGRATION' in .*; did you",
        ),
        (
            "seed: 7",
            "migrations: tests.runner.common.toys:TOLERANCES",
            ":2: migrations: 'Answer.samples' is no key of",
        ),
        ("seed: 7", "tolerances: tests.runner.weather:MIGRATIONS", ":2: tolerances: .*; valid: Type.field"),
        ("seed: 7", "tolerances: tests.runnr.toys:TABLE", ":2: tolerances: no module 'tests.runnr.toys'"),
        ("seed: 7", "numerical: numpy", ":2: numerical: Expected `array`, got 'numpy'"),
        (
            "answers: worker.answer",
            "answers: {from: worker.answer, policy: latest}",
            ":17: stages.gatherer.inputs.answers.policy: latest leaves messages out, but answers gathers .*: block",
        ),
        (
            "answers: worker.answer, number: counter.number",
            "answers: worker.answer, number: {from: counter.number, policy: latest}",
            ":17: stages.gatherer.inputs.number.policy: latest .* on_answers joins number with answers.*valid: block",
        ),
        (
            "queue: 8",
            "policy: latest",
            ":14: stages.worker.inputs.number.policy: latest .* on_piece joins number with piece",
        ),
        ("  watcher:", "  supervisor:", ":23: stages.supervisor: a stage's name is .* none of supervisor"),
    ],
)
def test_a_mistake_in_the_file_is_one_line(tmp_path: Path, old: str, new: str, message: str):
    with pytest.raises(Refused, match=message) as caught:
        load(tmp_path, OUT, old=old, new=new)
    assert "\n" not in str(caught.value)


@dataclass(frozen=True)
class Inner:
    er: float = 0.5


class Deep(Stage):
    """Has a group of settings."""

    @dataclass(frozen=True)
    class Config:
        deep: Inner = field(default_factory=Inner)

    def __init__(self, config: Config) -> None: ...

    def on_start(self) -> None: ...


OLD = "stages:\n"
DEEP = f"stages:\n  account: {{stage: '{__name__}:Deep'}}\n"


class Alone(Stage):
    """Answers each piece by itself."""

    def on_piece(self, piece: Piece) -> Answer:
        return Answer(index=piece.index, count=piece.count, samples=np.zeros(1))


class Onlooker(Stage):
    """Answers nothing."""

    def on_piece(self, piece: Piece) -> Number | None:
        del piece


@pytest.mark.parametrize("replicas", [1, 2])
def test_parts_that_are_answered_by_parts_are_all_needed(tmp_path: Path, replicas: int):
    worker = TOYS.read_text().partition("  worker:\n")[2].partition("  gatherer:")[0]
    alone = f"""    stage: tests.runner.graph.test_graph:Alone
    replicas: {replicas}
    inputs: {{piece: {{from: splitter.piece, policy: latest}}}}
"""
    with pytest.raises(
        Refused, match=r":12: stages.worker.inputs.piece.policy: latest .* each is to be answered.*block"
    ):
        load(tmp_path, OUT, old=worker, new=alone)


def test_who_answers_no_parts_may_take_the_latest(tmp_path: Path):
    onlooker = """  onlooker:
    stage: tests.runner.graph.test_graph:Onlooker
    inputs: {piece: {from: splitter.piece, policy: latest}}
"""
    graph = load(tmp_path, OUT, old="  watcher:\n", new=f"{onlooker}  watcher:\n")
    assert graph.nodes["onlooker"].inputs["piece"].policy == "latest"


class TwoHandlers(Alone):
    """Answers numbers as it answers pieces."""

    def on_number(self, number: Number) -> Answer:
        return Answer(index=0, count=1, samples=np.full(1, number.value))


class Gathers(Alone):
    """Hears all of the pieces, too."""

    def on_pieces(self, pieces: list[Piece]) -> Number: ...


class Begins(Alone):
    """Says something before it hears anything."""

    def on_start(self) -> Number: ...


class Remembers(Alone):
    stateful = True


@pytest.mark.parametrize(
    ("stage", "reason"),
    [
        ("TwoHandlers", "emits answer in on_piece and in on_number, and both answers would have one number; valid: 1"),
        ("Gathers", "gathers pieces, and no replica would get all of them; valid: 1"),
        ("Begins", "emits number in on_start, and each replica would send its own; valid: 1"),
        ("Remembers", "is stateful: replicas would remember different things; valid: 1"),
    ],
)
def test_what_replicas_cannot_share_is_refused(tmp_path: Path, stage: str, reason: str):
    inputs = {"piece": "splitter.piece", "pieces": "splitter.piece", "number": "counter.number"}
    given = {port: inputs[port] for port in inspect_stage(globals()[stage]).inputs}
    stages = {
        "counter": {"stage": f"{Counter.__module__}:Counter"},
        "splitter": {"stage": f"{Splitter.__module__}:Splitter", "inputs": {"number": "counter.number"}},
        "worker": {"stage": f"{__name__}:{stage}", "inputs": given},
    }
    path = tmp_path / "graph.yaml"
    path.write_text(yaml.safe_dump({"name": "shared", "stages": stages}))
    assert load_graph(path).nodes["worker"].replicas == 1
    with pytest.raises(Refused, match=f"worker.replicas: {__name__}:{stage} {reason}"):
        load_graph(path, ["worker.replicas=2"])


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("sink.pth=x", "--set sink.pth: unknown key 'pth'; did you mean 'path'"),
        ("snk.path=x", "--set snk.path: no stage 'snk'; did you mean 'sink'"),
        ("worker.seconds=soon", "--set worker.seconds: Expected `float`, got 'soon'"),
        ("splitter.replicas=2", "--set splitter.replicas: .* takes no Part"),
        ("seed", "--set seed: expected key=value"),
        ("seed=2026-13-45", "--set seed: Expected `int`, got '2026-13-45'"),
        ("splitter.parts=${worker.secnds}", "--set splitter.parts: no setting 'worker.secnds'"),
    ],
)
def test_a_mistake_in_a_setting_is_one_line(tmp_path: Path, setting: str, message: str):
    with pytest.raises(Refused, match=message) as caught:
        load(tmp_path, OUT, setting)
    assert "\n" not in str(caught.value)


def test_a_value_that_must_be_set_says_how(tmp_path: Path):
    with pytest.raises(Refused, match=r"graph.yaml:21: stages.sink.config.path: .* --set sink.path="):
        load(tmp_path)


class Bank(Stage):
    def on_add(self, add: Add) -> None: ...


class Tills(Stage):
    def on_till_add(self, till_add: Add) -> None: ...


def test_commands_that_would_share_a_port_are_refused(tmp_path: Path):
    stages = {"bank": {"stage": f"{__name__}:Tills"}, "bank_till": {"stage": f"{__name__}:Bank"}}
    path = tmp_path / "graph.yaml"
    path.write_text(yaml.safe_dump({"name": "banks", "stages": stages}))
    said = r":2: stages: commands: bank.till_add and bank_till.add would share the port 'bank_till_add'; rename one"
    with pytest.raises(Refused, match=said):
        load_graph(path)


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("name: toys", 'name: "toys\\n"', "name"),
        ("tests.runner.common.toys:Sink", '"tests.runner.common.toys:Sink\\n"', "stages.sink.stage"),
        ("replicas: 2", 'memory: "2GB\\n"', "stages.worker.memory"),
    ],
)
def test_a_name_ends_where_its_line_does(tmp_path: Path, old: str, new: str, place: str):
    with pytest.raises(Refused, match=f"{place}: .* does not fit"):
        load(tmp_path, OUT, old=old, new=new)


def test_all_mistakes_of_a_kind_are_named_at_once(tmp_path: Path):
    with pytest.raises(Refused) as caught:
        load(tmp_path, OUT, "counter.cont=1", "worker.secs=1")
    assert len(str(caught.value).splitlines()) == 2


def test_settings_have_yaml_types(tmp_path: Path):
    graph = load(tmp_path, OUT, "counter.count=3", "seed=11", "worker.replicas=3")
    assert graph.nodes["counter"].config.count == 3
    assert (graph.seed, graph.nodes["worker"].replicas) == (11, 3)


@pytest.mark.parametrize(("text", "value"), [("1e-3", 1e-3), ("1.5e3", 1.5e3), ("-.1E+2", -0.1e2), ("7e22", 7e22)])
def test_a_number_may_have_an_exponent(tmp_path: Path, text: str, value: float):
    written = load(tmp_path, OUT, old="toys:Counter\n", new=f"toys:Counter\n    config: {{period: {text}}}\n")
    for graph in (written, load(tmp_path, OUT, f"counter.period={text}")):
        assert graph.nodes["counter"].config.period == value
        assert graph_from_json(graph_to_json(graph)).nodes["counter"].config.period == value


def test_paths_are_relative_to_where_they_were_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shell = tmp_path / "shell"
    shell.mkdir()
    monkeypatch.chdir(shell)
    assert load(tmp_path, OUT).nodes["sink"].config.path == shell / "out.txt"
    assert load(tmp_path, old="path: ???", new="path: out.txt").nodes["sink"].config.path == tmp_path / "out.txt"


def test_settings_fill_each_other_in(tmp_path: Path):
    graph = load(tmp_path, "sink.path=${counter.count}.txt", "counter.count=4", "splitter.parts=${counter.count}")
    assert graph.nodes["sink"].config.path.name == "4.txt"
    assert graph.nodes["splitter"].config.parts == 4


def test_settings_fill_each_other_in_whatever_their_order(tmp_path: Path):
    chain = ("counter.count=${splitter.parts}", "splitter.parts=${worker.seconds}")
    assert load(tmp_path, OUT, *chain, "worker.seconds=3").nodes["counter"].config.count == 3


def test_a_setting_that_is_not_written_fills_others_in_with_its_default(tmp_path: Path):
    graph = load(
        tmp_path, OUT, "counter.count=${splitter.parts}", "worker.seconds=${account.deep.er}", old=OLD, new=DEEP
    )
    assert (graph.nodes["counter"].config.count, graph.nodes["worker"].config.seconds) == (4, 0.5)
    with pytest.raises(
        Refused, match=r"no setting 'splitter.prts' to fill in; did you mean 'splitter.parts'\? valid: "
    ):
        load(tmp_path, OUT, "counter.count=${splitter.prts}")


def test_a_setting_that_refers_to_itself_shows_the_way(tmp_path: Path):
    with pytest.raises(
        Refused, match=r"^--set counter.count: \${counter.count} refers to itself: counter.count -> count"
    ):
        load(tmp_path, OUT, "counter.count=${counter.count}")
    way = "counter.count -> splitter.parts -> worker.seconds -> counter.count"
    settings = (
        "counter.count=${splitter.parts}",
        "splitter.parts=${worker.seconds}",
        "worker.seconds=${counter.count}",
    )
    with pytest.raises(Refused, match=rf"^--set worker.seconds: \${{counter.count}} refers to itself: {way}"):
        load(tmp_path, OUT, *settings)


def test_json_is_read_back_as_the_same_graph(tmp_path: Path):
    text = graph_to_json(load(tmp_path, OUT))
    assert graph_to_json(graph_from_json(text)) == text


def test_commands_are_not_wired(tmp_path: Path):
    path = ACCOUNT
    graph = load_graph(path)
    assert graph.commands() == {"account_add": Add, "account_collect": Collect}
    assert [route.output for route in graph.routes("supervisor")] == ["account_add", "account_collect"]
    assert graph_from_json(graph_to_json(graph)) == graph
    assert 'supervisor -->|"Add"| account' in mermaid(graph)
    wired = tmp_path / "wired.yaml"
    wired.write_text(path.read_text().replace("{number: ", "{add: counter.number, number: "))
    with pytest.raises(Refused, match=r"wired.yaml:8: stages.account.inputs.add: a command is not connected: runner"):
        load_graph(wired)


def test_mermaid_shows_stages_and_types(tmp_path: Path):
    chart = mermaid(load(tmp_path, OUT))
    assert 'splitter -->|"Piece"| worker' in chart
    assert 'supervisor -->|"Restarted"| watcher' in chart


def test_the_published_schema_is_the_one_in_force():
    assert json.loads((ROOT / "runner" / "graph.schema.json").read_text()) == json.loads(json.dumps(graph_schema()))


@pytest.mark.parametrize(
    "path", [TOYS, *ROOT.glob("graph.yaml"), *ROOT.glob("graphs/*.yaml")], ids=lambda path: path.name
)
def test_graph_files_satisfy_the_schema(path: Path):
    jsonschema.validate(yaml.safe_load(path.read_text()), graph_schema())


def test_the_command_prints_one_line_and_no_traceback(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(tmp_path / "absent.yaml")]) == 2
    captured = capsys.readouterr()
    assert captured.err.endswith("absent.yaml: No such file or directory\n")
    assert captured.out == ""
