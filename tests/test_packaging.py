"""What is installed is enough: the runner alone without what stages compute with, and a wheel without its source."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from stages.devices.clutter import write_clutter
from stages.scene.catalogue import BUILT_IN, Catalogue

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
SOURCE = ("runner", "stages", "graphs", "graph.yaml", "pyproject.toml", "README.md", "LICENSE", "NOTICE")
GRAPHS = {
    "tray": (),
    "interactive": (),
    "ur5e": (),
    "calibrate": (),
    "calibrate_arm": (),
    "bag": ("--set", "camera.bag=d"),
    "arm": (),
    "ros2": (),
    "reference": (),
    "photos": ("--set", "camera.dataset=d", "--set", "results.path=d.csv"),
    "bop": ("--set", "camera.dataset=d", "--set", "detector.detections=d.json", "--set", "results.path=d.csv"),
}
HELLO = """
from collections.abc import Iterator

from runner.contract import Finished, Message, Stage


class Greeting(Message, frozen=True, kw_only=True):
    text: str


class Reply(Message, frozen=True, kw_only=True):
    text: str


class Caller(Stage):
    device = True

    def on_start(self) -> Iterator[Greeting]:
        yield from (Greeting(text=f"hello {number}") for number in range(3))


class Answerer(Stage):
    def on_greeting(self, greeting: Greeting) -> Reply:
        return Reply(text=greeting.text.upper())


class Listener(Stage):
    device = True

    def on_reply(self, reply: Reply) -> Finished | None:
        return Finished(code=0, reason=f"heard {reply.text}") if reply.text == "HELLO 2" else None
"""
HELLO_GRAPH = """
name: hello
stages:
  caller: {stage: 'hello:Caller'}
  answerer: {stage: 'hello:Answerer', inputs: {greeting: caller.greeting}}
  listener: {stage: 'hello:Listener', inputs: {reply: answerer.reply}}
"""


# ------------------------------------------------------------------------------------------ what is declared


def imported(path: Path) -> Iterator[str]:
    """The packages from elsewhere that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.Import(names=names):
                modules = [name.name for name in names]
            case ast.ImportFrom(module=str(module), level=0):
                modules = [module]
            case _:
                continue
        packages = {module.partition(".")[0] for module in modules}
        yield from packages - set(sys.stdlib_module_names) - {"runner", "stages"}


def undeclared(folder: str, *requirements: str) -> set[str]:
    """What a folder imports and none of the requirements brings."""
    declared = {key(re.split(r"[\[<>=]", requirement)[0]) for requirement in requirements}
    owners = packages_distributions()
    found = {name for path in (ROOT / folder).rglob("*.py") for name in imported(path)}
    return {name for name in found if not declared & {key(owner) for owner in owners.get(name, [name])}}


def key(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_what_the_runner_imports_is_installed_with_it():
    extras = (name for extra in ("view", "page", "foxglove", "ros2") for name in EXTRAS[extra])
    assert undeclared("runner", *PROJECT["dependencies"], *extras) == set()


def test_only_views_and_pages_import_what_their_extras_bring():
    others = [path for path in (ROOT / "runner").iterdir() if path.is_dir() and path.name not in ("view", "page")]
    assert {folder.name: undeclared(f"runner/{folder.name}", *PROJECT["dependencies"]) for folder in others} == {
        folder.name: set() for folder in others
    }


def test_what_stages_import_is_installed_with_their_extra():
    assert undeclared("stages", *PROJECT["dependencies"], *EXTRAS["stages"]) == set()


def test_every_requirement_has_its_tested_version():
    pinned = {key(line.partition("==")[0]) for line in (ROOT / "constraints.txt").read_text().splitlines()}
    required = [
        *PROJECT["dependencies"],
        *(name for extra in ("stages", "view", "page", "dev") for name in EXTRAS[extra]),
    ]
    assert {name for name in required if key(re.split(r"[\[;]", name)[0]) not in pinned} == set()


# ------------------------------------------------------------------------------------------ what is installed


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the source: building leaves files behind, and must find none."""
    folder = tmp_path_factory.mktemp("source")
    for name in SOURCE:
        ignore = shutil.ignore_patterns("__pycache__")
        path = ROOT / name
        shutil.copytree(path, folder / name, symlinks=True, ignore=ignore) if path.is_dir() else shutil.copy(
            path, folder
        )
    return folder


def pip(*arguments: str | Path) -> None:
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *map(str, arguments)]
    subprocess.run(command, check=True, timeout=280)


class Environment:
    """A virtual environment, seen from a folder where nothing of the project lies."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "elsewhere"
        self.folder.mkdir()
        self._bin = folder / "environment" / "bin"
        venv.create(self._bin.parent)

    def install(self, *arguments: str | Path) -> None:
        pip("--python", self._bin / "python", "install", *arguments)

    def see(self, packages: str) -> None:
        """Makes what is installed elsewhere importable here, after what is installed here."""
        program = "import sysconfig; print(sysconfig.get_path('purelib'))"
        (Path(self.python(program).strip()) / "seen.pth").write_text(packages)

    def python(self, program: str) -> str:
        return self._run(0, "python", "-c", program)

    def runner(self, *arguments: str | Path, code: int = 0) -> str:
        return self._run(code, "runner", *map(str, arguments))

    def _run(self, code: int, program: str, *arguments: str) -> str:
        clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        command = [str(self._bin / program), *arguments]
        done = subprocess.run(
            command, cwd=self.folder, env=clean, text=True, capture_output=True, timeout=280, check=False
        )
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout + done.stderr


@pytest.mark.slow
def test_the_runner_alone_runs_records_and_replays(source: Path, tmp_path: Path):
    """Nothing is there of what stages compute with, nor the viewer."""
    alone = Environment(tmp_path)
    alone.install("--constraint", ROOT / "constraints.txt", source)
    listed = alone.python("import importlib.metadata as m; print(*(found.name for found in m.distributions()))")
    assert {key(name) for name in listed.split()}.isdisjoint({*EXTRAS["stages"], *EXTRAS["view"]})
    (alone.folder / "hello.py").write_text(HELLO)
    (alone.folder / "hello.yaml").write_text(HELLO_GRAPH)
    assert "COMMAND" in alone.runner("--help")
    assert "graphs can run here" in alone.runner("doctor", "hello.yaml")
    assert "heard HELLO 2" in alone.runner("up", "hello.yaml")
    (recording,) = (alone.folder / "recordings").glob("*.mcap")
    assert "identical" in alone.runner("replay", recording, "--verify")
    for command in (("view", recording), ("up", "hello.yaml", "--view")):
        assert "type: pip install 'scene-programming[view]'" in alone.runner(*command, code=2)
    assert "type: pip install 'scene-programming[stages]'" in alone.runner("check", "tray", code=2)


@pytest.fixture(scope="module")
def wheel(source: Path) -> Path:
    pip("wheel", "--no-deps", "--wheel-dir", source / "wheels", source)
    (path,) = (source / "wheels").glob("*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_has_every_file_of_the_packages(wheel: Path):
    files = {path for name in ("runner", "stages") for path in (ROOT / name).rglob("*") if path.is_file()}
    expected = {str(path.relative_to(ROOT)) for path in files if "__pycache__" not in path.parts}
    assert expected - set(zipfile.ZipFile(wheel).namelist()) == set()


@pytest.mark.slow
def test_the_wheel_runs_its_graphs_from_an_empty_folder(wheel: Path, tmp_path: Path):
    installed = Environment(tmp_path)
    installed.install("--no-deps", "--no-index", wheel)
    installed.see(sysconfig.get_path("purelib"))
    for name, settings in GRAPHS.items():
        assert installed.runner("check", name, *settings).endswith(": good\n")
    write_clutter(tmp_path / "images", Catalogue.load(BUILT_IN), scenes=1, seed=5)
    small = [f"camera.dataset={tmp_path / 'images'}", "results.path=out.csv", "hypotheses.finalists=1"]
    small += ["particle_filter.iterations=20", "hypotheses.n_objects=2"]
    installed.runner("up", "reference", *(part for setting in small for part in ("--set", setting)))
    (recording,) = (installed.folder / "recordings").glob("*.mcap")
    assert "stages/scene/catalogue.yaml" in installed.runner("info", recording)
    assert "identical" in installed.runner("replay", recording, "--verify")
    assert (installed.folder / "out.csv").read_text().count("\n") == 3


@pytest.mark.slow
def test_the_wheel_makes_a_project_that_runs(wheel: Path, tmp_path: Path):
    installed = Environment(tmp_path)
    installed.install("--no-deps", "--no-index", wheel)
    installed.see(sysconfig.get_path("purelib"))
    installed.runner("new", "weather")
    installed.folder /= "weather"
    assert "COMPLETE" in installed.runner("up", "graph.yaml")
    (recording,) = (installed.folder / "recordings").glob("*.mcap")
    assert "IDENTICAL: 21 messages" in installed.runner("replay", recording, "--verify")
    assert (installed.folder / ".gitignore").is_file()
