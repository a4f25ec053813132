"""The documents name only what exists."""

import re
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from runner.hosts import head

ROOT = Path(__file__).parent.parent
DOCUMENTS = [
    *(ROOT / path for path in ("README.md", "ARCHITECTURE.md", "recordings/README.md", "benchmarks/README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
TOP_LEVEL = {path.name for path in ROOT.iterdir() if not path.name.startswith(".")} - {"build"}


def named_paths(text: str) -> set[str]:
    """Every path in backticks that begins with something at the top level."""
    return {path for path in re.findall(r"`([\w./*-]+)`", text) if "/" in path and path.split("/")[0] in TOP_LEVEL}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_path_exists(document: Path):
    missing = [path for path in sorted(named_paths(document.read_text())) if not any(ROOT.glob(path.rstrip("/")))]
    assert missing == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_and_picture_leads_to_a_file(document: Path):
    for target in re.findall(r"\]\(([^):#]+)(?:#[^)]*)?\)", document.read_text()):
        assert (document.parent / target).is_file(), target


def test_the_index_names_every_page():
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")} - {"README.md"}
    assert set(re.findall(r"^- \[[^]]*\]\(([\w./-]+)\)", (ROOT / "docs" / "README.md").read_text(), re.M)) == pages


def test_the_index_of_benchmarks_names_every_command():
    scripts = [path for path in (ROOT / "benchmarks").glob("*/*.py") if '"__main__"' in path.read_text()]
    folders = [path.parent for path in (ROOT / "benchmarks").glob("*/*/__main__.py")]
    named = re.findall(r"^\| `(\w+)", (ROOT / "benchmarks" / "README.md").read_text(), re.M)
    assert {path.stem for path in (*scripts, *folders)} == set(named)
    assert [name for name in named if find_spec(f"benchmarks.{name}") is None] == []


def test_architecture_names_every_stage():
    text = (ROOT / "ARCHITECTURE.md").read_text()
    stages = {path.stem for path in (ROOT / "stages").glob("*.py")} - {"__init__", "views"}
    assert {stage for stage in stages if stage not in text} == set()


def test_the_keys_between_hosts_are_listed():
    keys = re.findall(r"^``(\S+)``  ", head.__doc__ or "", re.M)
    text = (ROOT / "docs" / "runner" / "keys.md").read_text()
    assert keys
    assert [key for key in keys if f"| `{key}` |" not in text] == []


def test_the_listener_is_given_an_address_a_run_and_schemas():
    text = "\n".join(document.read_text() for document in DOCUMENTS)
    assert re.findall(r"python examples/listen.py \S+ \S+ (\S+)", text) == ["schemas.json", "schemas.json"]


def test_the_packages_that_the_runner_needs_are_counted():
    count = len(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"])
    said = f"{count} needed, {count} known as tested"
    assert said in (ROOT / "docs" / "runner" / "tools.md").read_text()


def test_pytest_is_given_every_file_of_tests():
    given = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]["testpaths"]
    found = {path for one in given for place in ROOT.glob(one) for path in (place, *place.rglob("test_*.py"))}
    assert [path for path in sorted((ROOT / "tests").rglob("test_*.py")) if path not in found] == []
