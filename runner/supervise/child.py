"""The processes of a run as their supervisor knows them: how they are, why they ended, what their successors need."""

import contextlib
import signal
import subprocess
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

from runner.graph.graph import Limits
from runner.message.codec import Pulse, Step
from runner.message.packet import Process
from runner.process.children import Handle, ending, last_lines
from runner.process.health import Watch, gigabytes, oom_kills
from runner.process.step import sequence_of


@dataclass(slots=True)
class Child:
    """One process of a run, as its supervisor sees it."""

    process: Process
    handle: Handle
    log: Path
    started: float = field(default_factory=time.monotonic)
    announced: bool = False
    ready_after: float = 0.0
    """Seconds from its start."""
    crashes: int = 0
    """How often this process has crashed before, whatever else it was restarted for."""
    restarted_because: str = ""
    """Why its predecessor ended."""
    retires_by: float | None = None
    """When it is killed if it has not gone by itself; None where it was not asked to."""
    watch: Watch = field(default_factory=lambda: Watch(Limits()))
    oom_kills: int = field(default_factory=oom_kills)
    """By the kernel, before it was started."""
    log_from: int = 0
    """Where its own lines begin in the log."""
    condemned: str = ""
    """Why the supervisor kills it."""
    dies_at: float = float("inf")
    heir: tuple[str, int] | None = None
    """Once it is dead: why it is replaced, and how often it has crashed by now."""

    def reason(self, newest: Pulse | None = None) -> str:
        """Why it ended: what it was condemned for, the signal, or the last thing it printed."""
        if self.condemned:
            return self.condemned
        code = self.handle.returncode
        lines = last_lines(self.log, 1, self.log_from)
        if lines and code is not None and code >= 0:
            return lines[0]
        held = f"; it last held {gigabytes(newest.memory_bytes)}" if newest is not None else ""
        out_of_memory = code == -signal.SIGKILL and oom_kills() > self.oom_kills
        return f"{ending(code or 0)}{f': the kernel was out of memory{held}' if out_of_memory else ''}"


@dataclass(slots=True)
class Progress:
    """How far a stage has come: what its next process must know."""

    numbers: dict[str, int] = field(default_factory=dict[str, int])
    consumed: deque[tuple[str, str]] = field(default_factory=lambda: deque[tuple[str, str]](maxlen=1000))
    started: bool = False

    def note(self, step: Step) -> None:
        """Takes a step that the recorder has; only what was done counts."""
        if step.outcome != "done":
            return
        self.started |= not step.consumed
        self.consumed.extend(step.consumed)
        for message_id in step.emitted:
            port = message_id.partition("#")[0].rpartition(".")[2]
            self.numbers[port] = max(self.numbers.get(port, 0), sequence_of(message_id) + 1)


def end_all(children: list[Child], grace_seconds: float) -> None:
    """Asks children to end, kills those that do not, and whatever they have left behind."""
    for child in children:
        child.handle.signal_group(signal.SIGTERM)
    deadline = time.monotonic() + grace_seconds
    for child in children:
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.handle.wait(max(0.0, deadline - time.monotonic()))
    for child in children:
        child.handle.signal_group(signal.SIGKILL)
        child.handle.wait()
