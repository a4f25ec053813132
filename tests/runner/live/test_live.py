"""The live tools on graphs that run: what they show, what they do, what they refuse."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from enum import Enum
from pathlib import Path
from typing import Annotated, cast

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from runner.cli.completion import Shell, script
from runner.cli.doctor import examine, examine_graph
from runner.cli.main import main
from runner.contract import Command, Refused, Spec, Stage
from runner.graph.graph import QUEUE
from runner.graph.reading import load_graph
from runner.inspect.echo import lines_of
from runner.live.live import Header, Live
from runner.live.tables import rate_text, show_lines, show_progress
from runner.message.codec import Envelope, LogLine, Step, open_envelope, pack, unpack
from runner.recording.recording import Recording
from runner.supervise.calls import CallQuestion, CallRequest, Calls, Progress, read_command
from runner.supervise.registry import Entry, Registration, find_run, runs
from runner.testing import read_until, start_graph
from runner.transport.bus import Bus
from runner.transport.session import new_endpoint, runtime_folder
from tests.runner.common.recordings import record_toys
from tests.runner.common.runs import ACCOUNT, DOUBLES, TOYS, changed, finish, processes_of
from tests.runner.common.runs import Run as Finished
from tests.runner.common.toys import Sum
from tests.runner.common.waiting import wait_until


class Run:
    """A running graph and its entry in the list of runs."""

    def __init__(self, folder: Path, graph: Path, *settings: str, options: tuple[str, ...] = ()) -> None:
        self.folder = folder
        self.process = start_graph(graph, *settings, folder=folder, options=options)
        self.printed = read_until(self.process, "processes are ready")
        self.entry = next(entry for entry in runs() if Path(entry.recording).parent == folder)

    def pid_of(self, stage: str) -> int:
        with Live(self.entry) as live:
            return next(process.pid for process in live.status().processes if process.stage == stage)

    def finish(self) -> Finished:
        return finish(self.process, self.folder, self.printed)

    def close(self) -> None:
        if self.process.stdout is not None and not self.process.stdout.closed:
            self.process.terminate()
            self.finish()


@pytest.fixture(scope="module", autouse=True)
def registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A list of runs of its own: other graphs may run on this machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))
        yield


@pytest.fixture
def nothing_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture(scope="module")
def account(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """A stage with commands; the last test of this file ends it."""
    running = Run(tmp_path_factory.mktemp("account"), ACCOUNT)
    yield running
    running.close()


def runner(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A command as a user types it."""
    command = [sys.executable, "-m", "runner.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


# ------------------------------------------------------------------------------------------ questions


def test_a_question_is_answered_refused_or_not_heard() -> None:
    def answer(question: bytes) -> bytes:
        if question == b"refuse":
            raise Refused("no such thing; valid: others")
        if question == b"raise":
            raise ValueError("seven")
        return question * 2

    endpoint = new_endpoint()
    server, client = Bus("toys", endpoint, listen=True), Bus("toys", endpoint)
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
    return Entry(run, "unixsock-stream//tmp/1", 1, "graph.yaml", f"recordings/{run}.mcap", time.time())


@pytest.mark.usefixtures("nothing_runs")
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


@pytest.mark.usefixtures("nothing_runs")
def test_of_a_run_that_died_its_own_sockets_are_removed_and_nothing_else(tmp_path: Path) -> None:
    own, foreign = new_endpoint(), tmp_path / "photos"
    foreign.mkdir()
    listed = (own, *(f"unixsock-stream/{path}" for path in (foreign / "1", runtime_folder() / "../1", tmp_path / "1")))
    for number, gateway in enumerate(listed):
        text = msgspec.json.encode(msgspec.structs.replace(entry(f"dead-{number}"), gateway=gateway))
        (runtime_folder() / f"dead-{number}.json").write_bytes(text)
    assert runs() == []
    assert foreign.exists()
    assert list(runtime_folder().iterdir()) == []


def test_a_folder_that_others_may_enter_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "runner").mkdir(mode=0o755)
    with pytest.raises(Refused, match="only this user may enter"):
        runs()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "absent"))
    assert runtime_folder() == Path(f"/tmp/runner-{os.getuid()}")


def test_a_supervisor_that_was_killed_is_struck_off_the_list(tmp_path: Path) -> None:
    run = Run(tmp_path, ACCOUNT)
    assert run.entry in runs()
    run.process.kill()
    run.process.communicate()
    wait_until(lambda: run.entry not in runs())


# ------------------------------------------------------------------------------------------ status


def test_a_run_says_how_its_processes_are(account: Run) -> None:
    with Live(account.entry) as live:
        live.wait_until_ready()
        wait_until(lambda: all(process.pulse and process.sent for process in live.status().processes[1:]))
        status = live.status()
    assert [process.name for process in status.processes] == ["recorder", "counter", "account"]
    assert {process.state for process in status.processes} <= {"waiting", "working", "held back"}
    assert status.endpoint == account.entry.gateway
    number = next(topic for topic in status.topics if topic.topic == "counter/number")
    assert (number.type, number.consumers) == ("Number", ("account.number",))


def test_a_process_that_stands_still_is_silent(account: Run) -> None:
    pid = account.pid_of("account")
    with Live(account.entry) as live:
        live.wait_until_ready()
        os.kill(pid, signal.SIGSTOP)
        try:
            wait_until(lambda: "silent" in [process.state for process in live.status().processes])
        finally:
            os.kill(pid, signal.SIGCONT)
        wait_until(lambda: "silent" not in [process.state for process in live.status().processes])


# ------------------------------------------------------------------------------------------ commands


def call(live: Live, command: str, **arguments: str) -> Progress:
    """The last news of a call that is followed to its end, with all log lines."""
    live.wait_until_ready()
    news = list(live.follow(live.call(CallRequest("account", command, arguments))))
    return msgspec.structs.replace(news[-1], lines=tuple(line for one in news for line in one.lines))


def test_a_stage_does_what_is_called(account: Run) -> None:
    with Live(account.entry) as live:
        assert call(live, "add", amount="5", note="from me").lines == (("info", "5 added from me"),)
        (emitted,) = call(live, "add", amount="-2").emitted
        assert emitted.startswith("account.sum#")
        assert call(live, "add", amount="0").refused == "amount=0: nothing to add; valid: any other number"
        with pytest.raises(Refused, match=r"^account add: Add.*: .*(range|64|large|integer)"):
            call(live, "add", amount="9" * 100)
        before = sum_of(call(live, "collect", count="1"))
        assert sum_of(call(live, "collect", count="3")) == before + 3


def sum_of(progress: Progress) -> int:
    return open_envelope(Sum, unpack(Envelope, progress.answer)).total


@pytest.mark.parametrize(
    ("stage", "command", "arguments", "reason"),
    [
        ("acount", "add", {}, "no stage 'acount'; did you mean 'account'? valid: account, counter"),
        ("account", "ad", {}, "account has no command 'ad'; did you mean 'add'? valid: add, collect"),
        ("account", "add", {}, "account add: needs amount=..."),
        (
            "account",
            "add",
            {"amout": "1"},
            "account add: no field 'amout'; did you mean 'amount'",
        ),
        (
            "account",
            "add",
            {"amount": "2026-13-45"},
            "account add: amount=2026-13-45: Expected `int`, got `str`; valid",
        ),
        ("account", "add", {"amount": "much"}, "account add: amount=much: Expected `int`, got `str`; valid: int"),
        (
            "account",
            "add",
            {"amount": "1", "tags": "[0]"},
            r"account add: tags=\[0\]: Expected `str`, got `int`; valid: list",
        ),
        (
            "account",
            "add",
            {"amount": "1", "mood": "mad"},
            "account add: mood=mad: .*; valid: glad | sad",
        ),
    ],
)
def test_what_breaks_the_type_of_a_command_is_refused(
    stage: str, command: str, arguments: dict[str, str], reason: str
) -> None:
    published: list[str] = []
    calls = Calls(load_graph(ACCOUNT), lambda port, *_: published.append(port))
    with pytest.raises(Refused, match=reason.replace("?", r"\?").replace("|", r"\|")):
        calls.call(CallRequest(stage, command, arguments))
    assert published == []


class Pace(Enum):
    SLOW = "slow"
    FAST = "fast"


class Move(Command, frozen=True, kw_only=True):
    to: Annotated[NDArray[np.float64], Spec("float64", (3,))] | None = None
    cells: Annotated[NDArray[np.uint8], Spec("uint8", ("N", 2))] | None = None
    pace: Pace = Pace.SLOW
    past: tuple[tuple[int, str], ...] = ()


class Mover(Stage):
    def on_move(self, move: Move) -> None: ...


def test_arrays_of_a_command_are_typed_as_lists() -> None:
    move = cast(
        "Move", read_command("mover move", Move, {"to": "[1, 2.5, -1e-3]", "cells": "[[0, 255]]", "pace": "fast"})
    )
    assert move.to is not None and move.cells is not None
    assert (move.to.dtype, move.to.tolist()) == (np.float64, [1.0, 2.5, -1e-3])
    assert (move.cells.dtype, move.cells.tolist(), move.pace) == (np.uint8, [[0, 255]], Pace.FAST)
    assert read_command("mover move", Move, {"to": "null"}) == Move()


@pytest.mark.parametrize(
    ("field", "text", "reason"),
    [
        ("to", "[1, 2]", "expected shape (3), got (2); valid: float64 (3) | None"),
        ("to", "[[1], [2, 3]]", "setting an array element with a sequence"),
        ("to", "[a, b, c]", "expected float64, got <U1; valid: float64 (3) | None"),
        ("cells", "[[0, 256]]", "expected uint8, got int64; valid: uint8 (N, 2) | None"),
        ("cells", "[[0, 1.5]]", "expected uint8, got float64; valid: uint8 (N, 2) | None"),
        ("pace", "FAST", "Invalid enum value 'FAST'; valid: slow | fast"),
        ("past", "[[1, 2]]", "Expected `str`, got `int`; valid: tuple[tuple[int, str], ...]"),
    ],
)
def test_what_is_no_such_array_or_choice_is_refused_with_what_is(field: str, text: str, reason: str) -> None:
    with pytest.raises(Refused, match=f"^{re.escape(f'mover move: {field}={text}: {reason}')}"):
        read_command("mover move", Move, {field: text})


def test_a_command_says_what_its_fields_take(tmp_path: Path) -> None:
    path = tmp_path / "mover.yaml"
    path.write_text(f"name: mover\nstages: {{mover: {{stage: '{__name__}:Mover'}}}}\n")
    (move,) = Calls(load_graph(path), lambda *_: "").types()
    kinds = ["float64 (3) | None", "uint8 (N, 2) | None", "slow | fast", "tuple[tuple[int, str], ...]"]
    assert [one.type for one in move.fields] == kinds
    assert [one.default for one in move.fields] == ["None", "None", "'slow'", "()"]


def test_commands_describe_themselves() -> None:
    add, collect = Calls(load_graph(ACCOUNT), lambda *_: None).types()
    assert (add.stage, add.name, add.text, add.answers) == ("account", "add", "Adds to the account.", ())
    assert [(one.name, one.type, one.default, one.text) for one in add.fields] == [
        ("amount", "int", None, "May be negative."),
        ("mood", "glad | sad", "'glad'", ""),
        ("note", "str", "''", ""),
        ("tags", "list[str]", "[]", ""),
    ]
    assert collect.answers == ("sum",)


def test_a_command_reaches_the_process_that_follows_a_dead_one(account: Run) -> None:
    with Live(account.entry) as live:
        os.kill(account.pid_of("account"), signal.SIGKILL)
        assert call(live, "add", amount="5").lines == (("info", "5 added"),)


def test_a_call_that_waits_for_room_when_the_graph_ends_spoils_no_recording(tmp_path: Path) -> None:
    run = Run(tmp_path, ACCOUNT, "counter.count=0")
    one = CallRequest("account", "add", {"amount": "1"})
    with Live(run.entry) as live, ThreadPoolExecutor() as pool:
        os.kill(run.pid_of("account"), signal.SIGSTOP)
        for _ in range(QUEUE):
            live.call(one)
        waiting = pool.submit(live.call, one)
        wait_until(lambda: live.status().published["supervisor/account_add"] == QUEUE + 1)
        live.down()
        assert waiting.result() == f"supervisor.account_add#{QUEUE}"
        with pytest.raises(Refused, match="the graph ends"):
            live.call(one)
    finished = run.finish()
    assert str(Recording(finished.recording).verdict) == "COMPLETE", finished.output


def publish(port: str, _: object, say: Callable[[str], None]) -> str:
    id = f"supervisor.{port}#0"
    say(id)
    return id


def test_an_answer_ends_its_call_though_it_comes_after_its_step() -> None:
    """It comes from its stage, and the step's from the recorder."""
    calls = Calls(load_graph(ACCOUNT), publish)
    id = calls.call(CallRequest("account", "collect", {"count": "1"}))
    step = Step("account", 0, 0, 0, "on_collect", (("collect", id),), (), 1, 0, 0, 0)
    calls.note_step(step)
    calls.note_step(msgspec.structs.replace(step, handler="on_number", consumed=(), emitted=("account.sum#0",)))
    calls.note_answer("account.sum#0", b"answer")
    progress = calls.progress(CallQuestion(id, 0))
    assert (progress.done, progress.answer) == (True, b"answer")


def test_a_call_is_done_when_every_replica_has_done_it_even_if_one_failed_before() -> None:
    graph = load_graph(ACCOUNT)
    graph.nodes["account"] = dataclasses.replace(graph.nodes["account"], replicas=2)
    calls = Calls(graph, publish)
    id = calls.call(CallRequest("account", "add", {"amount": "1"}))
    step = Step("account", 0, 0, 0, "on_add", (("add", id),), ("account.sum#0",), 1, 0, 0, 0)
    calls.note_step(msgspec.structs.replace(step, emitted=(), outcome="failed", error="gone"))
    calls.note_step(step)
    calls.note_log(LogLine("account", 0, "info", "half done", 1))
    assert not calls.progress(CallQuestion(id, 0)).done
    calls.note_step(msgspec.structs.replace(step, replica=1))
    done = calls.progress(CallQuestion(id, 0))
    assert (done.done, done.refused, done.emitted) == (True, "", ("account.sum#0",))
    assert done.lines == (("error", "gone"), ("info", "half done"))


def test_an_answer_without_success_is_an_exit_status(capsys: pytest.CaptureFixture[str]) -> None:
    def answered(success: bool) -> int:
        body = msgspec.Raw(msgspec.msgpack.encode({"success": success, "relations": [{"n": n} for n in range(40)]}))
        answer = pack(Envelope("account.sum#0", "account.sum#0", 1, "Sum", 1, (), body))
        return show_progress("supervisor.account_add#0", "account", [Progress((), True, answer=answer)])

    assert [answered(True), answered(False)] == [0, 1]
    assert "lines more" in capsys.readouterr().out


# ------------------------------------------------------------------------------------------ restart


def test_a_restart_in_order_loses_nothing_and_costs_no_budget(tmp_path: Path) -> None:
    settings = ("counter.count=60", "counter.period=0.05", "worker.seconds=0.02", "worker.restarts=0")
    files = (f"sink.path={tmp_path / 'out.txt'}", f"counter.go={tmp_path / 'go'}")
    run = Run(tmp_path, changed(TOYS, tmp_path, Counter="GatedCounter"), *files, *settings)
    with Live(run.entry) as live:
        with pytest.raises(Refused, match=r"no process 'worker'; did you mean 'worker.1'"):
            live.restart("worker")
        wait_until((tmp_path / "out.txt").exists)
        assert re.fullmatch(r"worker.1 is back: process \d+, ready after \d+\.\d s", live.restart("worker.1"))
        worker = next(process for process in live.status().processes if process.name == "worker.1")
        assert (worker.restarts, worker.reason) == (1, "asked to restart")
    (tmp_path / "go").touch()
    finished = run.finish()
    assert (finished.code, len(finished.result)) == (0, 60), finished.output
    recording = Recording(finished.recording)
    assert recording.verdict.complete
    steps = [step for step in recording.steps if step.stage == "worker"]
    assert {step.incarnation for step in steps if step.replica == 1} == {0, 1}
    # The end of the graph may stop a successor between its last message and its return.
    assert {step.outcome for step in steps if step.replica == 1 and step.incarnation == 0} == {"done"}
    pieces = [id for step in steps for port, id in step.consumed if port == "piece"]
    assert len(pieces) == len(set(pieces)) == 240


def test_a_graph_that_ends_while_a_process_finishes_its_step_to_restart_lacks_nothing(tmp_path: Path) -> None:
    settings = (f"sink.path={tmp_path / 'out.txt'}", f"doubler.marks={tmp_path}", "counter.count=100")
    run = Run(tmp_path, changed(DOUBLES, tmp_path, Doubler="Patient"), *settings)
    with ThreadPoolExecutor(1) as pool, Live(run.entry) as live:
        wait_until((tmp_path / "waits").exists)
        restarted = pool.submit(live.restart, "doubler")
        wait_until((tmp_path / "asked").exists)
        os.kill(run.process.pid, signal.SIGINT)
        finished = run.finish()
        with pytest.raises(Refused, match=r"^the graph ended before doubler was back"):
            restarted.result(60)
    recording = Recording(finished.recording)
    assert (finished.code, recording.verdict.complete) == (130, True), recording.verdict
    assert {step.outcome for step in recording.steps if step.stage == "doubler"} == {"stopped"}


def test_a_stage_that_would_forget_is_not_restarted(tmp_path: Path) -> None:
    settings = (f"sink.path={tmp_path / 'out.txt'}", f"doubler.marks={tmp_path}", f"counter.go={tmp_path / 'go'}")
    graph = changed(DOUBLES, tmp_path, Counter="GatedCounter", Doubler="Adder")
    run = Run(tmp_path, graph, *settings, options=("--steps-only",))
    with Live(run.entry) as live, pytest.raises(Refused, match=r"^doubler would forget what it knows: "):
        live.restart("doubler")
    (tmp_path / "go").touch()
    finished = run.finish()
    assert (finished.code, len(finished.result)) == (0, 5), finished.output


def test_parts_that_are_done_while_their_publisher_is_replaced_block_no_replica(tmp_path: Path) -> None:
    settings = ("counter.count=12", "counter.period=0.05", "worker.seconds=0.2", f"sink.path={tmp_path / 'out.txt'}")
    run = Run(tmp_path, changed(TOYS, tmp_path, Splitter="SlowSplitter"), *settings)
    with Live(run.entry) as live:
        for _ in range(2):
            wait_until((tmp_path / "out.txt").exists)
            time.sleep(0.3)
            assert "splitter is back" in live.restart("splitter")
    finished = run.finish()
    assert (finished.code, len(finished.result)) == (0, 12), finished.output
    assert Recording(finished.recording).verdict.complete


# ------------------------------------------------------------------------------------------ as a user types it


def test_ps_and_topic_list_show_what_runs(account: Run) -> None:
    assert runner("call", "account", "add", "amount=2").returncode == 0
    lines = runner("ps").stdout.splitlines()
    assert lines[0].startswith(f"{account.entry.run}: ")
    assert lines[1].split() == [
        "process",
        "state",
        "pid",
        "cpu",
        "memory",
        "queue",
        "steps/s",
        "restarts",
        "last",
        "reason",
    ]
    assert [line.split()[0] for line in lines[2:]] == ["recorder", "counter", "account"]
    topics = {line.split()[0]: line.split()[1:] for line in runner("topic", "list").stdout.splitlines()}
    assert topics["supervisor/account_add"][0] == "Add"
    assert int(topics["supervisor/account_add"][1]) > 0
    assert topics["account/sum"][-1] == "nobody"


def test_a_topic_is_measured_by_headers_and_shown_without_its_type(account: Run) -> None:
    assert re.search(
        r"\d+\.\d\d per second: every .*, \d+ messages", runner("topic", "hz", "counter/number", "-n", "2").stdout
    )
    assert re.search(r"B/s: 1\d\d.* each, smallest", runner("topic", "bw", "counter.number", "-n", "2").stdout)
    shown = runner("topic", "echo", "counter/number", "-n", "2").stdout.splitlines()
    assert re.fullmatch(r"counter.number#\d+: Number, \d+ B", shown[0])
    assert re.fullmatch(r"  value: \d+", shown[1])
    assert len(shown) == 6
    refused = runner("topic", "echo", "counter/numbr")
    assert refused.returncode == 2
    assert "no topic 'counter/numbr'; did you mean 'counter/number'" in refused.stderr


def test_log_lines_are_of_the_folder_and_the_stage_that_are_named(account: Run, tmp_path: Path) -> None:
    assert f"{tmp_path}: no recordings" in runner("logs", "--recordings", str(tmp_path)).stderr
    refused = runner("logs", "acount", "--follow")
    assert refused.stderr.startswith(f"{account.entry.recording}: no stage 'acount'; did you mean 'account'? valid: ")


@pytest.mark.usefixtures("nothing_runs")
@pytest.mark.parametrize("command", ["logs", "goals"])
def test_the_recording_of_a_run_that_has_just_begun_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    made, recording = record_toys(tmp_path)[0], tmp_path / "late.mcap"
    happens = iter((recording.touch, lambda: made.rename(recording)))
    monkeypatch.setattr("runner.live.live.is_alive", lambda _: next(happens)() is not False)
    listed = Registration(msgspec.structs.replace(entry("late"), recording=str(recording)))
    try:
        assert main([command]) == 0
    finally:
        listed.close()


def test_log_lines_end_with_who_reads_them(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stream, monkeypatch.context() as patch, pytest.raises(BrokenPipeError):
        patch.setattr(sys, "stdout", stream)
        show_lines(Path("toys.mcap"), [LogLine("sink", 0, "info", "done", 1)])


def test_a_tool_that_stands_still_costs_the_graph_nothing(account: Run) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it, as would the tool
    tool = subprocess.Popen(
        [sys.executable, "-m", "runner.cli", "topic", "echo", "counter/number"], stdout=subprocess.PIPE, text=True
    )
    assert tool.stdout is not None
    assert tool.stdout.readline()
    tool.send_signal(signal.SIGSTOP)
    with Live(account.entry) as live:
        seen = live.status().published
        assert call(live, "collect", count="20").done
        assert live.status().published != seen
    tool.send_signal(signal.SIGCONT)
    tool.send_signal(signal.SIGINT)
    tool.communicate(timeout=60)
    assert tool.returncode == 130


def test_two_graphs_never_meet(account: Run, tmp_path: Path) -> None:
    other = Run(tmp_path / "other", ACCOUNT, "counter.count=0")
    try:
        refused = runner("topic", "list")
        assert refused.returncode == 2
        assert (
            f"2 graphs are running: choose one with --run; valid: {account.entry.run}, {other.entry.run}"
            in refused.stderr
        )
        shown = runner("ps").stdout
        assert account.entry.run in shown
        assert other.entry.run in shown
        silent = runner("topic", "hz", "counter/number", "-n", "2", "--run", other.entry.run)
        assert silent.stdout.splitlines() == ["no messages", "no messages"]
        assert runner("call", "account", "add", "amount=2", "--run", other.entry.run).returncode == 0
        with Live(account.entry) as live:
            assert call(live, "add", amount="40").lines == (("info", "40 added"),)
        assert runner("down", "--run", other.entry.run).returncode == 0
        assert [found.run for found in runs()] == [account.entry.run]
    finally:
        other.close()


def test_no_interval_is_negative_where_what_replicas_sent_arrives_in_another_order() -> None:
    headers = [Header(sent_ns, 0, 1) for sent_ns in (30_000_000, 10_000_000, 20_000_000)]
    assert "shortest 10.00 ms, longest 10.00 ms" in rate_text(headers)


# ------------------------------------------------------------------------------------------ echo


def test_any_message_becomes_text() -> None:
    body = {
        "rgb": np.arange(60, dtype=np.uint8).reshape(4, 5, 3),
        "T": np.eye(2),
        "depth": np.array([np.nan] + [0.5] * 19, np.float32),
        "mask": np.arange(20) < 3,
        "names": ["cup", "jar"],
        "items": [{"name": "cup", "cost": 0.1 + 0.2}],
        "empty": [],
        "many": [{"n": n} for n in range(40)],
        "text": "one\ntwo",
    }
    raw = msgspec.Raw(
        msgspec.msgpack.encode(body, enc_hook=lambda array: [array.dtype.name, array.shape, array.tobytes()])
    )
    lines = list(lines_of(pack(Envelope("camera.frame#3", "world.look#0", 5, "Frame", 1, ("world.snapshot#1",), raw))))
    assert re.fullmatch(r"camera.frame#3: Frame, [\d.]+ k?B from world.snapshot#1", lines[0])
    assert lines[1:11] == [
        "  rgb: uint8 (4, 5, 3) 0 .. 59, mean 29.5",
        "  T: float64 (2, 2) [[1, 0], [0, 1]]",
        "  depth: float32 (20) 0.5 .. 0.5, mean 0.5, 1 not finite",
        "  mask: bool (20) 3 of 20 true",
        "  names: [cup, jar]",
        "  items:",
        "    - name: cup",
        "      cost: 0.3",
        "  empty: []",
        "  many:",
    ]
    assert lines[-4:] == ["    ... and 8 more", "  text: |", "      one", "      two"]
    assert next(lines_of(b"\xc1garbage")).startswith("unreadable, 8 B: ")


# ------------------------------------------------------------------------------------------ doctor, completion


def test_the_doctor_finds_this_machine_fit_and_a_bad_graph() -> None:
    found = list(examine(Path(__file__).parent))
    assert {finding.subject for finding in found} >= {
        "python",
        "packages",
        "zenoh",
        "recordings",
        "limits",
    }
    assert [finding for finding in found if finding.judgement == "bad"] == []
    assert not [finding for finding in found if "none known as tested" in finding.text]
    assert next(examine_graph(ACCOUNT)).judgement == "good"
    (bad,) = examine_graph(Path("absent.yaml"))
    assert (bad.judgement, "absent.yaml" in bad.text) == ("bad", True)


def test_the_doctor_says_what_to_type(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runner.cli.doctor.LEAST_DISK", 10**18)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "runner").mkdir(mode=0o755)
    found = {finding.subject: finding for finding in examine(tmp_path)}
    assert found["recordings"].remedy.startswith("remove old recordings")
    assert found["runs"].judgement == "bad"
    assert list(found["recordings"].lines())[1].strip() == f"-> {found['recordings'].remedy}"


def completions(line: str) -> set[str]:
    """What the shell is told where Tab is pressed at the end of a line."""
    with tempfile.NamedTemporaryFile() as answer:
        asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": answer.name, "_ARGCOMPLETE_IFS": "\n"}
        place = {"COMP_LINE": line, "COMP_POINT": str(len(line))}
        command = [sys.executable, "-m", "runner.cli"]
        subprocess.run(command, env={**os.environ, **asked, **place}, timeout=60, check=False)
        return {found.strip() for found in answer.read().decode().split("\n")}


def test_shells_complete_commands_and_what_runs(account: Run) -> None:
    assert {"ps", "topic", "doctor"} <= completions("runner ")
    assert completions("runner topic echo cou") == {"counter/number"}
    assert completions("runner call ") >= {"account"}
    assert completions("runner call account ") >= {"add", "collect"}
    assert completions("runner call account add am") == {"amount="}
    assert completions("runner ps --run acc") == {account.entry.run}


@pytest.mark.parametrize(("shell", "word"), [("bash", "complete "), ("zsh", "compdef"), ("fish", "complete --command")])
def test_completion_is_printed_for_a_shell(shell: str, word: str) -> None:
    assert word in script(cast("Shell", shell))


# ------------------------------------------------------------------------------------------ the end


def test_log_lines_of_a_run_and_its_end_in_order(account: Run) -> None:
    assert runner("call", "account", "add", "amount=2").stdout.splitlines()[0].endswith("account          2 added")
    wait_until(lambda: "2 added" in runner("logs", "account").stdout)
    follower = subprocess.Popen(
        [sys.executable, "-m", "runner.cli", "logs", "-f"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert read_until(follower, "2 added")
    assert runner("call", "account", "add", "amount=0").returncode == 2
    assert read_until(follower, "nothing to add")
    assert runner("down").stdout.startswith(f"{account.entry.run} has ended")
    assert account.entry not in runs()
    assert processes_of(account.folder) == []
    assert follower.wait(30) == 0
    follower.communicate()
    last = runner("logs", "--recordings", str(account.folder)).stdout
    assert "2 added" in last
    assert "nothing to add" in last
    refused = runner("logs", "acount", "--recordings", str(account.folder))
    assert "no stage 'acount'; did you mean 'account'" in refused.stderr
    finished = account.finish()
    assert finished.code == 0, finished.output
    recording = Recording(finished.recording)
    assert recording.verdict.complete
    assert recording.envelope("supervisor.account_add#0").type == "Add"
    replayed = runner("replay", str(finished.recording), "--verify")
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
