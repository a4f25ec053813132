"""The live tools on graphs that run: what they show, what they do, what they refuse."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from runner.bus import Bus, free_endpoint
from runner.contract import Refused
from runner.registry import Entry, Registration, find_run, runs
from runner.status import RunStatus
from tests.runner.test_runs import DOUBLES, finish, read_until, start

ENDLESS = ("counter.count=1000000", "counter.period=0.02", "sink.count=1000000")


class Live:
    """A running graph and a bus of a tool that looks at it."""

    def __init__(self, folder: Path, graph: Path = DOUBLES, *settings: str) -> None:
        self.folder = folder
        self.process = start(graph, folder, *(settings or ENDLESS))
        self.printed = read_until(self.process, "processes are ready")
        self.entry = next(entry for entry in runs() if Path(entry.recording).parent == folder)

    def status(self) -> RunStatus:
        bus = Bus(self.entry.run, connect=self.entry.endpoint)
        try:
            return msgspec.json.decode(bus.ask("status", b"", 20), type=RunStatus)
        finally:
            bus.close()

    def close(self) -> None:
        self.process.terminate()
        finish(self.process, self.folder, self.printed)


@pytest.fixture(autouse=True)
def registry(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lists of runs of their own: other graphs may run on this machine."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    running = Live(tmp_path)
    yield running
    running.close()


def wait_for(condition: Callable[[], bool], seconds: float = 30) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it never came true"
        time.sleep(0.05)


# ------------------------------------------------------------------------------------------ questions


def test_a_question_is_answered_refused_or_not_heard() -> None:
    def answer(question: bytes) -> bytes:
        if question == b"refuse":
            raise Refused("no such thing; valid: others")
        if question == b"raise":
            raise ValueError("seven")
        return question * 2

    endpoint = free_endpoint()
    server, client = Bus("toys", listen=endpoint), Bus("toys", connect=endpoint)
    server.serve("double", answer)
    try:
        assert client.ask("double", b"ab", 20) == b"abab"
        with pytest.raises(Refused, match=r"^no such thing; valid: others$"):
            client.ask("double", b"refuse", 20)
        with pytest.raises(Refused, match=r"^ValueError: seven$"):
            client.ask("double", b"raise", 20)
        with pytest.raises(Refused, match=r"toys: no answer to 'halve' within 0.2 s"):
            client.ask("halve", b"ab", 0.2)
    finally:
        client.close()
        server.close()


# ------------------------------------------------------------------------------------------ the list of runs


def entry(run: str) -> Entry:
    return Entry(run, "tcp/127.0.0.1:1", 1, "graph.yaml", f"recordings/{run}.mcap", time.time())


def test_a_run_is_listed_as_long_as_its_process_lives() -> None:
    one, two = Registration(entry("one-1")), Registration(entry("two-1"))
    assert [found.run for found in runs()] == ["one-1", "two-1"]
    with pytest.raises(Refused, match="another run of that name"):
        Registration(entry("one-1"))
    with pytest.raises(Refused, match=r"2 graphs are running: choose one with --run; valid: one-1, two-1"):
        find_run()
    with pytest.raises(Refused, match=r"--run three: no such run; valid: one-1, two-1"):
        find_run("three")
    assert find_run("two").run == "two-1"
    one.close()
    assert find_run().run == "two-1"
    two.close()
    with pytest.raises(Refused, match="no graph is running"):
        find_run()


def test_a_folder_that_others_may_enter_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "runner").mkdir(mode=0o755)
    with pytest.raises(Refused, match="only this user may enter"):
        runs()


def test_a_supervisor_that_was_killed_is_struck_off_the_list(live: Live) -> None:
    assert [found.run for found in runs()] == [live.entry.run]
    live.process.kill()
    live.process.communicate()
    wait_for(lambda: not runs())


# ------------------------------------------------------------------------------------------ status


def test_a_run_says_how_its_processes_are(live: Live) -> None:
    status = live.status()
    assert status.ready
    assert {process.name: process.state for process in status.processes} == {
        "recorder": "ready",
        "counter": "ready",
        "doubler": "ready",
        "sink": "ready",
    }
    assert status.recording == live.entry.recording
