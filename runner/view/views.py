"""The views that a graph names: what each of its messages shows, whatever shows it."""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec
from typing import cast

from runner.contract import Refused
from runner.graph.graph import Graph, node_entry
from runner.message.codec import Envelope, open_envelope
from runner.message.ids import MessageId
from runner.view.drawing import Drawing, Views


def require_viewer() -> None:
    """Raises Refused where Rerun, which is an extra, is not installed."""
    if find_spec("rerun") is None:
        raise Refused("the viewer is Rerun, which is missing; type: pip install 'scene-programming[view]'")


def drawn(graph: Graph, views: Views, sealed: Envelope) -> list[Drawing]:
    """What one message shows; what cannot be drawn is named on stderr and left out."""
    id = MessageId.of(sealed.id)
    found: list[Drawing] = []
    try:
        if (kind := graph.outputs_of(id.stage).get(id.port)) is not None:
            found.extend(views.draw(open_envelope(kind, sealed)))
    except Exception as error:  # the rest of the recording is still worth seeing
        reason = str(error).partition("\n")[0]
        print(f"{sealed.id} cannot be drawn: {type(error).__name__}: {reason}", file=sys.stderr)
    return found


def load_views(graph: Graph) -> Views:
    """The views a graph names; raises Refused where it names none or they cannot be loaded."""
    if graph.view is None:
        raise Refused(f"graph {graph.name!r} names no views; valid: a line `view: module:Class` in the graph file")
    module, _, name = graph.view.partition(":")
    try:
        views = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise Refused(f"view {graph.view!r} of graph {graph.name!r} cannot be loaded: {error}") from None
    return cast("Views", views({name: node_entry(node)["config"] for name, node in graph.nodes.items()}))
