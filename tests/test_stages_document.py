"""What docs/stages.md shows is true: every file of it is written, every graph checked, every command typed."""

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from runner.testing import finish, read_until

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "stages.md").read_text()
COMMANDS = {"runner": ("-m", "runner.cli"), "pytest": ("-m", "pytest")}


@dataclass(frozen=True)
class Block:
    """What stands between fences."""

    section: str
    language: str
    text: str

    @property
    def file(self) -> str:
        """The name that its first line gives it."""
        return self.text.partition("\n")[0].removeprefix("# ")


def blocks() -> Iterator[Block]:
    for section in re.split(r"^## ", TEXT, flags=re.MULTILINE)[1:]:
        title = section.partition("\n")[0]
        for language, text in re.findall(r"^```(\w+)\n(.*?)^```$", section, flags=re.MULTILINE | re.DOTALL):
            yield Block(title, language, text)


BLOCKS = list(blocks())
FILES = [block for block in BLOCKS if block.language in ("python", "yaml")]
SECTIONS = sorted({block.section for block in BLOCKS if block.language == "console"})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """All files of the document; no other graph runs here."""
    for block in FILES:
        (tmp_path / block.file).write_text(block.text)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def typed(line: str) -> list[str]:
    """A command as the shell would start it."""
    program, *words = line.split()
    found = [[str(path) for path in sorted(Path().glob(word))] if "*" in word else [word] for word in words]
    return [sys.executable, *COMMANDS[program], *(word for words in found for word in words)]


def start(line: str) -> subprocess.Popen[str]:
    return subprocess.Popen(typed(line), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def squeezed(text: str) -> str:
    """Without times, and with single spaces."""
    return re.sub(r"\s+", " ", re.sub(r"\d+\.\d+ s\b", "", text))


def test_every_block_has_a_name_or_commands():
    assert {block.language for block in BLOCKS} == {"python", "yaml", "console"}
    assert all(re.fullmatch(r"\w+\.(py|yaml)", block.file) for block in FILES)
    assert len({block.file for block in FILES}) == len(FILES)


def test_every_file_is_clean(folder: Path):
    ruff, config = Path(sys.executable).with_name("ruff"), ROOT / "pyproject.toml"
    for command in (["check", "--ignore", "D1"], ["format", "--diff"]):
        done = subprocess.run([ruff, *command, "--config", config, "."], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("graph", [block.file for block in FILES if block.language == "yaml"])
def test_every_graph_is_good(folder: Path, graph: str):
    done = finish(start(f"runner check {graph}"), folder)
    assert done.code == 0 and done.output.endswith(": good\n"), done.output


@pytest.mark.parametrize("section", SECTIONS)
def test_every_command_says_what_is_shown(folder: Path, section: str):
    running: list[subprocess.Popen[str]] = []
    for block in (block for block in BLOCKS if (block.section, block.language) == (section, "console")):
        for command, shown in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", block.text, flags=re.MULTILINE):
            process = start(command.removesuffix(" &"))
            if command.endswith(" &"):
                read_until(process, "processes are ready")
                running.append(process)
                continue
            output = finish(process, folder).output
            for line in shown.splitlines():
                assert squeezed(line).strip() in squeezed(output), f"{command}\n{output}"
    for process in running:
        assert finish(process, folder).code == 0
