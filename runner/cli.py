"""The ``runner`` command."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from runner.contract import Refused

EXIT_REFUSED = 2
Commands = Any
"""What argparse returns from ``add_subparsers``; it has no public type."""
Command = Callable[[argparse.Namespace], int]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit status; what is refused is one line on stderr."""
    options = _parser().parse_args(arguments)
    sys.path.insert(0, os.getcwd())  # noqa: PTH109 - as `python -m` does: stages beside the graph can be named
    command: Command = options.command
    try:
        return command(options)
    except Refused as refusal:
        print(refusal, file=sys.stderr)
        return EXIT_REFUSED
    except BrokenPipeError:
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="runner", description="Runs, checks, records and replays graphs of stages.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    up = _add(commands, "up", _up, "run a graph, record it, and exit as it ends")
    _add_graph(up)
    up.add_argument("--seed", type=int, help="root of all random numbers (short for --set seed=N)")
    up.add_argument("--view", action="store_true", help="open the viewer")
    up.add_argument("--recordings", type=Path, default=Path("recordings"), metavar="DIR", help="where recordings go")
    _add_graph(_add(commands, "check", _check, "check a graph file: keys, settings, classes and every edge's type"))
    _add_graph(_add(commands, "graph", _graph, "print a graph as a Mermaid flow chart"))
    _add(commands, "schema", _schema, "print the JSON Schema of graph files")
    _add_recordings(commands)
    return parser


def _add_recordings(commands: Commands) -> None:
    replay = _add(commands, "replay", _replay, "execute the stages of a recording again from what they consumed")
    replay.add_argument("file", type=Path, metavar="FILE", help="a recording")
    replay.add_argument("--verify", action="store_true", help="compare every message byte for byte")
    _add_settings(replay)
    info = _add(commands, "info", _info, "say what a recording holds and whether it is complete")
    info.add_argument("file", type=Path, metavar="FILE", help="a recording")
    view = _add(commands, "view", _view, "show a recording, or a graph while it runs")
    view.add_argument("file", type=Path, metavar="FILE", nargs="?", help="a recording")
    view.add_argument("--live", action="store_true", help="follow the run that is being recorded")
    view.add_argument("--save", type=Path, metavar="RRD", help="write a Rerun file instead of opening the viewer")
    view.add_argument("--png", type=Path, metavar="PNG", help="write a picture instead of opening the viewer")


def _add(commands: Commands, name: str, command: Command, text: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(name, help=text, description=text.capitalize() + ".")
    parser.set_defaults(command=command)
    return parser


def _add_graph(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("graph", type=Path, metavar="GRAPH", help="a graph file")
    _add_settings(parser)


def _add_settings(parser: argparse.ArgumentParser) -> None:
    text = "change a setting, for example camera.dataset=DIR; may be given again"
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE", dest="settings", help=text)


def _up(options: argparse.Namespace) -> int:
    from runner.graph import load_graph
    from runner.supervisor import Supervisor
    from runner.terminal import Terminal

    seed = [] if options.seed is None else [f"seed={options.seed}"]
    settings = (*options.settings, *seed)
    graph = load_graph(options.graph, settings)
    terminal = Terminal()
    supervisor = Supervisor(graph, recordings=options.recordings, settings=settings, terminal=terminal)
    end = supervisor.run(view=options.view)
    terminal.plain(end.reason)
    return end.code


def _check(options: argparse.Namespace) -> int:
    from runner.graph import load_graph

    graph = load_graph(options.graph, options.settings)
    edges = sum(len(node.inputs) for node in graph.nodes.values())
    print(f"{options.graph}: {len(graph.nodes)} stages, {len(graph.processes())} processes, {edges} edges: good")
    return 0


def _graph(options: argparse.Namespace) -> int:
    from runner.graph import load_graph, mermaid

    print(mermaid(load_graph(options.graph, options.settings)))
    return 0


def _schema(_: argparse.Namespace) -> int:
    from runner.graph import graph_schema

    print(json.dumps(graph_schema(), indent=2))
    return 0


def _replay(options: argparse.Namespace) -> int:
    from runner.replay import replay

    return replay(options.file, verify=options.verify, assignments=options.settings)


def _info(options: argparse.Namespace) -> int:
    from runner.info import describe

    print(describe(options.file))
    return 0


def _view(options: argparse.Namespace) -> int:
    from runner.view import view_live, view_recording

    if options.live:
        view_live(options.file)
    elif options.file is None:
        raise Refused("runner view: name a recording, or --live")
    else:
        view_recording(options.file, save=options.save, png=options.png)
    return 0


if __name__ == "__main__":
    sys.exit(main())
