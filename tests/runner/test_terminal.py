import io
import os
import re

import pytest

from runner.terminal import Terminal


class Screen(io.StringIO):
    """A terminal that somebody looks at."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stream", "no_color", "text"),
    [
        (Screen(), "", "\033[31m    1.0 s  camera           lost\033[0m\n"),
        (Screen(), "1", "    1.0 s  camera           lost\n"),
        (io.StringIO(), "", "    1.0 s  camera           lost\n"),
    ],
)
def test_colours_are_for_who_wants_to_see_them(
    stream: io.StringIO, no_color: str, text: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("NO_COLOR", no_color)
    Terminal(stream).show("camera", "lost", "error", seconds=1.0)
    assert stream.getvalue() == text


def test_what_is_for_debugging_is_shown_on_request():
    stream = io.StringIO()
    for verbose in (False, True):
        Terminal(stream, verbose=verbose).show("camera", "ready", "debug", seconds=0.0)
    assert stream.getvalue() == "    0.0 s  camera           ready\n"


def test_what_is_said_cannot_steer_the_terminal():
    stream = io.StringIO()
    Terminal(stream).show("camera", "a\033[2Jb\nc", seconds=0.0)
    assert stream.getvalue() == "    0.0 s  camera           a\\x1b[2Jb\nc\n"


def test_nothing_is_lost_with_a_reader_that_is_gone():
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stream:
        terminal = Terminal(stream)
        terminal.plain("one", "two")


def test_nobody_waits_for_a_reader_that_stands_still(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("runner.terminal.MOST_WAITING", 10)
    monkeypatch.setattr("runner.terminal.LAST_SECONDS", 0.1)
    reading, writing = os.pipe()
    with os.fdopen(writing, "w") as stream, os.fdopen(reading) as reader:
        terminal = Terminal(stream, waits=False)
        for number in range(500):
            terminal.show("camera", f"{number} {'x' * 1000}", seconds=0.0)
        terminal.plain("the end")
        terminal.close()
        lines = list(iter(reader.readline, "the end\n"))
    shown = [int(line.split()[3]) for line in lines if "camera" in line]
    left_out = [int(line.split()[0]) for line in lines if "left out" in line]
    assert left_out and shown == sorted(shown)
    assert len(shown) + sum(left_out) == 500


def on_screen(written: str) -> list[str]:
    """What is to be seen once all is written."""
    lines: list[str] = []
    for up, text in re.findall(r"(?:\033\[(\d+)A\033\[J)?([^\033]*)", written):
        lines = lines[: len(lines) - int(up or 0)] + text.splitlines()
    return lines


def tell(terminal: Terminal) -> None:
    for number in range(3):
        terminal.show("camera", f"frame {number}", seconds=number, progress="camera")
        terminal.show(f"filter.{number % 2}", f"scene {number} {'x' * 200}", seconds=number, progress="filter")
    terminal.show("camera", "lost", "warning", seconds=3, progress="camera")
    terminal.show("report", "the story\nof it", seconds=4, progress="report")
    terminal.plain("the end")


def test_who_looks_sees_one_line_of_progress_for_each_stage(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "60")
    stream = Screen()
    tell(Terminal(stream))
    *stays, camera, filter, end = on_screen(stream.getvalue())
    assert stays == ["    3.0 s  camera           lost", "    4.0 s  report           the story", "of it"]
    assert end == "the end"
    assert camera == "    2.0 s  camera           frame 2"
    assert filter == f"    2.0 s  filter.0         scene 2 {'x' * 60}"[:59]


@pytest.mark.parametrize(("stream", "verbose"), [(io.StringIO(), False), (Screen(), True)])
def test_a_file_and_who_wants_all_of_it_get_every_line(stream: io.StringIO, verbose: bool):
    tell(Terminal(stream, verbose=verbose))
    assert "\033[J" not in stream.getvalue() and stream.getvalue().count("\n") == 10
