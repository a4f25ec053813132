"""Commands on graph files: ``up``, ``check``, ``graph``, ``schema``."""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
from typing import TYPE_CHECKING

from runner.cli.commands import Commands, add, add_graph, add_recordings, add_settings, graph_file
from runner.contract import Refused, Scorer
from runner.terminal import Terminal

if TYPE_CHECKING:
    from runner.graph.document import Document
    from runner.hosts.head import Dismiss
    from runner.supervise.guardian import End


def add_commands(commands: Commands) -> None:
    """Adds the commands of this group."""
    up = add(commands, "up", _up, "run a graph, record it, and exit as it ends")
    add_graph(up)
    up.add_argument("--seed", type=int, help="root of all random numbers (short for --set seed=N)")
    armed = "the operator's word that what can move may: sets armed=true for every stage that the graph says it of"
    up.add_argument("--arm", action="store_true", help=armed)
    where = up.add_mutually_exclusive_group()
    where.add_argument("--host", metavar="NAME", help="start the processes of this host of the graph only")
    where.add_argument("--here", action="store_true", help="start the processes of all hosts on this machine")
    add_recordings(up, "where recordings go")
    up.add_argument(
        "--verbose",
        action="store_true",
        help="keep every line, say when each process is ready, and what stages say for debugging",
    )
    seen = up.add_mutually_exclusive_group()
    seen.add_argument("--view", action="store_true", help="open the viewer")
    seen.add_argument("--steps-only", action="store_true", help="record no messages: nothing can be replayed")
    text = "serve a page for people who do not program; only this machine can open it"
    up.add_argument("--page", action="store_true", help=text)
    add_graph(add(commands, "check", _check, "check a graph file: keys, settings, classes and every edge's type"))
    add_graph(add(commands, "graph", _graph, "print a graph as a Mermaid flow chart"))
    schema = add(commands, "schema", _schema, "print the JSON Schema of graph files, or of all messages of a graph")
    schema.add_argument("graph", type=graph_file, nargs="?", metavar="GRAPH", help="whose messages, by STAGE/PORT")
    add_settings(schema)


def _up(options: argparse.Namespace) -> int:
    from runner.graph.document import read_document
    from runner.graph.placement import refuse_settings
    from runner.process.forks import become_clean

    if options.view:
        from runner.view.views import require_viewer

        require_viewer()
    seed = [] if options.seed is None else [f"seed={options.seed}"]
    document = read_document(options.graph)
    options.settings = (*options.settings, *seed, *(_armed(document) if options.arm else ()))
    for setting in options.settings:
        document.set(setting)
    host = None if options.here else _other_host(options, document)
    if host is not None:
        refuse_settings(options.settings, host)
    become_clean("runner.cli", *options.arguments)
    with contextlib.closing(Terminal(verbose=options.verbose, waits=False)) as terminal:
        end = _supervise(options, terminal) if host is None else _take_part(options, document, host, terminal)
        terminal.plain(end.reason)
    return end.code


def _armed(document: Document) -> list[str]:
    """Settings that give the operator's word to every stage that waits for it."""
    stages = document.values.get("stages")
    entries = stages.items() if isinstance(stages, dict) else ()
    found = [name for name, entry in entries if isinstance(entry, dict) and "armed" in (entry.get("config") or ())]
    if not found:
        raise Refused(f"{document.label}: --arm: no stage has the setting 'armed'")
    return [f"{name}.armed=true" for name in found]


def _supervise(options: argparse.Namespace, terminal: Terminal) -> End:
    """Imports all that the graph's processes need, then forks what they are forked from, and only then begins."""
    from runner.graph.graph import SUPERVISOR
    from runner.graph.reading import load_graph
    from runner.page.start import page_beside, require_page
    from runner.process.fork_server import ForkServer
    from runner.supervise.supervisor import Supervisor

    gc.disable()  # until it forks: what is imported stays
    graph = load_graph(options.graph, options.settings)
    if options.page or graph.page:
        require_page()
    if options.view:
        from runner.view.views import load_views

        load_views(graph)
    forks = ForkServer(lambda text: terminal.show(SUPERVISOR, text, "warning"))
    supervisor = Supervisor(
        graph.here() if options.here else graph,
        file=options.graph,
        recordings=options.recordings,
        settings=options.settings,
        terminal=terminal,
        forks=forks,
        steps_only=options.steps_only,
    )
    with page_beside(supervisor.id, terminal.plain) if options.page or graph.page else contextlib.nullcontext():
        return supervisor.run(view=options.view)


def _other_host(options: argparse.Namespace, document: Document) -> str | None:
    """The host that this machine is, None where it has the supervisor; raises Refused where that is not clear."""
    from runner.graph.placement import choose_host, read_layout

    layout = read_layout(document)
    chosen = choose_host(layout, options.host, options.graph)
    return None if not layout.hosts or chosen == layout.head.name else chosen


def _take_part(options: argparse.Namespace, document: Document, host: str, terminal: Terminal) -> Dismiss:
    from runner.hosts.agent import Agent
    from runner.process.fork_server import ForkServer

    forks = ForkServer(lambda text: terminal.show(host, text, "warning"))
    return Agent(document, host, recordings=options.recordings, terminal=terminal, forks=forks).run()


def _check(options: argparse.Namespace) -> None:
    from runner.graph.reading import load_graph
    from runner.graph.references import load_class
    from runner.page.story import Story
    from runner.view.drawing import Views

    graph = load_graph(options.graph, options.settings)
    named = (("view", graph.view, Views), ("story", graph.story, Story), ("score", graph.score, Scorer))
    for key, reference, wanted in named:
        if reference is not None:
            load_class(reference, f"{options.graph}: {key}", wanted)
    commands = len(graph.commands())
    edges = sum(len(node.inputs) for node in graph.nodes.values()) - commands
    counts = (f"{len(graph.nodes)} stages", f"{len(graph.processes())} processes", f"{edges} edges")
    print(f"{options.graph}: {', '.join(counts)}{f', {commands} commands' if commands else ''}: good")


def _graph(options: argparse.Namespace) -> None:
    from runner.graph.graph import mermaid
    from runner.graph.reading import load_graph

    print(mermaid(load_graph(options.graph, options.settings)))


def _schema(options: argparse.Namespace) -> None:
    from runner.graph.reading import graph_schema, load_graph
    from runner.message.codec import json_schema

    if options.graph is None:
        described = graph_schema()
    else:
        topics = load_graph(options.graph, options.settings).topics()
        described = {topic: json_schema(kind) for topic, kind in topics.items()}
    print(json.dumps(described, indent=2))
