"""Signs of life: what every process says of itself twice a second."""

import os
import platform
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from runner import codec
from runner.bus import Bus, Process
from runner.codec import Pulse

PULSE_SECONDS = 0.5
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


class Heart:
    """Sends a pulse every half second from a thread of its own, whatever the process does meanwhile."""

    def __init__(self, process: Process, bus: Bus, say: Callable[[], dict[str, Any]]):
        """``say`` gives the fields of a :class:`Pulse` that only the process knows; it must never wait."""
        self._process = process
        self._bus = bus
        self._say = say
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
        own = self._process
        return Pulse(
            stage=own.stage,
            replica=own.replica,
            incarnation=own.incarnation,
            pid=os.getpid(),
            host=platform.node(),
            cpu_ns=time.process_time_ns(),
            memory_bytes=memory_bytes(),
            **self._say(),
        )


class Pulses:
    """The newest pulse of every process."""

    def __init__(self) -> None:
        self.newest: dict[tuple[str, int], Pulse] = {}
        """By (stage, replica); the recorder is ("recorder", 0)."""

    def note(self, payload: bytes) -> Pulse:
        """Takes a pulse as it came, and returns it; raises CodecError where it is none."""
        pulse = codec.unpack(Pulse, payload)
        self.newest[pulse.stage, pulse.replica] = pulse
        return pulse

    def of(self, process: Process) -> Pulse | None:
        """The newest of one incarnation."""
        pulse = self.newest.get((process.stage, process.replica))
        return pulse if pulse is not None and pulse.incarnation == process.incarnation else None


def memory_bytes() -> int:
    """The resident set of this process; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE_BYTES
    except OSError:
        return 0
