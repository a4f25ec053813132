"""The ``runner`` command."""

import argparse
import os
import sys
from collections.abc import Sequence

from runner.cli.commands import Command, graphs, keys, live, machine, new, recordings, replay
from runner.cli.completion import complete_and_exit
from runner.contract import Refused

EXIT_REFUSED = 2
EXIT_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit status; what is refused is one line on stderr."""
    built = parser()
    complete_and_exit(built)
    sys.path.insert(0, os.getcwd())  # noqa: PTH109 - as `python -m` does: stages beside the graph can be named
    try:
        options = built.parse_args(arguments)
        options.arguments = list(sys.argv[1:] if arguments is None else arguments)
        command: Command = options.command
        return command(options) or 0
    except Refused as refusal:
        print(refusal, file=sys.stderr)
        return EXIT_REFUSED
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


def parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = argparse.ArgumentParser(prog="runner", description="Runs, checks, records and replays graphs of stages.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (new, graphs, live, recordings, replay, keys, machine):
        group.add_commands(commands)
    return parser
