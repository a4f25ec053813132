"""What edges of policy ``latest`` have left out."""

from collections import Counter
from collections.abc import Iterable, Iterator

from runner.graph.graph import Graph
from runner.message.codec import Step
from runner.message.ids import MessageId


def skipped(graph: Graph, steps: Iterable[Step]) -> Iterator[str]:
    """One line for each edge of policy ``latest`` that did not pass on everything."""
    emitted: Counter[str] = Counter()
    consumed: Counter[tuple[str, str]] = Counter()
    for step in steps:
        emitted.update(MessageId.of(id).topic for id in step.emitted)
        consumed.update((step.stage, port) for port, _ in step.consumed)
    for node in graph.nodes.values():
        for port, edge in node.inputs.items():
            total = emitted[f"{edge.stage}/{edge.port}"]
            left_out = total - consumed[node.name, port]
            if edge.policy == "latest" and left_out > 0:
                yield f"{node.name}.{port}: {left_out} of {total} messages skipped (policy latest)"
