"""Toy stages that do something at their end: in a last step, in ``close()``, or in how they fail."""

import atexit
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from runner.contract import Finished, Stage
from tests.runner.common.survivors import first_time
from tests.runner.common.toys import Double, DoubleSink, Number

if "TESTS_SAY_GOODBYE" in os.environ:  # in every process that imports this, once it ends
    atexit.register(print, "goodbye")


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """What a stage does at its end, and where it says that it has."""

    marks: Path
    way: Literal["", "raise", "leave", "hang"] = ""


class Speechless(Exception):
    """Cannot say what it is."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


class Unspeakable(Stage):
    """Doubles numbers; at the second and the third it fails once, in ways that are hard to tell."""

    Config = Ending

    def __init__(self, config: Ending):
        self._marks = config.marks

    def on_number(self, number: Number) -> Double:
        if number.value == 1 and first_time(self._marks / "speechless"):
            raise Speechless
        if number.value == 2 and first_time(self._marks / "nowhere"):
            with tempfile.TemporaryDirectory() as folder:
                os.chdir(folder)
            raise ValueError("the folder is gone\nand this is its second line")
        return Double(value=2 * number.value)


class Slow(Stage):
    """Doubles numbers and lets a program work on after each; has another one that is told to park when it closes."""

    Config = Ending

    def __init__(self, config: Ending):
        self._marks = config.marks
        with (config.marks / "helper.txt").open("w") as parked:
            self._helper = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=parked, text=True)
        subprocess.Popen(["sleep", "611"])

    def on_number(self, number: Number) -> Iterator[Double]:
        yield Double(value=2 * number.value)
        if number.last:
            (self._marks / "works").touch()
            subprocess.run(["sleep", "0.8"], check=True)
            (self._marks / "worked").touch()

    def close(self) -> None:
        self._helper.communicate("park\n")


class PatientSink(DoubleSink):
    """Ends the graph once the doubler works on."""

    def on_double(self, double: Double) -> Finished | None:
        finished = super().on_double(double)
        while finished and not (self._config.path.parent / "works").exists():
            time.sleep(0.01)
        return finished


class Closing(Stage):
    """Doubles numbers; ends otherwise than it should."""

    Config = Ending

    def __init__(self, config: Ending):
        self._way = config.way

    def on_number(self, number: Number) -> Double:
        return Double(value=2 * number.value)

    def close(self) -> None:
        match self._way:
            case "raise":
                raise RuntimeError("the arm is not parked")
            case "leave":
                os._exit(3)
            case "hang":
                time.sleep(600)
            case "":
                pass


class Mover(Stage):
    """Moves until it is stopped, and takes longer to come to rest than another stage may take for its step."""

    device = True
    Config = Ending

    def __init__(self, config: Ending):
        self._marks = config.marks

    def on_number(self, number: Number) -> Iterator[Double | None]:
        try:
            (self._marks / "moves").touch()
            while True:
                yield None
                time.sleep(0.01)
        finally:
            time.sleep(3)
            (self._marks / "rests").touch()

    def close(self) -> None:
        (self._marks / "closed").touch()


class Stuck(Stage):
    """Never finishes its step."""

    Config = Ending

    def __init__(self, config: Ending):
        self._marks = config.marks

    def on_number(self, number: Number) -> Double:
        (self._marks / "moves").touch()
        time.sleep(600)
        return Double(value=2 * number.value)


class TooLate(Stage):
    """Ends the graph and fails after that."""

    Config = Ending

    def __init__(self, config: Ending):
        del config

    def on_number(self, number: Number) -> Iterator[Double | Finished]:
        yield Double(value=2 * number.value)
        try:
            yield Finished(code=0, reason="first")
        finally:  # whether it goes on or is stopped there, once the supervisor has heard that
            time.sleep(0.3)
            raise ValueError("too late")
