"""What the code and its tests look for outside Python is there on a bare machine, or said to be."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from runner.view.rerun_view import PACKAGES

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts" / "system-libraries"
EVERYWHERE = {"cat", "env", "find", "sh", "sleep"}
"""What every system has."""
ELSEWHERE = {
    "dora": "the extra `benchmarks` brings it",
    "cc": "a peer of the tests compiles its codecs; without it they are skipped",
    "ptxas": "NVIDIA's toolkit brings it; tests without it are skipped",
}
OURS = {"sys.executable", "RERUN", "str(Path(rerun_cli.__file__).with_name('rerun'))", "str(SCRIPT)"}
"""Programs that come with Python, its packages or this project."""
HANDED_ON = {
    "command[0]": "what a caller wants to be started",
    "str(self._bin / program)": "of the environment that a test has made",
    "arguments": "this interpreter again",
    "ruff": "the extra `dev` brings it",
    "Path(__file__).parents[4]": "a genuine ROS 2, where somebody has put one; without it the test is skipped",
    "command": "this interpreter again",
    "typed(line)": "this interpreter again",
    "command(method, options, out)": "this interpreter again",
    "_inside(self.spaces[host], folder) if self.spaces else []": "ip",
}
"""Programs that the place does not name, and where they come from."""
OWNERS, STARTERS = {"subprocess", "shutil", "os"}, {"run", "Popen", "call", "check_call", "check_output", "which"}


def installed() -> dict[str, str]:
    """Debian's package by the library or program for whose sake the script installs it."""
    table = SCRIPT.read_text().partition("<<'END'\n")[2].partition("\nEND\n")[0]
    return {name: package for name, package, *_ in map(str.split, table.splitlines())}


class Module:
    """One source file, and the programs and libraries that it names."""

    def __init__(self, path: Path) -> None:
        self._nodes = list(ast.walk(ast.parse(path.read_text())))
        self._assigned: dict[str, list[ast.expr]] = {}
        for node in self._nodes:
            targets = node.targets if isinstance(node, ast.Assign) else []
            for target in targets:
                if isinstance(target, ast.Name):
                    self._assigned.setdefault(target.id, []).append(node.value)

    def programs(self) -> Iterator[str]:
        """The first word of every command; an expression that is not resolved begins with ``?``."""
        for call in self._calls():
            match call.func:
                case ast.Attribute(value=ast.Name(id=owner), attr=name) if owner in OWNERS:
                    if name in STARTERS or name.startswith(("exec", "spawn", "posix_spawn")):
                        yield from self._words(call.args[0], ())

    def libraries(self) -> Iterator[str]:
        """What is loaded by name."""
        for call in self._calls():
            match call:
                case ast.Call(
                    func=ast.Attribute(attr="CDLL" | "find_library"), args=[ast.Constant(value=str(name)), *_]
                ):
                    yield name

    def _calls(self) -> Iterator[ast.Call]:
        return (node for node in self._nodes if isinstance(node, ast.Call) and node.args)

    def _words(self, node: ast.expr, seen: tuple[str, ...]) -> Iterator[str]:
        match node:
            case ast.Constant(value=str(word)):
                yield word
            case ast.List(elts=[first, *_]) | ast.Tuple(elts=[first, *_]):
                yield from self._words(first, seen)
            case ast.Starred(value=inner) | ast.BinOp(left=inner) | ast.Call(func=ast.Name(id="bound"), args=[inner]):
                yield from self._words(inner, seen)
            case ast.Name(id=name) if name in self._assigned and name not in seen:
                for value in self._assigned[name]:
                    yield from self._words(value, (*seen, name))
            case _:
                yield f"?{ast.unparse(node)}"


def modules() -> list[Module]:
    folders = ("runner", "stages", "tests", "benchmarks")
    return [Module(path) for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def test_every_program_that_is_looked_for_is_installed_or_accounted_for():
    found = {word for module in modules() for word in module.programs()}
    named = {word for word in found if not word.startswith("?")}
    assert named >= {"chromium", "git", "ip", "Xvfb"}
    assert named - EVERYWHERE - ELSEWHERE.keys() - installed().keys() == set()
    assert {word[1:] for word in found - named} - OURS - HANDED_ON.keys() == set()


def test_every_library_that_is_loaded_is_installed():
    loaded = {name for module in modules() for name in module.libraries() if not name.startswith("absent-")}
    assert loaded == {"libEGL.so.1"}
    assert loaded <= installed().keys()
    assert set(PACKAGES.split()) <= set(installed().values())


def test_nothing_is_called_where_all_is_there(tmp_path: Path):
    """That all is there is what a machine that was set up has, and the tests need."""
    calls = stub(tmp_path, "apt-get")
    done = run(f"{tmp_path}:{os.environ['PATH']}")
    assert (done.returncode, done.stdout, done.stderr, calls.exists()) == (0, "", "", False)


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """A folder of programs without Xvfb, chromium and git."""
    for program in (shutil.which("cat"), shutil.which("find"), shutil.which("env")):
        assert program is not None
        (tmp_path / Path(program).name).symlink_to(program)
    return tmp_path


def test_root_installs_what_is_missing(bare: Path):
    calls = stub(bare, "apt-get")
    stub(bare, "id", "echo 0")
    done = run(str(bare))
    assert (done.returncode, done.stdout, done.stderr) == (0, "Installing xvfb chromium git\n", "")
    update, install = calls.read_text().splitlines()
    assert update == "update -qq"
    assert install == "install --yes --no-install-recommends xvfb chromium git -qq -o DPkg::Lock::Timeout=300"


def test_others_install_with_sudo_or_are_told_what_to_type(bare: Path):
    calls = stub(bare, "apt-get")
    stub(bare, "id", "echo 1000")
    done = run(str(bare))
    assert (done.returncode, calls.exists()) == (1, False)
    command = "apt-get install --yes --no-install-recommends xvfb chromium git"
    assert f"    sudo apt-get update && sudo {command}\n" in done.stderr
    stub(bare, "sudo", '[ "$1" = -n ] || "$@"')
    assert run(str(bare)).returncode == 0
    assert calls.read_text().splitlines()[-1].startswith(command.removeprefix("apt-get "))


def test_without_debians_package_manager_the_packages_are_named(bare: Path):
    done = run(str(bare))
    assert done.returncode == 1
    assert done.stderr.startswith("Missing: xvfb chromium git (Debian's names)")


def stub(folder: Path, name: str, script: str = "") -> Path:
    """A program that writes down how it was called; returns where."""
    calls = folder / f"{name}.calls"
    (folder / name).write_text(f'#!/bin/sh\necho "$*" >> {calls}\n{script}\n')
    (folder / name).chmod(0o755)
    return calls


def run(path: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": path, "PYTHON": sys.executable}
    return subprocess.run([str(SCRIPT)], env=environment, capture_output=True, text=True, check=False)
