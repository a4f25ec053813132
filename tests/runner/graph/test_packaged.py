"""What an installed package brings, graphs and the files their settings name, is found from any folder."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from runner.cli.main import main
from runner.contract import Refused
from runner.graph.graph import graph_to_json
from runner.graph.packaged import find_graph, locate, portable_name
from runner.graph.reading import graph_from_json, load_graph, node_from_entry
from runner.graph.references import load_class
from runner.recording.provenance import file_hashes, portable
from runner.testing import finish, runner

STAGES = """
from dataclasses import dataclass
from pathlib import Path
from runner.contract import Finished, Stage

class Teller(Stage):
    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        words: Path = Path("words.txt")

    def __init__(self, config: Config) -> None:
        pass

    def on_start(self) -> Finished:
        return Finished(code=0, reason="told")
"""
GRAPH = "name: told\nstages:\n  teller: {stage: 'brought.stages:Teller', config: {words: brought/data/words.txt}}\n"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package as an installer leaves it, seen from an empty folder."""
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    texts = {
        "brought/__init__.py": "",
        "brought/stages.py": STAGES,
        "brought/data/words.txt": "hello",
        "brought/graphs/__init__.py": "",
        "brought/graphs/told.yaml": GRAPH,
        "brought-1.dist-info/METADATA": "Metadata-Version: 2.1\nName: brought\nVersion: 1\n",
        "brought-1.dist-info/entry_points.txt": "[runner.graphs]\nbrought = brought.graphs\n",
    }
    for name, text in texts.items():
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (site / name).write_text(text)
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    monkeypatch.syspath_prepend(site)
    yield site / "brought"
    for name in [name for name in sys.modules if name.partition(".")[0] == "brought"]:
        del sys.modules[name]


def test_a_file_beside_the_graph_comes_before_that_of_a_package(package: Path, tmp_path: Path):
    name = Path("brought/data/words.txt")
    assert locate(name, tmp_path) == package / "data/words.txt"
    near = tmp_path / name
    near.parent.mkdir(parents=True)
    near.touch()
    assert locate(name, tmp_path) == near


@pytest.mark.parametrize(
    "name", ["brought/data/absent.txt", "absent/words.txt", "../brought/data/words.txt", "brought"]
)
def test_what_no_package_brings_stays_where_it_was_said_to_be(package: Path, tmp_path: Path, name: str):
    assert locate(Path(name), tmp_path) == tmp_path / name


def test_a_graph_is_found_by_its_name(package: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert find_graph(Path("told")) == package / "graphs/told.yaml"
    Path("told").mkdir()
    assert find_graph(Path("told")) == package / "graphs/told.yaml"
    Path("told").rmdir()
    assert find_graph(Path("brought/graphs/told.yaml")) == package / "graphs/told.yaml"
    assert main(["check", "told"]) == 0
    assert main(["check", "tolt"]) == 2
    assert "tolt: no such file, and no graph of an installed package; did you mean 'told'" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "told" in capsys.readouterr().out
    Path("told").write_text("name: [")
    assert main(["check", "told"]) == 2
    assert "not YAML" in capsys.readouterr().err


def test_a_folder_is_no_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "jobs").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Refused, match=r"^jobs: is a folder; valid: a graph file$"):
        find_graph(Path("jobs"))
    (tmp_path / "jobs/day.yaml").touch()
    with pytest.raises(Refused, match=r"^jobs: is a folder; valid: jobs/day\.yaml$"):
        find_graph(Path("jobs/"))


def test_a_folder_around_a_package_is_not_that_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "outer/outer").mkdir(parents=True)
    (tmp_path / "outer/outer/__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    text = rf"valid: outer\.outer; if {tmp_path}/outer is not the package outer that is meant, run this in the folder"
    with pytest.raises(Refused, match=f"no module 'outer.thermometer'; .* {text} that has it, or install it$"):
        load_class("outer.thermometer:Stage", "here")


def test_a_setting_of_a_packaged_graph_is_resolved_and_travels(package: Path, tmp_path: Path):
    graph = load_graph(find_graph(Path("told")))
    words = package / "data/words.txt"
    assert graph.nodes["teller"].config.words == words
    recorded = portable(json.loads(graph_to_json(graph)), {str(tmp_path): ""})
    assert recorded["stages"]["teller"]["config"] == {"words": "brought/data/words.txt"}
    assert portable(str(words), {str(package): "/lab"}) == "brought/data/words.txt"
    # Wherever it is read again, and by whatever process, it is the file of the package that is there.
    assert graph_from_json(json.dumps(recorded)).nodes["teller"].config.words == words
    assert node_from_entry("teller", recorded["stages"]["teller"]).config.words == words
    assert file_hashes(recorded).keys() == {"brought/data/words.txt"}


def test_only_what_lies_in_an_importable_package_has_a_portable_name(package: Path, tmp_path: Path):
    assert portable_name(package / "data/words.txt") == "brought/data/words.txt"
    stranger = tmp_path / "copy/brought/data/words.txt"
    assert portable_name(stranger) is None
    assert portable_name(tmp_path / "out.csv") is None
    assert portable_name(tmp_path / "brought.stages" / "out.csv") is None
    assert "brought" not in sys.modules


def test_texts_that_can_be_no_path_are_no_files():
    settings = {"long": "x" * 5000, "zero": "a\0b", "home": "~nobody/x", "package": "json"}
    assert file_hashes({"stages": {"a": {"config": settings}}}) == {}


def test_an_extra_that_is_missing_is_named(package: Path):
    (package / "stages.py").write_text("import not_there\n")
    with (package.parent / "brought-1.dist-info/METADATA").open("a") as metadata:
        metadata.write("Provides-Extra: brought\n")
    (package.parent / "brought-1.dist-info/top_level.txt").write_text("brought\n")
    with pytest.raises(Refused, match=r"No module named 'not_there'; type: pip install 'brought\[brought\]'"):
        load_graph(find_graph(Path("told")))


def test_a_graph_runs_by_its_name_alone(package: Path, tmp_path: Path):
    assert "run told-" in finish(runner("told", "--recordings", str(tmp_path)), tmp_path).output
