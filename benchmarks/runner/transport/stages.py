"""The two stages that `benchmarks.transport` times: one sends arrays, the other says when each reached its handler."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from benchmarks.runner.transport.schedule import Schedule
from runner.contract import Context, Finished, Message, Spec, Stage


class Blob(Message, frozen=True, kw_only=True):
    """An array on its way."""

    data: Annotated[NDArray[np.uint8], Spec("uint8", ("n",))]


class Arrived(Message, frozen=True, kw_only=True):
    """When a blob reached its handler."""

    monotonic_ns: int


class Sender(Stage):
    """Sends the next array once the one before has arrived, and writes how long each took."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Where the times go."""

        out: Path
        messages: int

    def __init__(self, config: Config) -> None:
        self._out = config.out
        self._schedule = Schedule(config.messages)

    def on_start(self, ctx: Context) -> Blob:
        """Sends the first."""
        return self._next()

    def on_arrived(self, arrived: Arrived) -> Iterator[Blob | Finished]:
        """Takes the time of the last and sends the next."""
        self._schedule.arrived(arrived.monotonic_ns)
        if self._schedule.done:
            self._out.write_text(json.dumps(self._schedule.microseconds))
            yield Finished(code=0, reason="all arrived")
        else:
            yield self._next()

    def _next(self) -> Blob:
        data = self._schedule.pause()
        self._schedule.sent_ns = time.monotonic_ns()
        return Blob(data=data)


class Receiver(Stage):
    """Answers each array with the time at which it was there."""

    device = True

    def on_blob(self, blob: Blob) -> Arrived:
        """The clock is read first."""
        return Arrived(monotonic_ns=time.monotonic_ns())
