"""The processes of a run as their supervisor knows them: how they are, why they ended, what their successors need."""

import os
import signal
import threading
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

from runner.graph.graph import Limits
from runner.hosts.head import RemoteChild
from runner.inspect.info import byte_count
from runner.message.codec import Pulse, Step, answered
from runner.message.ids import REMEMBERED, number_on, numbered
from runner.message.packet import Process
from runner.process.children import Handle, ending, reason_in
from runner.process.health import Watch, oom_kills
from runner.process.intake import Consumed
from runner.recording.intervals import Intervals

RESENT = 1000
"""Of the messages that may come once more, the ranges that a successor is told, of each port."""


@dataclass(slots=True)
class Child:
    """One process of a run, as its supervisor sees it."""

    process: Process
    handle: Handle
    log: Path
    crashes: int = 0
    """How often it and its predecessors have, whatever else they were restarted for."""
    restarted_because: str = ""
    """Why its predecessor ended."""
    retires_by: float | None = None
    """When it is killed if it has not gone by itself; None where it was not asked to."""
    watch: Watch = field(default_factory=lambda: Watch(Limits()))
    oom_kills: int = field(default_factory=oom_kills)
    """By the kernel of this machine, before it was started."""
    log_from: int = 0
    """Where its own lines begin in the log."""
    killed_because: str = ""
    """Why the supervisor kills it."""
    dies_at: float = float("inf")
    replaced_because: str = ""
    """Once it is dead and another is to take its place."""
    dead_since: float = float("inf")
    """When it was found dead before it was seen."""
    reported: bool = False
    """Whether everybody has been told that it is dead."""
    unheard_since: float = float("inf")
    """When its link went, on another host."""

    def reason(self, newest: Pulse | None = None) -> str:
        """Why it ended: why it was killed, the signal, or what it said last."""
        if self.killed_because:
            return self.killed_because
        code = self.handle.returncode or 0
        if code >= 0 and (said := reason_in(self.log, self.log_from)):
            return said
        if code > 0 and _is_full(self.log):
            return f"{ending(code)}: the disk of {self.log} is full"
        elsewhere = isinstance(self.handle, RemoteChild)  # whose kernel's count nobody here knows
        if code != -signal.SIGKILL or elsewhere or oom_kills() == self.oom_kills:
            return ending(code)
        held = f"; it last held {byte_count(newest.memory_bytes)}" if newest is not None else ""
        return f"{ending(code)}: the kernel was out of memory{held}"


def _is_full(log: Path) -> bool:
    """Whether the disk has no room for what a process would say."""
    try:
        return os.statvfs(log).f_bavail == 0
    except OSError:
        return False


class Progress:
    """How far a stage has come: what its next process must know."""

    def __init__(self) -> None:
        self.numbers: dict[str, int] = {}
        """Next sequence number by output port."""
        self.started = False
        self.done = 0
        """Steps that were done."""
        self._consumed = defaultdict[tuple[int, str, str], Intervals](Intervals)
        """Numbers of what the stage has done with, by replica, port and what it comes from."""
        self._noting = threading.Lock()

    def note(self, step: Step) -> None:
        """Takes a step that the recorder has; only what was done counts."""
        with self._noting:
            for port, id in answered(step):
                source, number = numbered(id)
                consumed = self._consumed[step.replica, port, source]
                consumed.add(number)
                consumed.keep(REMEMBERED)
        if step.outcome != "done":
            return
        self.done += 1
        self.started |= not step.consumed
        number_on(self.numbers, step.emitted)

    def consumed(self) -> list[tuple[int, Consumed]]:
        """What each replica has done with; of what comes with gaps, the newest. May be asked from any thread."""
        with self._noting:
            return [
                (replica, (port, source, tuple(numbers)[-RESENT:]))
                for (replica, port, source), numbers in self._consumed.items()
            ]
