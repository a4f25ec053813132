"""Why, how long and what differs: the commands that look into a recording."""

import os
import random
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.cli.main import main
from runner.contract import Refused
from runner.graph.reading import load_graph
from runner.inspect.causes import Causes
from runner.inspect.info import Durations, StageTimes, seconds
from runner.inspect.latency import critical_paths, latency
from runner.inspect.skipped import Skipped
from runner.message.codec import Envelope, Step
from runner.recording.recording import STEPS_ONLY, Recording
from tests.runner.common.recordings import TOYS, record, record_toys, rewrite
from tests.runner.common.runs import ALBUM, DOUBLES

MS = 1_000_000
COSTS = {"splitter": (1, 2, 10), "worker": (3, 4, 50), "gatherer": (5, 6, 20), "sink": (7, 8, 30)}
"""Milliseconds travelled, queued and computed, by stage."""


def costly(record: Envelope | Step) -> Envelope | Step:
    if not isinstance(record, Step) or record.stage not in COSTS:
        return record
    travelled, queued, computed = (MS * cost for cost in COSTS[record.stage])
    return msgspec.structs.replace(record, travelled_ns=travelled, waited_ns=queued, computed_ns=computed)


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_toys(tmp_path_factory.mktemp("toys"), keep=costly)[0]


# ------------------------------------------------------------------------------------ why


def test_the_tree_leads_back_to_the_start_of_the_lineage_with_every_hop(toys: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["why", "gatherer.total#1", str(toys)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "gatherer.total#1  Total, travelled 5.00 ms, queued 6.00 ms, computed 20.00 ms"
    assert lines[1].startswith("├─ answers: worker.answer#4  Answer, travelled 3.00 ms, queued 4.00 ms, computed 50.00")
    assert lines[2].startswith("│  ├─ piece: splitter.piece#4  Piece, travelled 1.00 ms")
    assert lines[3].startswith("│  │  └─ number: counter.number#1  Number, computed")
    assert lines[3].endswith("the lineage starts here")
    assert lines[4] == "│  └─ number: counter.number#1, as above"
    assert lines[-1] == "└─ number: counter.number#1, as above"
    assert sum("worker.answer" in line for line in lines) == 4


def test_the_newest_recording_is_the_default(toys: Path, capsys: pytest.CaptureFixture[str]):
    (toys.parent / "dead.mcap").symlink_to("absent.mcap")
    (toys.parent / "folder.mcap").mkdir()
    os.mkfifo(toys.parent / "pipe.mcap")
    assert main(["why", "counter.number#0", "--recordings", str(toys.parent)]) == 0
    assert "counter.number#0  Number" in capsys.readouterr().out


def test_an_unknown_message_is_refused_with_the_nearest(toys: Path):
    with pytest.raises(Refused, match=r"no message 'gatherer\.totl#1'; did you mean 'gatherer\.total'"):
        list(Causes(Recording(toys)).tree_of("gatherer.totl#1"))


def test_a_cause_that_is_missing_is_named(tmp_path: Path):
    lost = "worker.answer#5"
    path, _ = record_toys(tmp_path, keep=lambda record: None if getattr(record, "id", "") == lost else record)
    lines = list(Causes(Recording(path)).tree_of("gatherer.total#1"))
    assert any(f"{lost}  MISSING from the recording, travelled" in line for line in lines)
    assert any("splitter.piece#5" in line for line in lines)


def test_without_a_journal_the_causes_in_the_header_are_shown(tmp_path: Path):
    path, _ = record_toys(tmp_path, keep=lambda record: None if isinstance(record, Step) else record)
    lines = list(Causes(Recording(path)).tree_of("splitter.piece#4"))
    assert lines == ["splitter.piece#4  Piece", "└─ counter.number#1  Number, the lineage starts here"]


def test_a_long_chain_of_causes_is_shown_in_as_much_as_it_is_long(tmp_path: Path):
    ids = [f"doubler.double#{number}" for number in range(5000)]
    body = msgspec.Raw(msgspec.msgpack.encode({}))
    chain = [Envelope(ids[0], ids[0], 0, "Double", 1, (), body)]
    chain += [Envelope(id, ids[0], 0, "Double", 1, (before,), body) for before, id in pairwise(ids)]
    graph = load_graph(DOUBLES, (f"sink.path={tmp_path}",))
    causes = Causes(Recording(record(graph, tmp_path / "chain.mcap", chain)[0]))
    lines = list(causes.tree_of(ids[-1]))
    assert (len(lines), lines[1], lines[2]) == (5000, f"└─ {ids[-2]}  Double", f"   └─ {ids[-3]}  Double")
    assert lines[-1].endswith(f"  └─ {ids[0]}  Double, the lineage starts here")
    assert max(map(len, lines)) < 200
    assert causes.path_to(ids[-1]) == ids


# ------------------------------------------------------------------------------------ latency


def test_the_critical_path_goes_through_what_came_last(toys: Path):
    recording = Recording(toys)
    causes = Causes(recording)
    path = causes.path_to("gatherer.total#1")
    assert path == ["counter.number#1", "splitter.piece#7", "worker.answer#7", "gatherer.total#1"]
    (last,) = (found for found in critical_paths(recording, causes) if found.last == "sink.finished#0")
    assert [hop.stage for hop in last.hops] == ["splitter", "worker", "gatherer", "sink"]
    times = [(hop.travelled_ns, hop.waited_ns, hop.computed_ns) for hop in last.hops]
    assert times == [tuple(MS * cost for cost in costs) for costs in COSTS.values()]
    assert last.elapsed_ns >= sum(map(sum, times))


def test_latency_by_edge_stage_and_lineage(toys: Path):
    lines = latency(toys)
    (edge,) = (line for line in lines if line.startswith("splitter/piece -> worker.piece"))
    assert edge.split()[3:] == ["20", "3.00", "ms", "3.00", "ms", "4.00", "ms", "4.00", "ms"]
    (stage,) = (line for line in lines if line.startswith("worker.on_piece"))
    assert stage.split()[1:] == ["20", "50.00", "ms", "50.00", "ms", "1.00", "s"]
    assert "counter.number#4: splitter 13.00 ms, worker 57.00 ms, gatherer 31.00 ms, sink 45.00 ms" in lines


def test_a_recording_of_nothing_has_no_latency(tmp_path: Path):
    path, _ = record_toys(tmp_path, keep=lambda _: None)
    assert latency(path) == [f"{path}: {Recording(path).verdict}"]


# ------------------------------------------------------------------------------------ diff


def test_equal_recordings_do_not_differ(toys: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["diff", str(toys), str(toys)]) == 0
    assert "no difference: 51 messages are equal" in capsys.readouterr().out


def test_the_first_difference_then_every_field_of_every_topic(
    toys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    other, _ = record_toys(tmp_path, "seed=8", "splitter.parts=3")
    assert main(["diff", str(toys), str(other)]) == 1
    said = capsys.readouterr().out
    assert "seed: 7 and 8" in said
    assert "first difference: splitter.piece#0: count: 4 and 3" in said
    rows = {
        tuple(line.split()[:2]): line.split()[2:] for line in said.splitlines() if line.startswith(("worker/", "gath"))
    }
    assert rows["worker/answer", "count"][:4] == ["15", "of", "15", "1"]
    assert rows["worker/answer", "samples[]"][:3] == ["15", "of", "15"]
    assert rows["worker/answer", "5"] == ["0"]
    assert rows["gatherer/total", "samples"][:3] == ["5", "of", "5"]


def test_a_message_that_one_recording_lacks(toys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    lost = "gatherer.total#2"
    other, _ = record_toys(tmp_path, keep=lambda record: None if getattr(record, "id", "") == lost else record)
    assert main(["diff", str(toys), str(other)]) == 1
    said = capsys.readouterr().out
    assert f"first difference: {lost}: only in {toys}" in said
    assert any(line.split() == ["gatherer/total", "1", "0"] for line in said.splitlines())


# ------------------------------------------------------------------------------------ steps only


def test_where_no_messages_were_recorded_none_are_compared_or_missed_and_steps_tell_the_time(
    toys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    steps, _ = record_toys(tmp_path, keep=lambda record: record if isinstance(record, Step) else None)
    path = rewrite(steps, tmp_path / "steps.mcap", lambda _, data: data, {"records": STEPS_ONLY})
    for typed in (
        ["diff", str(toys), str(path)],
        ["diff", str(path), str(path)],
        ["why", "sink.finished#0", str(path)],
    ):
        assert main(typed) == 2
        assert capsys.readouterr() == ("", f"{path}: holds no messages (runner up --steps-only)\n")
    assert main(["info", str(path)]) == 0
    assert "lasted 0.00 ms" not in capsys.readouterr().out
    said = latency(path)
    edges = {line.partition("  ")[0] for line in said if " -> " in line}
    assert edges == {"counter/number -> splitter.number", "gatherer/total -> sink.total"}
    assert "left out: 25 steps that took several messages; no message is recorded that says which came last" in said


# ------------------------------------------------------------------------------------ step by step


@given(times=st.lists(st.integers(0, 10**12), min_size=1, max_size=200))
def test_durations_in_little_memory_are_as_good_as_exact(times: list[int]):
    durations = Durations()
    for one in times:
        durations.note(one)
    assert (durations.total, durations.largest) == (sum(times), max(times))
    assert durations.median == pytest.approx(np.median(times), rel=0.01)


def test_a_duration_is_rounded_before_it_is_put_into_words():
    words = [seconds(1e9 * one) for one in (119.7, 60.2, 59.999, 59.99, 0.999999, 0.25)]
    assert words == ["2 min 0 s", "1 min 0 s", "1 min 0 s", "59.99 s", "1.00 s", "250.00 ms"]


def test_the_table_of_times_counts_steps_and_not_how_processes_end():
    times = StageTimes()
    for number, outcome in enumerate(("done", "failed", "stopped", "ended")):  # stopped: by the end of the graph
        times.note(Step("worker", 1, 0, number, "on_piece", (), (), 0, 2 * MS, 3 * MS, (number + 1) * MS, outcome))
    times.note(Step("supervisor", 0, 0, 0, "", (), ("supervisor.restarted#0",), 0, 0, 0, 0))
    _, row = times.lines()
    cells = ["1", "3", "2.00 ms", "3.00 ms", "6.00 ms", "3.00 ms", "2.00 ms", "1"]
    assert row.split("  ")[0] == "worker"
    assert [cell.strip() for cell in row.split("  ")[1:] if cell.strip()] == cells


def test_what_edges_of_policy_latest_left_out():
    skipped = Skipped(load_graph(ALBUM, ("sink.path=out.txt",)))
    skipped.note(Step("camera", 0, 0, 0, "source", (), tuple(f"camera.picture#{n}" for n in range(5)), 0, 0, 0, 0))
    skipped.note(Step("glance", 0, 0, 0, "on_picture", (("picture", "camera.picture#4"),), (), 0, 0, 0, 0))
    assert list(skipped.lines()) == ["glance.picture: 4 of 5 messages skipped (policy latest)"]


def test_memory_does_not_grow_with_the_steps():
    times, skipped = StageTimes(), Skipped(load_graph(TOYS, ("sink.path=out.txt",)))
    rng, sizes = random.Random(0), list[int]()
    for number in range(30_000):
        consumed, emitted = (("piece", f"splitter.piece#{number}"),), (f"worker.answer#{number}",)
        spent = [round(rng.lognormvariate(12, 2)) for _ in range(3)]
        step = Step("worker", number % 2, 0, number // 2, "on_piece", consumed, emitted, 0, *spent)
        times.note(step)
        skipped.note(step)
        if number % 10_000 == 9_999:
            sizes.append(sum(map(len, times._stages["worker"].computed._like.values())) + len(skipped._consumed))
    assert sizes[-1] < 1.2 * sizes[0] < 5_000
