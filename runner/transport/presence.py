"""Which processes of a run are there, and which publish no more."""

import threading
import time
from collections.abc import Callable, Collection, Iterable

from runner.graph.graph import SUPERVISOR
from runner.message.packet import Process

END_SECONDS = 8.0
"""How long a process that ends waits at most for the others to publish no more."""


class Presence:
    """What is known of the processes of a run. May be told and asked from any thread."""

    def __init__(self):
        self.living: frozenset[Process] = frozenset()
        self._newest: dict[tuple[str, int], int] = {}
        self._ended: dict[tuple[str, int], int] = {}
        """Incarnation by (stage, replica)."""
        self._gone: dict[Process, float] = {}
        """When each was seen to go first, monotonic seconds."""
        self._changed = threading.Condition()

    def update(self, process: Process, present: bool) -> None:
        """Takes note of a process that came or went."""
        with self._changed:
            self.living = self.living | {process} if present else self.living - {process}
            _raise(self._newest, process)
            if not present:
                self._gone.setdefault(process, time.monotonic())
            self._changed.notify_all()

    def ended(self, process: Process) -> None:
        """Takes note of one that publishes no more: it has ended, or is dead."""
        with self._changed:
            _raise(self._ended, process)
            self._changed.notify_all()

    def wait_for(self, expected: Iterable[tuple[str, int]], until: Callable[[], bool]) -> bool:
        """Blocks until all, (stage, replica), are present; False when ``until`` became true first."""
        wanted = set(expected)
        with self._changed:
            while not wanted <= {process.place for process in self.living}:
                if until():
                    return False
                self._changed.wait(0.1)
        return True

    def wait_for_the_end(self, stages: Collection[str], processes: Iterable[tuple[str, int]]) -> None:
        """Waits until nothing more comes from these stages, whose ``processes`` are (stage, replica)."""
        wanted = {place for place in (*processes, (SUPERVISOR, 0)) if place[0] in stages}
        with self._changed:
            self._changed.wait_for(lambda: all(map(self._has_ended, wanted)), END_SECONDS)

    def cut_off(self, stages: Collection[str], seconds: float) -> list[Process]:
        """The newest processes of these stages that have gone so long ago and are not known to publish no more. They
        may be back: what was sent meanwhile is lost."""
        before = time.monotonic() - seconds
        with self._changed:
            gone = [one for one, at in self._gone.items() if one.stage in stages and at < before]
            return [
                one for one in gone if self._newest[one.place] == one.incarnation and not self._has_ended(one.place)
            ]

    def _has_ended(self, place: tuple[str, int]) -> bool:
        return self._ended.get(place, -1) >= self._newest.get(place, 0)


def _raise(incarnations: dict[tuple[str, int], int], process: Process) -> None:
    incarnations[process.place] = max(process.incarnation, incarnations.get(process.place, 0))
