"""The command that begins a project: ``new``."""

import argparse
from pathlib import Path

from runner.cli.commands import Commands, add


def add_commands(commands: Commands) -> None:
    """Adds the commands of this group."""
    new = add(commands, "new", _new, "write a project to begin with: two stages, a graph, tests")
    new.add_argument("name", metavar="NAME", help="of the project, its folder and its Python package")


def _new(options: argparse.Namespace) -> None:
    from runner.cli.project import new_project

    for path in new_project(options.name, Path.cwd()):
        print(path.relative_to(Path.cwd()))
    print(f"now: cd {options.name} && runner up graph.yaml; its tests: pip install pytest && pytest")
