"""Executes the stages of a recording again from what they consumed and compares every message they emitted.

Devices are not executed: what they emitted is taken from the recording. Each task, one stage's process as it
lived, runs in a fresh process of its own.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, cast

import msgspec

from runner.contract import Refused, Tolerance, Tolerances
from runner.graph.document import Document, suggest
from runner.graph.graph import Graph, Node, graph_from_json, graph_to_json, node_from_entry
from runner.graph.references import load_class, load_tolerances
from runner.inspect.info import seconds, table
from runner.inspect.summary import Summary
from runner.message.ids import MessageId
from runner.recording.recording import Recording, replicated
from runner.replay.tasks import Comparison, Reexecution, Result, Task, steps_of
from runner.replay.tolerances import Origin
from runner.replay.workers import Job, run_each

Say = Callable[[str], None]


def change(recording: Recording, assignments: Sequence[str] = (), swaps: Sequence[str] = ()) -> Graph:
    """The recorded graph with other settings and classes."""
    document = Document(str(recording.path), Path.cwd(), deepcopy(recording.graph))
    for swap in swaps:
        _swap(document, swap)
    for assignment in assignments:
        document.set(assignment)
    return graph_from_json(json.dumps(document.values), str(recording.path))


def _swap(document: Document, swap: str) -> None:
    """Another class for a stage; it keeps the settings that it knows."""
    stage, equals, reference = swap.partition("=")
    if not equals or ":" not in reference:
        raise Refused(f"--swap {swap}: expected stage=module:Class, for example --swap ranker=mine:Ranker")
    stages = cast("dict[str, dict[str, Any]]", document.values["stages"])
    if stage not in stages:
        raise Refused(f"--swap {swap}: no stage {stage!r}{suggest(stage, stages)}")
    config = getattr(load_class(reference, f"--swap {swap}"), "Config", None)
    known = {setting.name for setting in fields(config)} if is_dataclass(config) else set[str]()
    kept = {key: value for key, value in stages[stage].get("config", {}).items() if key in known}
    stages[stage] |= {"stage": reference, "config": kept}


def plan(path: Path, say: Say) -> int:
    """Says what a replay would execute."""
    recording = Recording(path)
    recording.require_messages()
    rows: list[tuple[str, ...]] = []
    for name, node in change(recording).nodes.items():
        steps = [step for step in recording.steps if step.stage == name]
        treatment = "device: its messages are taken from the recording" if node.type.cls.device else "executed again"
        rows.append((name, treatment, str(len(steps)), seconds(sum(step.computed_ns for step in steps))))
    for line in (f"{path}: {recording.verdict}", *table(("stage", "in a replay", "steps", "computed"), rows)):
        say(line)
    return 0


def verify(path: Path, assignments: Sequence[str], *, workers: int | None, say: Say) -> int:
    """Executes everything again in ``workers`` processes at a time (None: one a core) and compares every byte.

    Returns 0 where every message is identical, or where this machine is another and every message within the
    graph's tolerances; else 1. Raises Refused where the file is no recording.
    """
    began = time.perf_counter()
    recording = Recording(path)
    recording.require_messages()
    origin = Origin(recording)
    for line in origin.lines():
        say(line)
    say(f"{path}: {recording.verdict}")
    values, tolerances = recording.graph, dict[str, Tolerance]()
    if assignments or not origin.same:  # else it was checked when it was recorded: classes are imported as they come
        graph = change(recording, assignments)
        values, tolerances = json.loads(graph_to_json(graph)), {} if origin.same else _tolerances(graph)
    verification = _Verification(recording, values, tolerances, say)
    return verification.conclude(verification.run(workers or len(os.sched_getaffinity(0))), began)


def _tolerances(graph: Graph) -> Tolerances:
    return load_tolerances(graph.tolerances, f"tolerances of graph {graph.name!r}")


class _Verification:
    """One replay of everything."""

    def __init__(self, recording: Recording, graph: dict[str, Any], tolerances: Tolerances, say: Say) -> None:
        self._recording = recording
        self._graph = graph
        self._tolerances = tolerances
        self._say = say
        self._executed: list[str] = []

    def run(self, workers: int) -> list[Result]:
        """Executes every task and says how each ended."""
        results: list[Result] = []
        with tempfile.TemporaryDirectory() as folder:
            jobs = self._jobs(workers, Path(folder))
            for task, answer in run_each(jobs, workers=workers, folder=Path(folder)):
                failed = isinstance(answer, str)
                result = Result(failure=answer) if failed else msgspec.json.decode(answer, type=Result)
                self._say(f"{task}: {result}")
                results.append(result)
        return results

    def _jobs(self, workers: int, folder: Path) -> Iterator[Job[Task]]:
        """Every task, longest stages first, so that the workers end together; each is imported when it is drawn."""
        for stage in _by_cost(self._recording):
            node = node_from_entry(stage, self._graph["stages"][stage])
            if not node.type.cls.device:
                self._executed.append(stage)
                node.prepare()
                for task in tasks_of(self._recording, node, workers):
                    yield Job(task, lambda node=node, task=task: self._work(node, task, folder))

    def _work(self, node: Node, task: Task, folder: Path) -> bytes:
        """Executes one task; runs in the task's own process."""
        try:
            return msgspec.json.encode(self._result(node, task, folder))
        except Refused as refusal:
            return msgspec.json.encode(Result(failure=str(refusal)))

    def _result(self, node: Node, task: Task, folder: Path) -> Result:
        began = time.process_time()
        steps, files = steps_of(self._recording, task, node), Path(tempfile.mkdtemp(dir=folder))
        again = Reexecution(self._recording, node, steps, seed=self._graph["seed"], directory=files)
        startup = time.process_time() - began
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
        recorded = sum(step.computed_ns for step in self._recording.steps if step.stage in self._executed)
        computed, startup = sum(result.seconds for result in results), sum(result.startup for result in results)
        self._say(
            f"replayed in {wall:.1f} s: handlers took {computed:.1f} s of processor time (when recorded "
            f"{recorded * 1e-9:.1f} s), constructing the stages {startup:.1f} s"
        )
        return self._verdict(results)

    def _verdict(self, results: Sequence[Result]) -> int:
        stages = f"of {len(self._executed)} stages"
        compared, within = sum(result.messages for result in results), sum(result.within for result in results)
        found = sorted((result.first for result in results if result.first), key=lambda found: found.position)
        verdict = self._recording.verdict
        if found:
            self._say(f"DIVERGED first at {found[0]}")
            return 1
        if any(result.failure for result in results) or not verdict.complete:
            expected = sum(MessageId.of(id).stage in self._executed for id in self._recording.messages)
            none = "none differs" if not within else f"{within} within tolerances, none beyond"
            self._say(f"NOT VERIFIED: {compared} of {expected} messages compared, {none}; {verdict}")
            return 1
        if within:
            table = self._graph.get("tolerances")
            self._say(
                f"WITHIN TOLERANCES: {within} of {compared} messages {stages} differ, none by more than {table} allows"
            )
        else:
            self._say(f"IDENTICAL: {compared} messages {stages}")
        return 0


def _by_cost(recording: Recording) -> list[str]:
    """The stages that took steps, those that computed longest first."""
    cost: Counter[str] = Counter()
    for step in recording.steps:
        cost[step.stage] += step.computed_ns
    return [stage for stage, _ in cost.most_common() if stage in recording.graph["stages"]]


def tasks_of(recording: Recording, node: Node, workers: int) -> list[Task]:
    """Every task of one stage: shares of what its replicas did, one for a stateful stage, else one a process."""
    if node.name in replicated(recording.graph):
        return [Task(node.name, 0, share, workers) for share in range(workers)]
    lived = {step.incarnation for step in recording.steps if step.stage == node.name}
    return [Task(node.name, incarnation) for incarnation in ([0] if node.type.cls.stateful else sorted(lived))]
