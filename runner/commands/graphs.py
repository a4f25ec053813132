"""Commands on graph files: ``up``, ``check``, ``graph``, ``schema``."""

import argparse
import json
from pathlib import Path

from runner.commands import Commands, add, add_graph


def add_commands(commands: Commands) -> None:
    """Adds the commands of this group."""
    up = add(commands, "up", _up, "run a graph, record it, and exit as it ends")
    add_graph(up)
    up.add_argument("--seed", type=int, help="root of all random numbers (short for --set seed=N)")
    up.add_argument("--view", action="store_true", help="open the viewer")
    up.add_argument("--recordings", type=Path, default=Path("recordings"), metavar="DIR", help="where recordings go")
    add_graph(add(commands, "check", _check, "check a graph file: keys, settings, classes and every edge's type"))
    add_graph(add(commands, "graph", _graph, "print a graph as a Mermaid flow chart"))
    add(commands, "schema", _schema, "print the JSON Schema of graph files")


def _up(options: argparse.Namespace) -> int:
    from runner.graph import load_graph
    from runner.supervisor import Supervisor
    from runner.terminal import Terminal

    seed = [] if options.seed is None else [f"seed={options.seed}"]
    settings = (*options.settings, *seed)
    graph = load_graph(options.graph, settings)
    terminal = Terminal()
    supervisor = Supervisor(
        graph, file=options.graph, recordings=options.recordings, settings=settings, terminal=terminal
    )
    end = supervisor.run(view=options.view)
    terminal.plain(end.reason)
    return end.code


def _check(options: argparse.Namespace) -> int:
    from runner.graph import load_graph

    graph = load_graph(options.graph, options.settings)
    commands = len(graph.commands())
    edges = sum(len(node.inputs) for node in graph.nodes.values()) - commands
    counts = (f"{len(graph.nodes)} stages", f"{len(graph.processes())} processes", f"{edges} edges")
    print(f"{options.graph}: {', '.join(counts)}{f', {commands} commands' if commands else ''}: good")
    return 0


def _graph(options: argparse.Namespace) -> int:
    from runner.graph import load_graph, mermaid

    print(mermaid(load_graph(options.graph, options.settings)))
    return 0


def _schema(_: argparse.Namespace) -> int:
    from runner.graph import graph_schema

    print(json.dumps(graph_schema(), indent=2))
    return 0
