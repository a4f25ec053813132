"""How long messages travel, queue and are worked on: by edge, by stage, and along the critical path of every look."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np

from runner.inspect.causes import Causes, last_recorded
from runner.inspect.info import Cells, seconds, table
from runner.message.codec import Step
from runner.message.ids import MessageId
from runner.recording.recording import Located, Recording

PATHS = 20
"""Critical paths that are shown, the longest first."""
HOPS = 6
"""Hops of a path that are named, the costliest."""


@dataclass(frozen=True, slots=True)
class CriticalPath:
    """What the last message of a lineage had to wait for, one step after the other."""

    lineage: str
    last: str
    elapsed_ns: int
    """From the first message to the last, as the recorder received them, which it does every few milliseconds; at
    least what the hops cost."""
    hops: tuple[Step, ...]


def latency(path: Path) -> list[str]:
    """The whole report; raises Refused where the file is no recording."""
    recording = Recording(path)
    causes = Causes(recording)
    paths = critical_paths(recording, causes)
    blocks = (
        [f"{path}: {recording.verdict}"],
        _edges(recording),
        _stages(recording.steps),
        _paths(paths[:PATHS]),
        [_path_line(found) for found in paths[:PATHS]],
    )
    return [line for block in blocks if block for line in (*block, "")][:-1]


def critical_paths(recording: Recording, causes: Causes) -> list[CriticalPath]:
    """One per lineage that a step followed on, the longest first."""
    lineages: dict[str, list[Located]] = defaultdict(list)
    for message in recording.messages.values():
        lineages[message.lineage].append(message)
    paths: list[CriticalPath] = []
    received = attrgetter("log_time_ns")
    for lineage, messages in lineages.items():
        first, last = min(messages, key=received), max(messages, key=received)
        steps = (causes.step_of(id) for id in causes.path_to(last.id)[1:])
        if hops := tuple(step for step in steps if step is not None):
            elapsed_ns = max(last.log_time_ns - first.log_time_ns, sum(map(_cost, hops)))
            paths.append(CriticalPath(lineage, last.id, elapsed_ns, hops))
    return sorted(paths, key=lambda path: -path.elapsed_ns)


def _cost(hop: Step) -> int:
    return hop.travelled_ns + hop.waited_ns + hop.computed_ns


# ------------------------------------------------------------------------------------ tables


def _edges(recording: Recording) -> list[str]:
    """A step's waiting is its last input's: what waits for a partner at a join is not late."""
    by_edge: dict[str, list[Step]] = defaultdict(list)
    unknown = 0
    for step in recording.steps:
        last = last_recorded(recording, (id for _, id in step.consumed))
        unknown += last is None and bool(step.consumed)
        if last is not None:
            port = next(port for port, id in step.consumed if id == last)
            by_edge[f"{MessageId.of(last).topic} -> {step.stage}.{port}"].append(step)
    rows = [
        (
            edge,
            str(len(steps)),
            *_spread([step.travelled_ns for step in steps]),
            *_spread([step.waited_ns for step in steps]),
        )
        for edge, steps in sorted(by_edge.items())
    ]
    left_out = f"left out: {unknown} steps that took several messages; no message is recorded that says which came last"
    return [*table(("edge", "count", "travel p50", "p99", "queue p50", "p99"), rows), *([left_out] if unknown else [])]


def _stages(steps: Iterable[Step]) -> list[str]:
    computed: dict[str, list[int]] = defaultdict(list)
    for step in steps:
        computed[f"{step.stage}.{step.handler}"].append(step.computed_ns)
    rows = ((name, str(len(times)), *_spread(times), seconds(sum(times))) for name, times in computed.items())
    return table(("handler", "count", "compute p50", "p99", "total"), sorted(rows))


def _spread(times: Sequence[int]) -> Cells:
    return [seconds(float(value)) for value in np.percentile(times, (50, 99))]


def _paths(paths: Iterable[CriticalPath]) -> list[str]:
    rows: list[Cells] = []
    for path in paths:
        sums = [sum(getattr(hop, name) for hop in path.hops) for name in ("travelled_ns", "waited_ns", "computed_ns")]
        rows.append((path.lineage, str(len(path.hops)), *map(seconds, (path.elapsed_ns, *sums)), path.last))
    return table(("critical path of", "hops", "elapsed", "travel", "queue", "compute", "up to"), rows)


def _path_line(path: CriticalPath) -> str:
    """The costliest hops in the order of the path; further visits of a stage are added to its first."""
    by_stage = Counter[str]()
    for hop in path.hops:
        by_stage[hop.stage] += _cost(hop)
    costly = {stage for stage, _ in by_stage.most_common(HOPS)}
    named = [f"{stage} {seconds(total)}" for stage, total in by_stage.items() if stage in costly]
    if rest := sum(total for stage, total in by_stage.items() if stage not in costly):
        named.append(f"others {seconds(rest)}")
    return f"{path.lineage}: {', '.join(named)}"
