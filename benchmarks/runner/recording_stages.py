"""The stages that `benchmarks.recording` records: a camera and something that speaks often, both punctual."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from runner.contract import Context, Finished, Message, Spec, Stage

_GRACE_SECONDS = 1.0


class Picture(Message, frozen=True, kw_only=True):
    """An RGB-D image."""

    rgb: Annotated[NDArray[np.uint8], Spec("uint8", (480, 640, 3))]
    depth: Annotated[NDArray[np.float32], Spec("float32", (480, 640))]
    """Metres."""
    taken_ns: int = 0
    """Nanoseconds since the epoch."""


class Word(Message, frozen=True, kw_only=True):
    """A small message."""

    number: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """How often and for how long."""

    hertz: float
    seconds: float


def beats(pace: Pace) -> Iterator[int]:
    """Counts when it is time; after a delay the next come at once."""
    began = time.monotonic()
    for number in range(round(pace.hertz * pace.seconds)):
        time.sleep(max(0.0, began + number / pace.hertz - time.monotonic()))
        yield number


class Camera(Stage):
    """Sends images and, a while after the last, ends the graph."""

    device = True
    Config = Pace

    def __init__(self, config: Pace) -> None:
        self._pace = config
        rng = np.random.default_rng(0)
        self._rgb = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
        self._depth = rng.uniform(0.5, 2.0, (480, 640)).astype(np.float32)

    def source(self, ctx: Context) -> Iterator[Picture | Finished]:
        """Noise, so that nothing is gained by compressing it."""
        for _ in beats(self._pace):
            yield Picture(rgb=self._rgb, depth=self._depth, taken_ns=time.time_ns())
        time.sleep(_GRACE_SECONDS)
        yield Finished(code=0, reason="all sent")


class Speaker(Stage):
    """Sends small messages."""

    device = True
    Config = Pace

    def __init__(self, config: Pace) -> None:
        self._pace = config

    def source(self, ctx: Context) -> Iterator[Word]:
        """Numbers."""
        for number in beats(self._pace):
            yield Word(number=number)


class Listener(Stage):
    """Takes words and says nothing."""

    def on_word(self, word: Word) -> None:
        """Has had it."""
