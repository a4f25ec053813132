"""Describes a recording in readable tables: what ran, what was said, how long each step took, what is missing."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from runner.contract import Restarted
from runner.graph.graph import SUPERVISOR
from runner.graph.ports import port_name
from runner.message.codec import Step
from runner.recording.provenance import numerical
from runner.recording.recording import Located, Recording

Cells = Sequence[str]
RESTARTED = f"{SUPERVISOR}/{port_name(Restarted)}"


def describe(path: Path) -> str:
    """The whole description; raises Refused with one line where the file is no recording."""
    recording = Recording(path)
    times = StageTimes()
    for step in recording.steps:
        times.note(step)
    blocks = (_origin(recording), _topics(recording), times.lines(), _complaints(recording))
    return "\n\n".join("\n".join(block) for block in map(list, blocks) if block)


def _origin(recording: Recording) -> Iterator[str]:
    run, machine = recording.run, recording.aspect("machine", dict[str, str]())
    settings = recording.aspect("settings", list[str]())
    restarts = sum(message.topic == RESTARTED for message in recording.messages.values())
    counts = f"{len(recording.messages)} messages, {restarts} restart{'' if restarts == 1 else 's'}"
    yield f"{recording.path}: {recording.verdict}"
    yield f"graph     {run.get('name')} (seed {run.get('seed')}{''.join(f', --set {text}' for text in settings)})"
    yield f"started   {run.get('started')}, lasted {seconds(recording.lasted_ns)}"
    yield f"size      {byte_count(recording.path.stat().st_size)}, {counts}"
    yield f"revision  {run.get('revision') or 'unknown'}"
    if "runner" in run:
        yield f"runner    {run['runner']}"
    yield f"machine   {machine.get('processor')}, Python {machine.get('python')}, {machine.get('blas')}"
    yield f"computes  fingerprint {recording.fingerprint}: {_packages(recording)}"
    for path, found in recording.aspect("files", dict[str, str]()).items():
        yield f"file      {path} {found[:16] if len(found) == 64 else found}"


def _packages(recording: Recording) -> str:
    packages = recording.aspect("packages", dict[str, str]())
    shown = (f"{name} {packages.get(name, 'absent')}" for name in sorted(numerical(recording.graph)))
    return f"{', '.join(shown) or 'no package'} of {len(packages)} packages"


def _topics(recording: Recording) -> list[str]:
    by_topic: dict[str, list[Located]] = defaultdict(list)
    for message in recording.messages.values():
        by_topic[message.topic].append(message)
    rows: list[Cells] = []
    for topic, messages in sorted(by_topic.items()):
        times = [message.log_time_ns for message in messages]
        span = (max(times) - min(times)) * 1e-9
        rate = f"{(len(messages) - 1) / span:.2f}" if span > 0 else "-"
        size = byte_count(sum(message.size for message in messages))
        rows.append((topic, messages[0].type, str(len(messages)), size, rate))
    return table(("topic", "type", "count", "bytes", "per second"), rows)


class Durations:
    """Nanoseconds of many steps in little memory: their sum, their largest and, to 1 %, their median."""

    def __init__(self) -> None:
        self.total = 0
        self.largest = 0
        self._like = defaultdict[int, list[int]](lambda: [0, 0])
        """[number, sum] of those of about the same length, which agree in their first eight bits."""

    def note(self, nanoseconds: int) -> None:
        """Enters one."""
        self.total += nanoseconds
        self.largest = max(self.largest, nanoseconds)
        unimportant = max(0, nanoseconds.bit_length() - 8)
        like = self._like[nanoseconds >> unimportant << unimportant]
        like[0] += 1
        like[1] += nanoseconds

    @property
    def median(self) -> float:
        """The middle one, or the mean of the two in the middle; there must be one."""
        numbers, sums = np.array([like for _, like in sorted(self._like.items())]).T
        middle = (numbers.sum() - 1) // 2, numbers.sum() // 2
        return float((sums / numbers)[np.searchsorted(numbers.cumsum(), middle, side="right")].mean())


class StageTimes:
    """How long every stage computed and waited, gathered step by step."""

    def __init__(self) -> None:
        self._stages = defaultdict[str, _Times](_Times)

    def note(self, step: Step) -> None:
        """Enters one step; what the supervisor sends and how a process ends take no time."""
        if step.outcome == "ended" or step.stage == SUPERVISOR:
            return
        times = self._stages[step.stage]
        times.processes.add((step.replica, step.incarnation))
        times.steps += 1
        times.computed.note(step.computed_ns)
        times.travelled.note(step.travelled_ns)
        times.waited.note(step.waited_ns)
        times.ended_badly += step.outcome == "failed"

    def lines(self) -> list[str]:
        """A table, one row per stage."""
        rows = [times.row(stage) for stage, times in sorted(self._stages.items())]
        titles = ("stage", "processes", "steps", "compute p50", "max", "total", "travel p50", "wait p50", "ended badly")
        return table(titles, rows)


@dataclass(slots=True)
class _Times:
    """Of one stage."""

    processes: set[tuple[int, int]] = field(default_factory=set[tuple[int, int]])
    steps: int = 0
    computed: Durations = field(default_factory=Durations)
    travelled: Durations = field(default_factory=Durations)
    waited: Durations = field(default_factory=Durations)
    ended_badly: int = 0

    def row(self, stage: str) -> Cells:
        return (
            stage,
            str(len(self.processes)),
            str(self.steps),
            seconds(self.computed.median),
            seconds(self.computed.largest),
            seconds(self.computed.total),
            seconds(self.travelled.median),
            seconds(self.waited.median),
            str(self.ended_badly or "-"),
        )


def _complaints(recording: Recording) -> Iterator[str]:
    yield from (f"damage at {damage}" for damage in recording.damage)
    yield from (f"missing {id}" for id in recording.verdict.missing)
    yield from (f"lost {one.process.path}: {one.reason}" for one in recording.lost)
    if recording.repeated:
        yield f"{len(recording.repeated)} messages were sent again after a restart"
    for line in recording.log:
        if line.level in ("warning", "error"):
            yield f"{line.level} of {line.stage}[{line.replica}]: {line.text}"


def table(titles: Cells, rows: Iterable[Cells]) -> list[str]:
    """Aligned lines under their titles, the first two columns to the left; nothing without rows."""
    rows = list(rows)
    if not rows:
        return []
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    return ["  ".join(_aligned(row, widths)).rstrip() for row in (titles, *rows)]


def _aligned(row: Cells, widths: Sequence[int]) -> Iterator[str]:
    for column, (cell, width) in enumerate(zip(row, widths, strict=True)):
        yield cell.ljust(width) if column == 0 or not (cell[:1].isdigit() or cell == "-") else cell.rjust(width)


def seconds(nanoseconds: float) -> str:
    """A duration for people to read."""
    seconds = nanoseconds * 1e-9
    if round(seconds, 2) >= 60:
        return "{} min {} s".format(*divmod(round(seconds), 60))
    return f"{seconds:.2f} s" if round(seconds, 5) >= 1 else f"{seconds * 1e3:.2f} ms"


def byte_count(count: float) -> str:
    """Bytes for people to read."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.4g} {unit}"
        count /= 1000
    return f"{count:.4g} GB"
