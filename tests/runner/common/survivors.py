"""Toy stages in trouble: they crash, hang, grow, never start, remember and are slow."""

import contextlib
import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal

import numpy as np
import psutil
from numpy.typing import NDArray

from runner.contract import Context, Finished, Message, Refused, Restarted, Spec, Stage
from tests.runner.common.toys import Answer, Double, Number, Piece, Splitter, Worker


class Troubled(Stage):
    """Answers pieces like the toy worker; the first process to see a number gets into the trouble set for it."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        marks: Path
        crash_at: int = -1
        kill_at: int = -1
        stop_at: int = -1
        loop_at: int = -1
        grow_at: int = -1
        grow_bytes: int = 300_000_000
        exit_at: int = -1

    def __init__(self, config: Config):
        self._config = config
        self._held: list[NDArray[np.uint8]] = []

    def on_piece(self, piece: Piece, number: Number, ctx: Context) -> Answer:
        for trouble in ("crash", "kill", "stop", "loop", "grow", "exit"):
            if getattr(self._config, f"{trouble}_at") == piece.value and first_time(self._config.marks / trouble):
                getattr(self, trouble)()
        return Answer(index=piece.index, count=piece.count, samples=number.value + ctx.rng.random(3))

    def crash(self) -> None:
        ctypes.string_at(0)

    def kill(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def stop(self) -> None:
        os.kill(os.getpid(), signal.SIGSTOP)

    def loop(self) -> None:
        while True:
            pass

    def grow(self) -> None:
        self._held.append(np.ones(self._config.grow_bytes, np.uint8))
        time.sleep(600)

    def exit(self) -> None:
        os._exit(3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Mortality:
    """At which numbers a stage kills itself, once each, and where it leaves its marks."""

    marks: Path
    die_at: tuple[int, ...] = ()


class Quitter(Stage):
    """Doubles numbers; the first process to see a two, or each, leaves as a script would."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        way: Literal["quit", "interrupt"] = "quit"
        each: bool = False

    def __init__(self, config: Config):
        self._config = config

    def on_number(self, number: Number, ctx: Context) -> Double:
        if number.value == 2 and (self._config.each or first_time(ctx.directory / "left")):
            raise SystemExit(2) if self._config.way == "quit" else KeyboardInterrupt(2)
        return Double(value=2 * number.value)


class NamesAFile(Stage):
    """Speaks of a file whose name is not UTF-8."""

    def on_number(self, number: Number, ctx: Context) -> Double:
        name = os.fsdecode(b"d\xffd.png")
        ctx.log(f"no {name} here")
        raise Refused(f"no {name}")


class Patient(Stage):
    """Doubles numbers; its first step lasts until it was asked to restart and then, with all others, to end."""

    Config = Mortality

    def __init__(self, config: Mortality):
        self._config = config

    def on_number(self, number: Number) -> Double:
        known, came = dict[int, Any](), set[int]()

        def note(signum: int, frame: FrameType | None) -> None:
            known[signum](signum, frame)
            came.add(signum)

        if first_time(self._config.marks / "begun"):
            known |= {signum: signal.signal(signum, note) for signum in (signal.SIGUSR1, signal.SIGTERM)}
            (self._config.marks / "waits").touch()
            while signal.SIGUSR1 not in came:
                time.sleep(0.01)
            (self._config.marks / "asked").touch()
            while signal.SIGTERM not in came:
                time.sleep(0.01)
        return Double(value=2 * number.value)


class DiesWithAnother(Stage):
    """Dies of the first death that it hears of."""

    def on_restarted(self, restarted: Restarted, ctx: Context) -> None:
        if first_time(ctx.directory / "heard"):
            os.kill(os.getpid(), signal.SIGKILL)


class FragileSplitter(Stage):
    """Splits like the toy splitter; of every second number its first process dies once it has sent some pieces."""

    Config = Mortality

    def __init__(self, config: Mortality):
        self._config = config

    def on_number(self, number: Number) -> Iterator[Piece]:
        for index in range(4):
            yield Piece(index=index, count=4, value=number.value)
            if (
                number.value % 2
                and index == number.value // 2 % 4
                and first_time(self._config.marks / str(number.value))
            ):
                os.kill(os.getpid(), signal.SIGKILL)


class FragileRelay(Stage):
    """Sends each number on; of every second one its first process dies, while what it sent last is on its way."""

    Config = Mortality

    def __init__(self, config: Mortality):
        self._config = config

    def on_number(self, number: Number) -> Iterator[Number]:
        if number.value % 2 and first_time(self._config.marks / str(number.value)):
            os.kill(os.getpid(), signal.SIGKILL)
        yield number


class Listener(Worker):
    """Hears numbers besides its pieces; the first of its processes to hear a three dies of it a little later."""

    def on_heard(self, heard: Number, ctx: Context) -> None:
        if heard.value == 3 and first_time(ctx.directory / "heard"):
            time.sleep(0.3)
            os.kill(os.getpid(), signal.SIGKILL)


class SlowSplitter(Splitter):
    """Takes a second to start: its predecessor's pieces are worked on meanwhile."""

    def __init__(self, config: Splitter.Config):
        time.sleep(1.0)
        super().__init__(config)


class Adder(Stage):
    """Sums numbers: what it emits depends on everything before. At some numbers it kills itself before it answers."""

    stateful = True

    Config = Mortality

    def __init__(self, config: Mortality):
        self._config = config
        self._sum = 0

    def on_number(self, number: Number, ctx: Context) -> Double:
        self._sum += number.value + int(ctx.rng.integers(100))
        if number.value in self._config.die_at and first_time(self._config.marks / f"died-{number.value}"):
            os.kill(os.getpid(), signal.SIGKILL)
        return Double(value=self._sum)


class Parent(Stage):
    """Doubles numbers; starts processes in a session of their own, some of which do not end when they are asked to.

    Their ids are lines of the file ``started``. At some numbers it kills itself; beside processes of a predecessor it
    refuses to live.
    """

    Config = Mortality

    def __init__(self, config: Mortality):
        self._config = config
        if others := living(config.marks):
            raise Refused(f"still there: {others}")
        script = "sleep 1000 & echo $! >> started; trap '' TERM; sleep 2000 & echo $! >> started; echo $$ >> started; "
        subprocess.Popen(["sh", "-c", f"{script} touch ready; wait"], start_new_session=True, cwd=config.marks)
        while not (config.marks / "ready").exists():
            time.sleep(0.01)
        (config.marks / "ready").unlink()

    def on_number(self, number: Number) -> Double:
        if number.value in self._config.die_at and first_time(self._config.marks / f"died-{number.value}"):
            os.kill(os.getpid(), signal.SIGKILL)
        return Double(value=2 * number.value)


def living(marks: Path) -> list[int]:
    """Processes that a :class:`Parent` has started and that have not ended."""
    started = marks / "started"
    return [pid for pid in map(int, started.read_text().split()) if lives(pid)] if started.exists() else []


def lives(pid: int) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    return False


class NeverReady(Stage):
    """Hangs while it is constructed."""

    def __init__(self):
        print("loading the weights", flush=True)
        time.sleep(600)

    def on_number(self, number: Number) -> None:
        del number


class Preparing(Stage):
    """Prepares for longer than anybody waits."""

    Config = Mortality

    def __init__(self, config: Mortality):
        del config

    @classmethod
    def prepare(cls, config: Mortality) -> None:
        (config.marks / "prepares").touch()
        time.sleep(100)

    def on_number(self, number: Number) -> Double:
        return Double(value=2 * number.value)


class GatedCounter(Stage):
    """Counts like the toy counter; one number, the last unless it is told which, waits for a file."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        go: Path
        count: int = 5
        period: float = 0.0
        waits: int = -1

    def __init__(self, config: Config):
        self._config = config

    def source(self, ctx: Context) -> Iterator[Number]:
        for value in range(self._config.count):
            while value == self._config.waits % self._config.count and not self._config.go.exists():
                time.sleep(0.01)
            yield Number(value=value, last=value == self._config.count - 1)
            time.sleep(self._config.period)


class Starter(Stage):
    """Sends three numbers at its start; once these are taken its first process dies, before the step is done."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        taken: Path
        """Has a line for each number that was taken."""

    def __init__(self, config: Config):
        self._config = config

    def on_start(self, ctx: Context) -> Iterator[Number]:
        first = first_time(ctx.directory / "started")
        for value in range(3):
            yield Number(value=value if first else 10 + value)
        while first:
            if self._config.taken.exists() and self._config.taken.read_text().count("\n") == 3:
                os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(0.01)


class Picture(Message, frozen=True, kw_only=True):
    pixels: Annotated[NDArray[np.uint8], Spec("uint8", ("N",))]
    last: bool


class Camera(Stage):
    """Sends pictures as fast as it can, or as fast as somebody takes them."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        count: int = 60
        size: int = 1_000_000
        go: Path | None = None
        """Waits until this file is there."""
        taken: Path | None = None
        """Sends no picture before this file has a byte for each that came before it."""

    def __init__(self, config: Config):
        self._config = config

    def source(self, ctx: Context) -> Iterator[Picture]:
        go, taken = self._config.go, self._config.taken
        while go is not None and not go.exists():
            time.sleep(0.01)
        for number in range(self._config.count):
            while taken is not None and taken.stat().st_size < number:
                time.sleep(0.01)
            yield Picture(
                pixels=np.full(self._config.size, number % 256, np.uint8), last=number == self._config.count - 1
            )


class Album(Stage):
    """Writes down which pictures it got; ends the graph after the last."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        path: Path

    def __init__(self, config: Config):
        self._config = config

    def on_picture(self, picture: Picture) -> Finished | None:
        with self._config.path.open("a") as file:
            file.write(f"{picture.pixels[0]}\n")
        return Finished(code=0, reason="the album is full") if picture.last else None


class Glance(Stage):
    """Looks at pictures, slowly."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        seconds: float = 0.0

    def __init__(self, config: Config):
        self._config = config

    def on_picture(self, picture: Picture) -> None:
        time.sleep(self._config.seconds)


def first_time(marker: Path) -> bool:
    try:
        marker.touch(exist_ok=False)
    except FileExistsError:
        return False
    return True
