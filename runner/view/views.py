"""The views that a graph names: what each of its messages shows, whatever shows it."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Generator
from importlib.util import find_spec

from runner.contract import Refused
from runner.graph.graph import Graph
from runner.message.codec import Envelope, open_envelope
from runner.recording.recording import kind_of
from runner.view.drawing import Drawing, NextStep, Views


def require(module: str, what: str, extra: str) -> None:
    """Raises Refused where ``what`` is not installed, a module that comes with an extra."""
    if find_spec(module) is None:
        raise Refused(f"{what} is missing; type: pip install 'scene-programming[{extra}]'")


def require_viewer() -> None:
    """Raises Refused where Rerun is not installed."""
    require("rerun", "the viewer is Rerun, which", "view")


def drawn(graph: Graph, views: Views, sealed: Envelope) -> list[list[Drawing]]:
    """What one message shows, step by step; what cannot be drawn is named on stderr and left out."""
    steps: list[list[Drawing]] = [[]]
    with leaving_out(sealed.id):
        if (kind := kind_of(graph, sealed.id)) is not None:
            for drawing in views.draw(open_envelope(kind, sealed)):
                if isinstance(drawing, NextStep):
                    steps.append([])
                else:
                    steps[-1].append(drawing)
    return steps


@contextlib.contextmanager
def leaving_out(what: str) -> Generator[None]:
    """Names on stderr what cannot be drawn: the rest of the recording is still worth seeing."""
    try:
        yield
    except Exception as error:
        reason = str(error).partition("\n")[0]
        print(f"{what} cannot be drawn: {type(error).__name__}: {reason}", file=sys.stderr)


def load_views(graph: Graph) -> Views:
    """The views a graph names; raises Refused where it names none or they cannot be loaded."""
    if graph.view is None:
        raise Refused(f"graph {graph.name!r} names no views; valid: a line `view: module:Class` in the graph file")
    return graph.load("view", graph.view, Views)
