import io
import os

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
