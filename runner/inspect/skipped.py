"""What edges of policy ``latest`` have left out."""

from collections import Counter
from collections.abc import Iterator

from runner.graph.graph import Graph
from runner.message.codec import Step
from runner.message.ids import MessageId


class Skipped:
    """Counts, step by step, what was emitted and what was consumed."""

    def __init__(self, graph: Graph) -> None:
        self._edges = {
            (node.name, port): f"{edge.stage}/{edge.port}"
            for node in graph.nodes.values()
            for port, edge in node.inputs.items()
            if edge.policy == "latest"
        }
        self._emitted = Counter[str]()
        self._consumed = Counter[tuple[str, str]]()

    def note(self, step: Step) -> None:
        """Counts one step."""
        self._emitted.update(MessageId.of(id).topic for id in step.emitted)
        self._consumed.update((step.stage, port) for port, _ in step.consumed)

    def lines(self) -> Iterator[str]:
        """One for each edge of policy ``latest`` that did not pass on everything."""
        for (stage, port), source in self._edges.items():
            total = self._emitted[source]
            left_out = total - self._consumed[stage, port]
            if left_out > 0:
                yield f"{stage}.{port}: {left_out} of {total} messages skipped (policy latest)"
