"""Executes the stages of a recording again from what they consumed and compares every message they emitted.

Devices are not executed: what they emitted is taken from the recording. Each task, one stage's process as it
lived, runs in a fresh process of its own.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import msgspec

from runner.contract import Refused, Tolerances
from runner.document import Document
from runner.graph import Graph, Node, graph_from_json
from runner.info import seconds, table
from runner.recording import Recording, replicated
from runner.summary import Summary
from runner.tasks import Comparison, Reenactment, Result, Task, steps_of
from runner.tolerances import Origin, load_tolerances
from runner.workshop import Job, run_each

Say = Callable[[str], None]


def read(path: Path, assignments: Sequence[str] = ()) -> tuple[Recording, Graph]:
    """A recording and its graph, changed by ``--set`` assignments; raises Refused where either is not readable."""
    recording = Recording(path)
    return recording, graph_from_json(changed_graph(recording, assignments), str(path))


def changed_graph(recording: Recording, assignments: Sequence[str]) -> str:
    """JSON of the recorded graph with ``--set`` assignments applied."""
    document = Document(str(recording.path), Path.cwd(), json.loads(json.dumps(recording.graph)))
    for assignment in assignments:
        document.set(assignment)
    return json.dumps(document.values)


def plan(path: Path, say: Say) -> int:
    """Says what a replay would execute."""
    recording, graph = read(path)
    say(f"{path}: {recording.verdict}")
    for line in _plan(recording, graph):
        say(line)
    return 0


def _plan(recording: Recording, graph: Graph) -> list[str]:
    names = {node.name for node in executed(graph)}
    rows: list[tuple[str, ...]] = []
    for name in graph.nodes:
        steps = [step for step in recording.steps if step.stage == name]
        fate = "executed again" if name in names else "device: its messages are taken from the recording"
        rows.append((name, fate, str(len(steps)), seconds(sum(step.computed_ns for step in steps))))
    return table(("stage", "in a replay", "steps", "computed"), rows)


def executed(graph: Graph) -> list[Node]:
    """The stages that a replay executes: all that are no device."""
    return [node for node in graph.nodes.values() if not node.type.cls.device]


def verify(path: Path, assignments: Sequence[str], *, workers: int | None, say: Say) -> int:
    """Executes everything again in ``workers`` processes at a time (None: one a core) and compares every byte.

    Returns 0 where every message is identical, or where this machine is another and every message within the
    graph's tolerances; else 1. Raises Refused where the file is no recording.
    """
    began = time.perf_counter()
    recording, graph = read(path, assignments)
    origin = Origin(recording)
    for line in origin.lines():
        say(line)
    say(f"{path}: {recording.verdict}")
    verification = _Verification(recording, graph, {} if origin.same else load_tolerances(graph), say)
    return verification.conclude(verification.run(workers or len(os.sched_getaffinity(0))), began)


class _Verification:
    """One replay of everything."""

    def __init__(self, recording: Recording, graph: Graph, tolerances: Tolerances, say: Say) -> None:
        self._recording = recording
        self._graph = graph
        self._tolerances = tolerances
        self._say = say

    def run(self, workers: int) -> list[Result]:
        """Executes every task and says how each ended."""
        results: list[Result] = []
        tasks = tasks_of(self._recording, executed(self._graph), workers)
        with tempfile.TemporaryDirectory() as folder:
            jobs = [Job(task, lambda task=task: self._work(task, Path(folder))) for task in tasks]
            for task, answer in run_each(jobs, workers=workers, folder=Path(folder)):
                failed = isinstance(answer, str)
                result = Result(failure=answer) if failed else msgspec.json.decode(answer, type=Result)
                self._say(f"{task}: {result}")
                results.append(result)
        return results

    def _work(self, task: Task, folder: Path) -> bytes:
        """Executes one task; runs in the task's own process."""
        try:
            return msgspec.json.encode(self._result(task, folder))
        except Refused as refusal:
            return msgspec.json.encode(Result(failure=str(refusal)))

    def _result(self, task: Task, folder: Path) -> Result:
        node, began = self._graph.nodes[task.stage], time.perf_counter()
        steps = steps_of(self._recording, task, node)
        again = Reenactment(self._recording, node, steps, seed=self._graph.seed, directory=_files(folder))
        startup = time.perf_counter() - began
        comparison = Comparison(self._recording, node, self._tolerances)
        for step in steps:
            comparison.add(again.execute(step))
        again.stage.close()
        return comparison.result(again.seconds, startup)

    def conclude(self, results: Sequence[Result], began: float) -> int:
        """The verdict, what differs by field, and the exit status."""
        wall = time.perf_counter() - began
        for line in Summary(change for result in results for change in result.changes).lines():
            self._say(line)
        self._say(
            f"replayed in {wall:.1f} s: handlers took {sum(result.seconds for result in results):.1f} s, "
            f"when recorded {sum(self._computed()) * 1e-9:.1f} s; "
            f"constructing the stages {sum(result.startup for result in results):.1f} s"
        )
        return self._verdict(results)

    def _verdict(self, results: Sequence[Result]) -> int:
        names = [node.name for node in executed(self._graph)]
        compared, within = sum(result.messages for result in results), sum(result.within for result in results)
        found = sorted((result.first for result in results if result.first), key=lambda found: found.position)
        verdict = self._recording.verdict
        if found:
            self._say(f"DIVERGED first at {found[0]}")
            return 1
        if any(result.failure for result in results) or not verdict.complete:
            expected = emitted_by(names, self._recording)
            none = "none differs" if not within else f"{within} within tolerances, none beyond"
            self._say(f"NOT VERIFIED: {compared} of {expected} messages compared, {none}; {verdict}")
            return 1
        if within:
            counts = f"{within} of {compared} messages of {len(names)} stages differ"
            self._say(f"WITHIN TOLERANCES: {counts}, no field by more than {self._graph.tolerances} allows")
        else:
            self._say(f"IDENTICAL: {compared} messages of {len(names)} stages")
        return 0

    def _computed(self) -> Iterator[int]:
        names = {node.name for node in executed(self._graph)}
        return (step.computed_ns for step in self._recording.steps if step.stage in names)


def _files(folder: Path) -> Path:
    """An empty folder for what a stage writes."""
    return Path(tempfile.mkdtemp(dir=folder))


def tasks_of(recording: Recording, nodes: Iterable[Node], workers: int) -> list[Task]:
    """Every task of a replay, longest first, so that the workers end together."""
    cost: dict[tuple[str, int], int] = defaultdict(int)
    shared, kinds = replicated(recording.graph), {node.name: node.type.cls for node in nodes}
    for step in recording.steps:
        if step.stage in kinds:
            together = step.stage in shared or kinds[step.stage].stateful
            cost[step.stage, 0 if together else step.incarnation] += step.computed_ns
    tasks: list[Task] = []
    for stage, incarnation in sorted(cost, key=lambda key: -cost[key]):
        shares = workers if stage in shared else 1
        tasks += [Task(stage, incarnation, share, shares) for share in range(shares)]
    return tasks


def emitted_by(stages: Sequence[str], recording: Recording) -> int:
    """How many recorded messages these stages emitted."""
    return sum(message.topic.partition("/")[0] in stages for message in recording.messages.values())
