"""Signs of life: what every process says of itself twice a second, and when its silence is one too many."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil

from runner.graph.graph import Limits
from runner.inspect.info import byte_count
from runner.message import codec
from runner.message.codec import Pulse
from runner.message.packet import Process
from runner.transport.bus import Bus

PULSE_SECONDS = 0.5
SLOW_SECONDS = 5.0
"""Silence after which people are told, long before it counts as a hang."""
LONGEST_LOOK_SECONDS = 1.0
"""What may count as waited between two looks: while the supervisor itself stands still, nobody is to blame."""
SOURCE = "source"
"""Waits for the world as long as it likes."""


class Heartbeat:
    """Sends a pulse every half second from a thread of its own, whatever the process does meanwhile."""

    def __init__(self, process: Process, bus: Bus, say: Callable[[], dict[str, Any]]):
        """``say`` gives the fields of a :class:`Pulse` that only the process knows; it must never wait."""
        self._process = process
        self._bus = bus
        self._say = say
        self._facts = psutil.Process()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="pulse", daemon=True)

    def start(self) -> None:
        """Sends the first pulse and goes on."""
        self._thread.start()

    def stop(self) -> None:
        """Sends no more; returns once the last is out."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(PULSE_SECONDS)

    def _beat(self) -> None:
        path = f"h/{self._process.stage}/{self._process.replica}"
        while True:
            self._bus.publish(path, codec.pack(self._pulse()))
            if self._stopping.wait(PULSE_SECONDS):
                return

    def _pulse(self) -> Pulse:
        memory_bytes = self._facts.memory_info().rss
        return Pulse(*self._process, cpu_ns=time.process_time_ns(), memory_bytes=memory_bytes, **self._say())


class Watch:
    """What the supervisor concludes of one process from its pulses or their absence."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._looked = 0.0
        self._age = 0.0
        self._silent = 0.0
        self._newest: Pulse | None = None
        self._ready = False
        self.slow = False
        """True while it has been silent for longer than is usual."""

    def look(self, now: float, newest: Pulse | None, *, ready: bool) -> str:
        """Takes note of how a process is at a monotonic time in seconds; returns a change to tell people of."""
        waited = min(now - self._looked, LONGEST_LOOK_SECONDS) if self._looked else 0.0
        self._looked, self._ready = now, ready
        self._age += waited
        silent = self._silent
        alive = newest is not self._newest or not (ready or newest)
        self._newest, self._silent = newest, 0.0 if alive else silent + waited
        before, self.slow = self.slow, self._silent > min(SLOW_SECONDS, self._limits.heartbeat / 2)
        if self.slow and not before:
            left = self._limits.heartbeat - self._silent
            return f"is slow: no sign of life for {self._silent:.1f} s; counts as hung in {left:.0f} s"
        if before and not self.slow:
            return f"goes on after {silent:.1f} s"
        return ""

    def fault(self) -> str:
        """Why the process cannot be left as it is, or nothing."""
        limits, newest = self._limits, self._newest
        if not self._ready and self._age > limits.startup:
            return f"start-up hung: not ready after {limits.startup:g} s (startup)"
        if self._silent > limits.heartbeat:
            within = f", last in {newest.handler}" if newest is not None and newest.handler else ""
            return f"hung: no sign of life for {limits.heartbeat:g} s (heartbeat){within}"
        if newest is None:
            return ""
        if newest.state == "working" and newest.handler != SOURCE and newest.busy_ns > limits.timeout * 1e9:
            return f"hung: {newest.handler} has computed for more than {limits.timeout:g} s (timeout)"
        if newest.memory_bytes > limits.memory_bytes:
            return f"out of memory: it holds {byte_count(newest.memory_bytes)}, its limit is {limits.memory} (memory)"
        return ""


def oom_kills() -> int:
    """Processes that the kernel has killed for lack of memory so far: in this control group, else on this machine."""
    for path in (*_own_groups(), Path("/proc/vmstat")):
        with contextlib.suppress(OSError, KeyError, ValueError):
            counts = dict(line.split(maxsplit=1) for line in path.read_text().splitlines())
            return int(counts["oom_kill"])
    return 0


def _own_groups() -> Iterator[Path]:
    """Where the kernel counts for this process' control group, of version 2 and 1."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            number, controllers, group = line.split(":", 2)
            if number == "0":
                yield Path(f"/sys/fs/cgroup{group}/memory.events")
            elif "memory" in controllers.split(","):
                yield Path(f"/sys/fs/cgroup/memory{group}/memory.oom_control")
