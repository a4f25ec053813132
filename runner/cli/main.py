"""The ``runner`` command."""

import argparse
import os
import sys
from collections.abc import Collection, Sequence
from typing import NoReturn

from runner.cli.commands import Command, graphs, keys, live, machine, new, recordings, replay
from runner.cli.completion import complete_and_exit
from runner.contract import EXIT_REFUSED, Refused

EXIT_INTERRUPTED = 130


def run() -> NoReturn:
    """The program ``runner``: one command, with whose exit status it ends."""
    from runner.process.forks import end_with

    end_with(main)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit status; what is refused is one line on stderr."""
    _open_what_is_closed()
    built, names = parser()
    complete_and_exit(built)
    sys.path.insert(0, os.getcwd())  # noqa: PTH109 - as `python -m` does: stages beside the graph can be named
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        _refuse_other_bytes(*given, sys.path[0])
        options = built.parse_args(["up", *given] if _names_a_graph(given, names) else given)
        options.arguments = given
        command: Command = options.command
        return command(options) or 0
    except Refused as refusal:
        print(refusal, file=sys.stderr)
        return EXIT_REFUSED
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


def _open_what_is_closed() -> None:
    """Opens standard streams that were closed (``>&-``): what is opened next would be taken for them."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, open(nowhere, mode, closefd=False))  # noqa: SIM115 - a descriptor, as Python does


def _refuse_other_bytes(*texts: str) -> None:
    """Refuses what is typed, and the folder in which it is, where it is not UTF-8: messages could not hold it."""
    for text in texts:
        try:
            text.encode()
        except UnicodeEncodeError:
            raise Refused(f"{text!r}: is not UTF-8") from None


def _names_a_graph(given: Sequence[str], commands: Collection[str]) -> bool:
    """Whether it begins with a graph that a package brings: ``runner NAME`` is ``runner up NAME``."""
    if not given or given[0] in commands or given[0].startswith("-"):
        return False
    from runner.graph.packaged import packaged_graphs

    return given[0] in packaged_graphs()


class _Runner(argparse.ArgumentParser):
    def format_help(self) -> str:
        """Looks for the graphs that packages bring only when somebody asks."""
        from runner.graph.packaged import packaged_graphs

        names = ", ".join(sorted(packaged_graphs()))
        self.epilog = f"`runner NAME` is `runner up NAME` of a graph that an installed package brings: {names}"
        return super().format_help()


def parser() -> tuple[argparse.ArgumentParser, Collection[str]]:
    """All commands with their options, and their names."""
    parser = _Runner(prog="runner", description="Runs, checks, records and replays graphs of stages.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=argparse.ArgumentParser)
    for group in (new, graphs, live, recordings, replay, keys, machine):
        group.add_commands(commands)
    return parser, commands.choices
