"""What every contender of `benchmarks.transport` sends, and when: the same arrays with the same pauses."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

SIZES = (64, 100_000, 1_000_000, 6_000_000, 40_000_000)
"""Bytes of the arrays."""
PAUSES = (0.005, 0.005, 0.01, 0.05, 0.3)
"""Seconds between an answer and the next array, so that none waits behind another."""
WARM_UP = 20
"""First messages of each size, which are not counted."""


class Schedule:
    """The sender's course through all sizes; knows nothing of how arrays travel."""

    def __init__(self, messages: int) -> None:
        """``messages`` of each size, a fifth of that for the largest, after the warm-up."""
        self.microseconds: dict[str, list[float]] = {str(size): [] for size in SIZES}
        self.sent_ns = 0
        self._counts = [WARM_UP + (messages if size < 10_000_000 else max(1, messages // 5)) for size in SIZES]
        self._arrays = [np.random.default_rng(0).integers(0, 255, size, dtype=np.uint8) for size in SIZES]
        self._place = 0

    @property
    def done(self) -> bool:
        """Whether the last array has arrived."""
        return self._place == len(SIZES)

    def pause(self) -> NDArray[np.uint8]:
        """The next array, when it is due. Set :attr:`sent_ns` right before it is sent."""
        time.sleep(PAUSES[self._place])
        return self._arrays[self._place]

    def arrived(self, monotonic_ns: int) -> None:
        """Takes note that the array has reached its handler."""
        times = self.microseconds[str(SIZES[self._place])]
        times.append((monotonic_ns - self.sent_ns) / 1e3)
        if len(times) == self._counts[self._place]:
            del times[:WARM_UP]
            self._place += 1
