"""The subcommands of ``runner``, one module a group: how each is spelled, and which function does it.

Modules of the runner are imported when a command runs: ``runner --help`` and completion answer at once.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

Commands = Any
"""What argparse returns from ``add_subparsers``; it has no public type."""
RECORDINGS = Path("recordings")
"""Where runs are recorded where no other folder is named."""
Command = Callable[[argparse.Namespace], int | None]
"""Runs with the parsed options and returns the exit status; None is 0."""


def add(commands: Commands, name: str, command: Command, text: str) -> argparse.ArgumentParser:
    """Adds a subcommand; ``text`` says in one line what it does."""
    parser = commands.add_parser(name, help=text, description=text.capitalize() + ".")
    parser.set_defaults(command=command)
    return parser


def add_graph(parser: argparse.ArgumentParser) -> None:
    """Adds a graph file and the settings that change it."""
    text = "a graph file, or the name of one that a package brings"
    parser.add_argument("graph", type=graph_file, metavar="GRAPH", help=text)
    add_settings(parser)


def graph_file(text: str) -> Path:
    """Reads an argument that names a graph: a file, or a graph that a package brings."""
    from runner.graph.packaged import find_graph

    return find_graph(Path(text))


def add_file(parser: argparse.ArgumentParser) -> None:
    """Adds a recording."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording")


def add_recordings(parser: argparse.ArgumentParser, text: str) -> None:
    """Adds the folder of recordings; ``text`` says what for."""
    parser.add_argument("--recordings", type=Path, default=RECORDINGS, metavar="DIR", help=text)


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Adds ``--set``, as ``settings``."""
    text = "change a setting, for example camera.dataset=DIR; may be given again"
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE", dest="settings", help=text)


def count(text: str) -> int:
    """Reads a number of things, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: must be 1 or more")
    return int(text)
