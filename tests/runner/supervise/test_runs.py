"""Whole runs of toy graphs: nothing is lost, nothing is left behind, and a crash changes no byte."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from runner.contract import Refused
from runner.recording.recording import Recording
from runner.replay.replay import verify
from runner.testing import read_until
from runner.transport.bus import Bus
from tests.runner.common.runs import (
    DOUBLES,
    TOYS,
    Run,
    changed,
    finish,
    meeting_of,
    processes_of,
    run,
    start,
    wait_for_links,
)
from tests.runner.common.waiting import wait_until


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """An undisturbed run of the toy graph."""
    return run(TOYS, tmp_path_factory.mktemp("plain"))


def test_a_run_ends_by_itself_with_a_complete_recording(plain: Run):
    assert plain.code == 0, plain.output
    assert len(plain.result) == 5
    assert plain.output.splitlines()[-1] == "all totals written"
    assert "COMPLETE" in plain.output
    assert Recording(plain.recording).verdict.complete
    assert processes_of(plain.folder) == []


def test_no_message_is_lost_at_the_start(plain: Run):
    consumed = {id for step in Recording(plain.recording).steps for _, id in step.consumed}
    assert {f"counter.number#{number}" for number in range(5)} <= consumed
    assert {f"splitter.piece#{number}" for number in range(20)} <= consumed


def test_what_caused_a_message_is_on_it(plain: Run):
    messages = {envelope.id: envelope for envelope in Recording(plain.recording).envelopes()}
    total = messages["gatherer.total#1"]
    assert total.causes == (*(f"worker.answer#{number}" for number in range(4, 8)), "counter.number#1")
    assert total.lineage == "counter.number#1"
    assert total.time_ns == messages["counter.number#1"].time_ns


def test_one_replica_and_another_seed(plain: Run, tmp_path: Path):
    alone = tmp_path / "alone"
    alone.mkdir()
    assert run(TOYS, alone, "worker.replicas=1").result == plain.result
    other = tmp_path / "other"
    other.mkdir()
    assert run(TOYS, other, "seed=8").result != plain.result


def test_a_killed_replica_changes_no_byte(plain: Run, tmp_path: Path):
    graph = changed(TOYS, tmp_path, Counter="GatedCounter")
    process = start(graph, tmp_path, f"counter.go={tmp_path / 'go'}", "worker.die_at=2", "worker.seconds=0.05")
    before = read_until(process, "noticed")
    (tmp_path / "go").touch()
    killed = finish(process, tmp_path, before)
    assert killed.code == 0, killed.output
    assert killed.result == plain.result
    assert re.search(r"watcher +noticed: worker\.\d restarted: killed by SIGKILL", killed.output)
    recording = Recording(killed.recording)
    assert recording.verdict.complete
    bodies = {e.id: bytes(e.body) for e in recording.envelopes()}
    assert all(bodies[e.id] == bytes(e.body) for e in Recording(plain.recording).envelopes())


@pytest.mark.parametrize("die_at", [0, 2, 4])
def test_a_killed_stage_goes_on_where_it_was(tmp_path: Path, die_at: int):
    killed = run(DOUBLES, tmp_path, f"doubler.die_at={die_at}")
    assert (killed.code, killed.result) == (0, ["0", "2", "4", "6", "8"]), killed.output


def test_a_stage_that_raises_is_restarted_within_its_budget(tmp_path: Path):
    failed = run(DOUBLES, tmp_path, "doubler.raise_at=2", "doubler.restarts=1")
    assert failed.code == 1
    last = failed.output.splitlines()[-1]
    assert last.startswith("doubler failed after 1 restarts: ValueError: cannot double 2 (tests/runner/common/toys.py:")


def test_a_refusal_ends_the_graph_with_one_line(tmp_path: Path):
    refused = run(DOUBLES, tmp_path, "doubler.refuse_at=1")
    assert refused.code == 2
    assert refused.output.splitlines()[-1] == "doubler: number 1: valid: anything else"
    assert "Traceback" not in refused.output


def test_a_file_whose_name_is_no_text_can_be_named(tmp_path: Path):
    refused = run(changed(DOUBLES, tmp_path, Doubler="NamesAFile"), tmp_path)
    assert refused.code == 2
    assert re.search(r"doubler +no d\\udcffd.png here", refused.output), refused.output
    assert refused.output.splitlines()[-1] == r"doubler: no d\udcffd.png"
    assert "Traceback" not in refused.output
    recording = Recording(refused.recording)
    assert recording.verdict.complete
    assert r"Refused: no d\udcffd.png" in [step.error for step in recording.steps]


def test_a_run_whose_standard_streams_are_closed_says_nothing_and_works(tmp_path: Path):
    up = ["up", str(DOUBLES), "--recordings", str(tmp_path), "--set", f"sink.path={tmp_path / 'out.txt'}"]
    command = ["sh", "-c", 'exec "$0" "$@" <&- >&- 2>&-', sys.executable, "-m", "runner.cli", *up]
    assert subprocess.run(command, timeout=60, check=False).returncode == 0
    (path,) = tmp_path.glob("*.mcap")
    assert Recording(path).verdict.complete


def test_a_stage_that_cannot_start_is_named(tmp_path: Path):
    graph = tmp_path / "graph.yaml"
    broken = "  broken:\n    stage: tests.runner.common.toys:BrokenAtStart\n    inputs: {number: counter.number}\n"
    graph.write_text(DOUBLES.read_text() + broken)
    refused = run(graph, tmp_path)
    assert refused.code == 2
    assert refused.output.splitlines()[-1] == "broken: weights.bin: no such file; valid: a file that exists"
    assert processes_of(tmp_path) == []


def test_the_code_of_the_end_is_the_exit_status(tmp_path: Path):
    assert run(TOYS, tmp_path, "sink.code=1", "counter.count=1").code == 1


def test_a_code_that_no_exit_status_can_be_is_no_success(tmp_path: Path):
    wrong = run(TOYS, tmp_path, "sink.code=256", "counter.count=1")
    assert wrong.code == 1
    last = wrong.output.splitlines()[-1]
    assert last.startswith("sink failed after 0 restarts: CodecError: Finished.code: Expected `int` <= 255 ("), last


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_leaves_a_complete_recording_and_no_process(tmp_path: Path, signum: signal.Signals):
    process = start(DOUBLES, tmp_path, "counter.count=100000", "counter.period=0.005", "sink.count=100000")
    before = read_until(process, "processes are ready")
    time.sleep(0.5)
    os.kill(process.pid, signum)
    ended = finish(process, tmp_path, before)
    assert ended.code == 128 + signum
    assert Recording(ended.recording).verdict.complete
    assert processes_of(tmp_path) == []


def test_children_die_with_their_supervisor(tmp_path: Path):
    process = start(DOUBLES, tmp_path, "counter.count=100000", "counter.period=0.005", "sink.count=100000")
    read_until(process, "processes are ready")
    assert len(processes_of(tmp_path)) == 4
    process.kill()
    process.communicate()
    wait_until(lambda: processes_of(tmp_path) == [])


def test_corrupt_bytes_are_refused_and_counted_and_the_process_lives_on(tmp_path: Path):
    graph = changed(DOUBLES, tmp_path, Counter="GatedCounter")
    process = start(graph, tmp_path, f"counter.go={tmp_path / 'go'}", "counter.count=40", "sink.count=40")
    before = read_until(process, "processes are ready")
    match = re.search(r"run (\S+) on (\S+)", before)
    assert match is not None
    bus = Bus(match[1], meeting_of(match[2]))
    wait_for_links(bus, ("doubler", 0), ("counter", 0))
    for key in ("again/doubler/0/number", "j/doubler"):
        bus.publish(key, b"\xc1garbage")
        before += "" if f"{key}: message refused" in before else read_until(process, f"{key}: message refused")
    (tmp_path / "go").touch()
    ended = finish(process, tmp_path, before)
    bus.close()
    assert len(ended.result) == 40
    assert "again/doubler/0/number: message refused (1 so far): Envelope: MessagePack data is malformed" in ended.output
    assert "j/doubler: message refused (1 so far): Journal" in ended.output


def test_a_slow_consumer_holds_its_publisher_back(tmp_path: Path):
    slow = run(DOUBLES, tmp_path, "counter.count=20", "sink.count=20", "doubler.seconds=0.05")
    assert (slow.code, len(slow.result)) == (0, 20), slow.output
    order = [step.handler for step in Recording(slow.recording).steps if step.stage in ("counter", "doubler")]
    ahead = [order[:end].count("source") - order[:end].count("on_number") for end in range(len(order))]
    assert max(ahead) <= 6  # a queue of 4, one being published and one in work


def test_a_run_that_records_steps_only_says_so_and_cannot_be_replayed(tmp_path: Path):
    done = run(DOUBLES, tmp_path, flags=("--steps-only",))
    recording = Recording(done.recording)
    assert done.code == 0
    assert (len(recording.messages), str(recording.verdict)) == (0, "INCOMPLETE: steps only")
    assert {step.stage for step in recording.steps} == {"counter", "doubler", "sink"}
    with pytest.raises(Refused, match="holds no messages"):
        verify(done.recording, (), workers=1)
