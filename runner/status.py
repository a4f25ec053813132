"""What a supervisor answers when it is asked how its run goes."""

from __future__ import annotations

import msgspec


class ProcessStatus(msgspec.Struct, frozen=True):
    """One process of the graph, or the recorder."""

    stage: str
    replica: int
    replicated: bool
    """Whether the stage has other replicas."""
    state: str
    """``starting`` until it is ready to take messages, ``ended`` once it has gone."""
    pid: int
    restarts: int
    reason: str = ""
    """Why it was restarted the last time."""

    @property
    def name(self) -> str:
        """As it is called in log lines."""
        return f"{self.stage}.{self.replica}" if self.replicated else self.stage


class RunStatus(msgspec.Struct, frozen=True):
    """A whole run."""

    run: str
    graph: str
    """Path of the graph file."""
    recording: str
    endpoint: str
    started: float
    """Seconds since the epoch."""
    ready: bool
    """Whether every process has been ready at least once."""
    processes: tuple[ProcessStatus, ...]
