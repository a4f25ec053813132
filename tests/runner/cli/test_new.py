"""A project that ``runner new`` writes works at once, and stands for how a project should look."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from runner.cli.main import main
from runner.cli.project import TEMPLATE, new_project
from runner.contract import Refused
from runner.recording.provenance import DISTRIBUTION

ROOT = Path(__file__).parents[3]
BIN = Path(sys.executable).parent


def do(folder: Path, *command: str | Path) -> str:
    """What a command prints that ends well."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": f"{BIN}:{os.environ['PATH']}"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def runner(folder: Path, *arguments: str) -> str:
    return do(folder, sys.executable, "-m", "runner.cli", *arguments)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("new")
    said = runner(folder, "new", "weather")
    assert said.splitlines()[-1] == "now: cd weather && runner up graph.yaml; its tests: pip install pytest && pytest"
    assert all((folder / line).is_file() for line in said.splitlines()[:-1])
    return folder / "weather"


def test_it_holds_what_a_project_needs_and_no_placeholder(project: Path):
    files = {str(path.relative_to(project)): path.read_text() for path in project.rglob("*") if path.is_file()}
    assert {"README.md", "graph.yaml", "pyproject.toml", ".gitignore", "weather/messages.py"} < set(files)
    assert not [path for path, text in files.items() if "NAME" in path or "NAME" in text or "template" in path]
    assert tomllib.loads(files["pyproject.toml"])["project"]["dependencies"] == [DISTRIBUTION]


def test_what_its_readme_says_works_in_that_order(project: Path):
    commands = re.findall(r"^(runner .*|pytest) +#", (project / "README.md").read_text(), re.M)
    check, up, info, replay, again, tests = (do(project, "sh", "-c", command) for command in commands)
    assert check == "graph.yaml: 2 stages, 2 processes, 1 edges: good\n"
    assert ": COMPLETE" in up and up.splitlines()[-1].startswith("the mean is ")
    assert ": COMPLETE" in info and "41 messages" in info
    assert "IDENTICAL: 21 messages" in replay
    assert ": COMPLETE" in again
    assert "4 passed" in tests


def test_it_is_clean(project: Path):
    config = ("--config", str(ROOT / "pyproject.toml"))
    do(project, BIN / "ruff", "format", "--check", *config, ".")
    do(project, BIN / "ruff", "check", *config, ".")
    (project / "pyrightconfig.json").write_text('{"typeCheckingMode": "strict"}')
    do(project, BIN / "pyright", "--pythonpath", sys.executable)


@pytest.mark.parametrize(
    ("name", "error"),
    [
        (
            "Weather-Station",
            "lower case letters, digits and _, the first a letter, the last no _; valid, for example: weather_station",
        ),
        ("2fast", "lower case letters, digits and _, the first a letter, the last no _; valid, for example: my_2fast"),
        ("", "lower case letters, digits and _, the first a letter, the last no _; valid, for example: robot"),
        ("robot_", "the last no _; valid, for example: robot"),
        ("x" * 300, f"the last no _; valid, for example: {'x' * 32}"),
        ("class", "'class' means something else in Python; valid, for example: my_class"),
        ("tests", "'tests' means something else in a project; valid, for example: my_tests"),
        (
            "json",
            "Python has a module 'json' already, which would be imported in its place; valid, for example: my_json",
        ),
        ("numpy", "Python has a module 'numpy' already"),
        ("taken", "taken exists, and nothing is overwritten; valid, for example: my_taken_2"),
    ],
)
def test_a_name_that_will_not_do_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str, error: str
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("")
    (tmp_path / "my_taken").mkdir()
    assert main(["new", name]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"runner new {name}: ") and error in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my_taken", "taken"]


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path):
    (tmp_path / "absent").write_text("a file")
    with pytest.raises(Refused, match=r"runner new weather: .*/absent/weather.* cannot be written: "):
        new_project("weather", tmp_path / "absent")


def test_the_templates_come_with_the_package():
    """Each is matched by a pattern of the package's data, so that the wheel has it."""
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["runner"]
    shipped = {path for pattern in patterns for path in (ROOT / "runner").glob(pattern)}
    assert {path for path in TEMPLATE.rglob("*") if path.is_file()} <= shipped
