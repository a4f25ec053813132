"""Toy stages: a counter, an image source, a fan-out with replicas and a gather, and ways to fail."""

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from runner.contract import Command, Context, Finished, Message, Part, Refused, Restarted, Spec, Stage, Tolerance

Vector = Annotated[NDArray[np.float64], Spec("float64", ("N",))]


class Number(Message, frozen=True, kw_only=True):
    value: int
    last: bool = False


class Double(Message, frozen=True, kw_only=True):
    value: int


class Piece(Part, frozen=True, kw_only=True):
    value: int


class Answer(Part, frozen=True, kw_only=True):
    samples: Vector


class Total(Message, frozen=True, kw_only=True):
    samples: Vector
    last: bool


TOLERANCES = {"Answer.samples": Tolerance(1e-6), "Total.samples": Tolerance(1e-6)}


class Counter(Stage):
    """Sends the numbers below ``count``; a device, as only devices start by themselves again and again."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        count: int = 5
        period: float = 0.0

    def __init__(self, config: Config):
        self._config = config

    def source(self, ctx: Context) -> Iterator[Number]:
        for value in range(self._config.count):
            yield Number(value=value, last=value == self._config.count - 1)
            time.sleep(self._config.period)


class Splitter(Stage):
    """Each number becomes ``parts`` pieces."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        parts: int = 4

    def __init__(self, config: Config):
        self._config = config

    def on_number(self, number: Number) -> Iterator[Piece]:
        for index in range(self._config.parts):
            yield Piece(index=index, count=self._config.parts, value=number.value)


class Worker(Stage):
    """Answers each piece with random numbers; joins it with the number it was split from."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        seconds: float = 0.0
        die_at: int = -1
        """Piece value at which the first process to see it kills itself."""

    def __init__(self, config: Config):
        self._config = config

    def on_piece(self, piece: Piece, number: Number, ctx: Context) -> Answer:
        time.sleep(self._config.seconds)
        if piece.value == self._config.die_at and _first_time(ctx.directory / "died"):
            os.kill(os.getpid(), signal.SIGKILL)
        return Answer(index=piece.index, count=piece.count, samples=number.value + ctx.rng.random(3))


class Gatherer(Stage):
    """Puts the answers of a number together again, next to the number itself."""

    def on_answers(self, answers: list[Answer], number: Number) -> Total:
        return Total(samples=np.concatenate([answer.samples for answer in answers]), last=number.last)


class Sink(Stage):
    """Appends each total to a file and ends the graph after the last."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        path: Path
        code: int = 0

    def __init__(self, config: Config):
        self._config = config

    def on_total(self, total: Total, ctx: Context) -> Finished | None:
        with self._config.path.open("a") as file:
            file.write(f"{total.samples.tolist()}\n")
        ctx.log(f"sum {total.samples.sum():.6f}")
        return Finished(code=self._config.code, reason="all totals written") if total.last else None


class Doubler(Stage):
    """Doubles numbers; the settings say how it fails."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        raise_at: int = -1
        refuse_at: int = -1
        die_at: int = -1
        seconds: float = 0.0

    def __init__(self, config: Config):
        self._config = config

    def on_number(self, number: Number, ctx: Context) -> Double:
        time.sleep(self._config.seconds)
        if number.value == self._config.raise_at:
            raise ValueError(f"cannot double {number.value}")
        if number.value == self._config.refuse_at:
            raise Refused(f"number {number.value}: valid: anything else")
        if number.value == self._config.die_at and _first_time(ctx.directory / "died"):
            os.kill(os.getpid(), signal.SIGKILL)
        return Double(value=2 * number.value)


class DoubleSink(Stage):
    """Appends each double to a file and ends the graph when the ``count``-th is there."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        path: Path
        count: int = 5

    def __init__(self, config: Config):
        self._config = config
        self._seen = 0

    def on_double(self, double: Double) -> Finished | None:
        with self._config.path.open("a") as file:
            file.write(f"{double.value}\n")
        self._seen += 1
        return Finished(code=0, reason=f"{self._seen} doubles") if self._seen == self._config.count else None


class Sum(Message, frozen=True, kw_only=True):
    total: int
    calls: int


class Add(Command, frozen=True, kw_only=True):
    """Adds to the account."""

    amount: int
    """May be negative."""
    mood: Literal["glad", "sad"] = "glad"
    note: str = ""
    tags: list[str] = msgspec.field(default_factory=list[str])


class Collect(Command, frozen=True, kw_only=True):
    """Adds the numbers that come until there are ``count`` of them."""

    answers = (Sum,)

    count: int


class Account(Stage):
    """Does what it is told, and counts how often."""

    def __init__(self):
        self._total = self._calls = self._left = 0

    def on_add(self, add: Add, ctx: Context) -> Sum:
        if add.amount == 0:
            raise Refused("amount=0: nothing to add; valid: any other number")
        self._total += add.amount
        self._calls += 1
        ctx.log(f"{add.amount} added {add.note}".rstrip())
        return Sum(total=self._total, calls=self._calls)

    def on_collect(self, collect: Collect, ctx: Context) -> None:
        self._left = collect.count
        ctx.log(f"collecting {collect.count}")

    def on_number(self, number: Number) -> Sum | None:
        self._left -= 1
        self._total += self._left >= 0
        return Sum(total=self._total, calls=self._calls) if self._left == 0 else None


class Walker(Stage):
    """Walks until something else tells it how far it was to go."""

    device = True

    def __init__(self):
        self._goal = 0

    def on_number(self, number: Number, ctx: Context) -> Iterator[Finished | None]:
        walked = 0
        ctx.log("walks")
        try:
            while not self._goal:
                time.sleep(0.01)
                walked += 1
                yield None
        except GeneratorExit:
            ctx.log(f"stands after {walked} steps")
            raise
        yield Finished(code=0, reason=f"arrived at {self._goal} after {walked} steps")

    def on_goal(self, goal: Number) -> None:
        self._goal = goal.value + 1


class RestartWatcher(Stage):
    """Shows restarts."""

    def on_restarted(self, restarted: Restarted, ctx: Context) -> None:
        ctx.log(f"noticed: {restarted.stage}.{restarted.replica} restarted: {restarted.reason}")


class BrokenAtStart(Stage):
    """Cannot be constructed."""

    def __init__(self):
        raise Refused("weights.bin: no such file; valid: a file that exists")

    def on_number(self, number: Number) -> None:
        del number


def _first_time(marker: Path) -> bool:
    try:
        marker.touch(exist_ok=False)
    except FileExistsError:
        return False
    return True
