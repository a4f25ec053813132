"""Executes the stages of a recording again from what they consumed and compares every message they emitted.

Devices are not executed: what they emitted is taken from the recording. Each task, one stage's process as it
lived, runs in a fresh process of its own.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from dataclasses import fields, is_dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import msgspec

from runner.contract import Refused, Tolerance, Tolerances
from runner.graph.document import Document, suggest
from runner.graph.graph import Graph, Node, graph_to_json
from runner.graph.reading import graph_from_json, node_from_entry
from runner.graph.references import load_class, load_tolerances
from runner.inspect.info import seconds, table
from runner.inspect.summary import Summary
from runner.message.ids import MessageId
from runner.recording.recording import Recording, replicated
from runner.replay.tasks import Comparison, Reexecution, Result, Task, steps_of
from runner.replay.tolerances import compare_origin
from runner.replay.workers import Job, run_each
from runner.terminal import listed


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
    stages = document.values["stages"]
    if stage not in stages:
        raise Refused(f"--swap {swap}: no stage {stage!r}{suggest(stage, stages)}")
    config = getattr(load_class(reference, f"--swap {swap}"), "Config", None)
    known = {setting.name for setting in fields(config)} if is_dataclass(config) else set[str]()
    kept = {key: value for key, value in stages[stage].get("config", {}).items() if key in known}
    stages[stage] |= {"stage": reference, "config": kept}


def plan(path: Path) -> list[str]:
    """What a replay would execute, as lines."""
    recording = Recording(path)
    recording.require_messages()
    rows: list[tuple[str, ...]] = []
    for name, node in change(recording).nodes.items():
        steps = [step for step in recording.steps if step.stage == name]
        treatment = "device: its messages are taken from the recording" if node.type.cls.device else "executed again"
        rows.append((name, treatment, str(len(steps)), seconds(sum(step.computed_ns for step in steps))))
    return [f"{path}: {recording.verdict}", *table(("stage", "in a replay", "steps", "computed"), rows)]


def verify(path: Path, assignments: Sequence[str], *, workers: int) -> int:
    """Executes everything again in ``workers`` processes at a time and compares every byte.

    Prints what comes of it. Returns 0 where every message of a step is identical, or where this machine is another and
    every one within the graph's tolerances; else 1, also of no message. Raises Refused where the file is no recording.
    """
    began = time.perf_counter()
    recording = Recording(path)
    recording.require_messages()
    same, changes = compare_origin(recording)
    print(*changes, f"{path}: {recording.verdict}", sep="\n")
    values, tolerances = recording.graph, dict[str, Tolerance]()
    if assignments or not same:  # else it was checked when it was recorded: classes are imported as they come
        graph = change(recording, assignments)
        values = json.loads(graph_to_json(graph))
        if not same:
            tolerances = load_tolerances(graph.tolerances, f"tolerances of graph {graph.name!r}")
    results: dict[Task, Result] = {}
    for task, result in _results(recording, values, tolerances, workers):
        print(f"{task}: {result}")
        results[task] = result
    found = Summary(change for result in results.values() for change in result.changes)
    code, verdict = _verdict(recording, values, results)
    print(*found.lines(), _cost(recording, results, time.perf_counter() - began), verdict, sep="\n")
    return code


def _results(
    recording: Recording, graph: dict[str, Any], tolerances: Tolerances, workers: int
) -> Iterator[tuple[Task, Result]]:
    """Executes every task in a process of its own and says how each ended.

    Longest stages come first, so that the workers end together; each is imported when it is drawn.
    """
    with tempfile.TemporaryDirectory() as folder:

        def jobs() -> Iterator[tuple[Task, Job]]:
            for stage in _by_cost(recording):
                node = node_from_entry(stage, graph["stages"][stage])
                if not node.type.cls.device:
                    node.prepare()
                    execute = partial(
                        _execute, recording, node, seed=graph["seed"], tolerances=tolerances, folder=folder
                    )
                    yield from ((task, partial(execute, task)) for task in tasks_of(recording, node, workers))

        for task, answer in run_each(jobs(), workers=workers, folder=Path(folder)):
            failed = isinstance(answer, str)
            yield task, Result(failure=answer) if failed else msgspec.json.decode(answer, type=Result)


@contextmanager
def _execute(
    recording: Recording, node: Node, task: Task, *, seed: int, tolerances: Tolerances, folder: str
) -> Generator[bytes]:
    """Executes one task; runs in the task's own process. The stage is closed once its result has been taken."""
    began = time.process_time()
    steps, files = steps_of(recording, task, node), Path(tempfile.mkdtemp(dir=folder))
    comparison = Comparison(recording, node, tolerances)
    result = comparison.result
    with ExitStack() as stack:
        try:
            again = Reexecution(recording, node, steps, seed=seed, directory=files)
            stack.callback(again.stage.close)
            result.startup = time.process_time() - began
            for step in steps:
                comparison.add(again.execute(step))
            result.seconds, result.changes = again.seconds, tuple(comparison.summary.changes)
        except Refused as refusal:
            result = Result(failure=str(refusal))
        yield msgspec.json.encode(result)


def _cost(recording: Recording, results: Mapping[Task, Result], wall: float) -> str:
    executed = {task.stage for task in results}
    recorded = sum(step.computed_ns for step in recording.steps if step.stage in executed)
    computed = sum(result.seconds for result in results.values())
    startup = sum(result.startup for result in results.values())
    return (
        f"replayed in {wall:.1f} s: handlers took {computed:.1f} s of processor time (when recorded "
        f"{recorded * 1e-9:.1f} s), constructing the stages {startup:.1f} s"
    )


def _verdict(recording: Recording, graph: Mapping[str, Any], results: Mapping[Task, Result]) -> tuple[int, str]:
    """The exit status and what it means."""
    executed = {task.stage for task in results}
    expected = [id for id in recording.messages if MessageId.of(id).stage in executed]
    compared = {id for result in results.values() for id in result.compared}
    within = sum(result.within for result in results.values())
    found = [result.first for result in results.values() if result.first]
    if found:
        return 1, f"DIVERGED first at {min(found, key=itemgetter(0))[1]}"
    if any(result.failure for result in results.values()) or not recording.verdict.complete or not compared:
        none = "none differs" if not within else f"{within} within tolerances, none beyond"
        return 1, f"NOT VERIFIED: {len(compared)} of {len(expected)} messages compared, {none}; {recording.verdict}"
    undone = [id for id in expected if id not in compared]
    counts = f"{len(compared)} of {len(expected)}" if undone else f"{len(compared)}"
    stages = f"of {len(executed)} stages"
    rest = f"; of no step that was done: {listed(undone)}" if undone else ""
    if within:
        allowed = f"none by more than {graph.get('tolerances')} allows"
        return 0, f"WITHIN TOLERANCES: {within} of {len(compared)} messages {stages} differ, {allowed}{rest}"
    return 0, f"IDENTICAL: {counts} messages {stages}{rest}"


def _by_cost(recording: Recording) -> list[str]:
    """The stages that took steps or sent messages, those that computed longest first."""
    cost = Counter({MessageId.of(id).stage: 0 for id in recording.messages})
    for step in recording.steps:
        cost[step.stage] += step.computed_ns
    return [stage for stage, _ in cost.most_common() if stage in recording.graph["stages"]]


def tasks_of(recording: Recording, node: Node, workers: int) -> list[Task]:
    """Every task of one stage: shares of what its replicas did, one for a stateful stage, else one a process."""
    if node.name in replicated(recording.graph):
        return [Task(node.name, 0, share, workers) for share in range(workers)]
    lived = {step.incarnation for step in recording.steps if step.stage == node.name}
    incarnations = [0] if node.type.cls.stateful else sorted(lived) or [0]
    return [Task(node.name, incarnation) for incarnation in incarnations]
