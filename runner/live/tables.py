"""What the tools for a running graph print: tables, rates, log lines and the course of a call."""

from __future__ import annotations

import os
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from runner.contract import EXIT_REFUSED, Refused
from runner.graph.document import suggest
from runner.inspect.echo import lines_of
from runner.inspect.info import byte_count, seconds, table
from runner.live.live import Header
from runner.message.codec import LogLine
from runner.supervise.calls import CommandType, Progress
from runner.supervise.registry import Entry
from runner.supervise.status import Flow, ProcessStatus, RunStatus
from runner.terminal import Terminal

SHOWN_LINES = 24
"""Of an answer."""


# ------------------------------------------------------------------------------------------ processes, topics


def status_text(entry: Entry, status: RunStatus) -> str:
    """A run in one line, and its processes in a table."""
    age = seconds((time.time() - entry.started) * 1e9)
    recording = from_here(entry.recording)
    head = f"{entry.run}: {from_here(entry.graph)}, up {age}, {status.endpoint}, recording {recording}"
    titles = ("process", "state", "pid", "cpu", "memory", "queue", "steps/s", "restarts", "last reason")
    return "\n".join((head, *table(titles, map(_process_row, status.processes))))


def _process_row(process: ProcessStatus) -> Sequence[str]:
    pulse = process.pulse
    if pulse is None:
        return (process.name, process.state, str(process.pid), *"----", str(process.restarts), process.reason)
    return (
        process.name,
        f"{process.state} {seconds(pulse.busy_ns)} in {pulse.handler}" if pulse.handler else process.state,
        str(process.pid),
        f"{process.cpu:.0%}",
        byte_count(pulse.memory_bytes),
        str(sum(pulse.queued.values())),
        f"{process.steps_per_second:.1f}",
        str(process.restarts),
        process.reason,
    )


def topics_text(status: RunStatus) -> str:
    """Every topic with its type, what has flowed and what flows now."""
    flows: dict[str, list[Flow]] = defaultdict(list)
    for process in status.processes:
        for port, flow in process.sent.items():
            flows[f"{process.stage}/{port}"].append(flow)
    rows: list[Sequence[str]] = []
    for topic in status.topics:
        own = flows[topic.topic]
        sent = status.published.get(topic.topic, 0) + sum(flow.messages for flow in own)
        rate, size = sum(flow.per_second for flow in own), sum(flow.bytes_per_second for flow in own)
        consumers = ", ".join(topic.consumers) or "nobody"
        rows.append((topic.topic, topic.type, str(sent), f"{rate:.1f}", byte_count(size), consumers))
    return "\n".join(table(("topic", "type", "sent", "per second", "bytes/s", "goes to"), rows))


def from_here(path: str) -> str:
    """A path as a user in this folder would type it."""
    return path.removeprefix(f"{Path.cwd()}{os.sep}")


# ------------------------------------------------------------------------------------------ rates


def rate_text(headers: Sequence[Header]) -> str:
    """How often messages came, and how evenly."""
    if len(headers) < 2:
        return "no messages" if not headers else "1 message"
    gaps = np.diff(_times(headers))
    rate = f"{1e9 / gaps.mean():.2f} per second" if gaps.any() else "all at once"
    spread = f"shortest {seconds(gaps.min())}, longest {seconds(gaps.max())}, std {seconds(gaps.std())}"
    return f"{rate:>18}: every {seconds(gaps.mean())}, {spread}, {len(headers)} messages"


def bandwidth_text(headers: Sequence[Header]) -> str:
    """How many bytes came, and in what sizes."""
    if len(headers) < 2:
        return "no messages" if not headers else f"1 message of {byte_count(headers[0].size)}"
    sizes = [header.size for header in headers]
    span = float(np.ptp(_times(headers))) * 1e-9
    rate = f"{byte_count(sum(sizes[1:]) / span)}/s" if span > 0 else "all at once"
    mean, least, most = byte_count(sum(sizes) / len(sizes)), byte_count(min(sizes)), byte_count(max(sizes))
    return f"{rate:>18}: {mean} each, smallest {least}, largest {most}, {len(headers)} messages"


def _times(headers: Sequence[Header]) -> list[int]:
    """When messages were sent, in this order; when they arrived, where a sender has another clock."""
    sent = sorted(header.sent_ns for header in headers)
    return sent if all(sent) else [header.arrived_ns for header in headers]


# ------------------------------------------------------------------------------------------ log lines, calls


def show_lines(recording: Path, lines: Iterable[LogLine]) -> None:
    """Prints log lines as they come and somebody reads them, with the time since the start of the run."""
    terminal, began = Terminal(sys.stdout, needs_reader=True), _began(recording)
    for line in lines:
        began = began or line.time_ns
        name = f"{line.stage}.{line.replica}" if line.replica else line.stage
        terminal.show(name, line.text, line.level, seconds=(line.time_ns - began) * 1e-9)


def _began(recording: Path) -> int:
    """When the folder of a run was made, nanoseconds since the epoch; its name says it to the second."""
    stamp = "-".join(recording.stem.split("-")[-2:])
    try:
        return int(time.mktime(time.strptime(stamp, "%Y%m%d-%H%M%S")) * 1e9)
    except ValueError:
        return 0


def commands_text(commands: Sequence[CommandType], stage: str | None) -> str:
    """What one stage can be asked, or every stage."""
    chosen = [command for command in commands if stage in (None, command.stage)]
    if not chosen:
        stages = {command.stage for command in commands}
        raise Refused(f"{'this graph' if stage is None else repr(stage)} has no commands{suggest(stage or '', stages)}")
    return "\n".join(line for command in chosen for line in _command_lines(command))


def _command_lines(command: CommandType) -> Iterator[str]:
    fields = " ".join(f"{one.name}=..." if one.default is None else f"[{one.name}=...]" for one in command.fields)
    yield f"runner call {command.stage} {command.name} {fields}".rstrip()
    answers = " or ".join(command.answers)
    yield f"    {command.text}{f' Waits for its {answers}.' if answers else ''}"
    for one in command.fields:
        default = "" if one.default is None else f", {one.default} by default"
        yield f"    {one.name}: {one.type}{default}{f'. {one.text}' if one.text else ''}"


def show_progress(id: str, stage: str, news: Iterable[Progress]) -> int:
    """Prints what the stage says while it does what it was called for, then its answer; returns the exit status."""
    terminal = Terminal(sys.stdout)
    for progress in news:
        for level, text in progress.lines:
            terminal.show(stage, text, level)
        if progress.refused:
            print(f"{id} refused: {progress.refused}", file=sys.stderr)
            return EXIT_REFUSED
        if progress.done:
            done = f"{id} done"
            terminal.plain(f"{done}, emitted {', '.join(progress.emitted)}" if progress.emitted else done)
            return _show_answer(terminal, progress.answer) if progress.answer else 0
    return 0


def _show_answer(terminal: Terminal, payload: bytes) -> int:
    lines = list(lines_of(payload))
    terminal.plain(*lines[:SHOWN_LINES])
    if len(lines) > SHOWN_LINES:
        terminal.plain(f"  ... and {len(lines) - SHOWN_LINES} lines more")
    return int("  success: False" in lines)
