"""A recording says where it came from: the revision of the user's stages, the runner, and what computed."""

import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from runner.graph.graph import NUMERICAL, graph_to_json
from runner.graph.reading import load_graph
from runner.recording import provenance
from runner.recording.provenance import (
    DISTRIBUTION,
    FIRST_NUMERICAL,
    fingerprint,
    numerical,
    package_versions,
    revision,
    runner_version,
)
from runner.recording.recording import Recording
from tests.runner.common.recordings import TOYS, record_toys, rewrite

ROOT = Path(__file__).parents[3]
OLD = Path(__file__).parents[1] / "weather-1.mcap"


def git(folder: Path, *arguments: str) -> str:
    who = ("-c", "user.name=A", "-c", "user.email=a@b.c", "-c", "init.defaultBranch=main")
    done = subprocess.run(["git", "-C", str(folder), *who, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A checkout with a package of stages, which is not imported."""
    (tmp_path / "provenance_robot").mkdir()
    (tmp_path / "provenance_robot" / "__init__.py").write_text("raise ImportError('nobody needs to import this')\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    monkeypatch.syspath_prepend(str(tmp_path))
    provenance._revision.cache_clear()  # pyright: ignore[reportPrivateUsage]
    yield tmp_path
    provenance._revision.cache_clear()  # pyright: ignore[reportPrivateUsage]


def graph(*stages: str) -> dict[str, object]:
    return {"stages": {f"s{number}": {"stage": stage} for number, stage in enumerate(stages)}}


def test_the_revision_is_that_of_the_stages(project: Path):
    commit = git(project, "rev-parse", "HEAD")
    assert revision(graph("provenance_robot.stages:Camera", "provenance_robot.stages:Arm")) == commit
    assert revision(graph("provenance_robot.stages:Camera", "tests.runner.common.toys:Sink")).startswith(f"{commit} ")


def test_a_changed_source_is_dirty(project: Path):
    (project / "provenance_robot" / "__init__.py").write_text("")
    assert revision(graph("provenance_robot:Camera")) == git(project, "rev-parse", "HEAD") + "-dirty"


def test_what_is_installed_or_nowhere_has_no_revision():
    assert revision(graph("numpy.stages:Camera", "nowhere.stages:Camera", "msgspec")) == ""
    assert revision({"stages": ["no", "mapping"]}) == ""


def test_the_packages_do_not_depend_on_what_has_been_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def installed(folder: Path, name: str, number: str) -> None:
        (folder / f"{name}-{number}.dist-info").mkdir(parents=True)
        (folder / f"{name}-{number}.dist-info" / "METADATA").write_text(f"Name: {name}\nVersion: {number}\n")

    installed(tmp_path, "provenance-tool", "1.0")
    (tmp_path / "provenance_tool" / "_vendor").mkdir(parents=True)
    (tmp_path / "provenance_tool" / "__init__.py").touch()
    installed(tmp_path / "provenance_tool" / "_vendor", "provenance-helper", "2.0")
    installed(tmp_path / "later", "provenance-tool", "3.0")
    before = package_versions()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(
        sys, "path", [*sys.path, str(tmp_path / "provenance_tool" / "_vendor"), str(tmp_path / "later")]
    )
    assert package_versions() == before | {"provenance-tool": "1.0"}


def test_the_version_of_the_runner_is_recorded_beside_it(tmp_path: Path):
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["name"] == DISTRIBUTION
    run = Recording(record_toys(tmp_path)[0]).run
    assert run["runner"] == runner_version()
    assert run["revision"] == revision(graph("tests.runner.common.toys:Sink"))


def test_a_graph_names_the_packages_that_compute(tmp_path: Path):
    sink = f"sink.path={tmp_path}"
    assert load_graph(TOYS, (sink,)).numerical == NUMERICAL
    named = json.loads(graph_to_json(load_graph(TOYS, (sink, "numerical=[scipy, numpy]"))))
    assert numerical(named) == ["scipy", "numpy"]
    packages = {"numpy": "1", "scipy": "2", "torch": "3"}
    here = fingerprint({}, packages, numerical(named))
    assert here == fingerprint({}, {**packages, "torch": "4"}, ["numpy", "scipy"])
    assert here != fingerprint({}, {**packages, "scipy": "3"}, ["numpy", "scipy"])


def test_a_recording_older_than_that_is_compared_by_the_packages_of_its_time(tmp_path: Path):
    old = Recording(OLD)
    assert numerical(old.graph) == FIRST_NUMERICAL
    assert old.fingerprint == "3358facc75e999fa"
    packages = {**old.aspect("packages", dict[str, str]()), "torch": "0"}
    other = Recording(rewrite(OLD, tmp_path / "other.mcap", lambda _, data: data, {"packages": json.dumps(packages)}))
    assert other.fingerprint != old.fingerprint


def test_a_file_that_cannot_be_read_is_named_with_the_reason():
    """Readable for root, and yet it has nothing to read at its beginning."""
    graph = {"stages": {"sink": {"config": {"path": "/proc/self/mem"}}}}
    assert provenance.file_hashes(graph) == {"/proc/self/mem": "not hashed, Input/output error"}


def test_a_slash_is_a_word_and_not_the_whole_machine():
    assert provenance.file_hashes({"stages": {"camera": {"config": {"namespace": "/"}}}}) == {}


def test_a_text_that_is_empty_is_not_the_working_folder():
    assert provenance.file_hashes({"stages": {"camera": {"config": {"namespace": ""}}}}) == {}
