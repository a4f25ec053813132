"""Commands on recordings: ``info``, ``view``."""

import argparse
from pathlib import Path

from runner.cli.commands import Commands, add, add_file
from runner.contract import Refused


def add_commands(commands: Commands) -> None:
    """Adds the commands of this group."""
    add_file(add(commands, "info", _info, "say what a recording holds and whether it is complete"))
    _add_view(commands)


def _add_view(commands: Commands) -> None:
    view = add(commands, "view", _view, "show a recording, or a graph while it runs")
    view.add_argument("file", type=Path, metavar="FILE", nargs="?", help="a recording")
    view.add_argument("--live", action="store_true", help="follow the run that is being recorded")
    view.add_argument("--save", type=Path, metavar="RRD", help="write a Rerun file instead of opening the viewer")
    view.add_argument("--png", type=Path, metavar="PNG", help="write a picture instead of opening the viewer")


def _info(options: argparse.Namespace) -> int:
    from runner.inspect.info import describe

    print(describe(options.file))
    return 0


def _view(options: argparse.Namespace) -> int:
    from runner.view.views import require_viewer

    require_viewer()
    from runner.view.rerun_view import view_live, view_recording

    if options.live:
        view_live(options.file)
    elif options.file is None:
        raise Refused("runner view: name a recording, or --live")
    else:
        view_recording(options.file, save=options.save, png=options.png)
    return 0
