import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from runner.graph.reading import load_graph
from runner.message.codec import Envelope, Lost, Step, decode, envelope, pack, unpack
from runner.recording.recording import Recording
from runner.replay.replay import change
from runner.replay.tasks import Comparison, Execution, Reexecution
from tests.runner.common.recordings import ToyRun, record, record_toys, rewrite
from tests.runner.common.toys import Answer, Gatherer

TABLE = "tolerances=tests.runner.common.toys:TOLERANCES"
HEADER = {"id": "a.b#0", "lineage": "a.b#0", "time_ns": 0, "causes": ()}


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_toys(tmp_path_factory.mktemp("toys"))[0]


def replay(path: Path, *arguments: str) -> tuple[int, str]:
    """``runner replay`` as a user types it: its exit status, and all that it says."""
    command = (sys.executable, "-m", "runner.cli", "replay", str(path), *arguments)
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    return done.returncode, done.stdout + done.stderr


def verify(path: Path, *assignments: str, workers: int = 2) -> tuple[int, str]:
    settings = [part for assignment in assignments for part in ("--set", assignment)]
    return replay(path, "--verify", "--workers", str(workers), *settings)


def changed(toys: Path, tmp_path: Path, id: str, change: Callable[[Envelope], Envelope | bytes]) -> Path:
    def change_one(topic: str, data: bytes) -> bytes:
        if topic.startswith(("journal/", "log/")):
            return data
        sealed = unpack(Envelope, data)
        new = change(sealed) if sealed.id == id else data
        return pack(new) if isinstance(new, Envelope) else new

    return rewrite(toys, tmp_path / "changed.mcap", change_one)


def one_byte(sealed: Envelope, place: int, value: int) -> Envelope:
    body = bytearray(sealed.body)
    body[place] = value
    return msgspec.structs.replace(sealed, body=msgspec.Raw(bytes(body)))


def test_every_message_is_identical(toys: Path):
    code, said = verify(toys)
    assert code == 0, said
    assert "worker (1 of 2): 10 steps, 10 messages" in said
    assert "IDENTICAL: 45 messages of 3 stages" in said
    assert "counter" not in said.partition("IDENTICAL")[0].replace(str(toys), "")


def test_a_copy_by_another_tool_is_identical_too(toys: Path, tmp_path: Path):
    code, said = verify(rewrite(toys, tmp_path / "copy.mcap", lambda _, data: data))
    assert code == 0, said


def test_a_changed_byte_in_an_input_diverges_with_stage_step_and_field(toys: Path, tmp_path: Path):
    """Counter is a device: splitter, worker and gatherer consume the changed number; splitter's output comes first."""
    place = bytes(Recording(toys).envelope("counter.number#2").body).index(b"value") + len("value")
    path = changed(toys, tmp_path, "counter.number#2", lambda sealed: one_byte(sealed, place, 9))
    code, said = verify(path)
    assert code == 1
    expected = "DIVERGED first at stage splitter[0], step 2, message splitter.piece#8: value: recorded 2, replayed 9"
    assert expected in said
    assert "4 DIVERGED" in said


def test_a_changed_byte_in_an_array_names_the_element(toys: Path, tmp_path: Path):
    last = len(bytes(Recording(toys).envelope("worker.answer#0").body)) - 2
    path = changed(toys, tmp_path, "worker.answer#0", lambda sealed: one_byte(sealed, last, 0x41))
    code, said = verify(path)
    assert code == 1
    assert "DIVERGED first at stage worker[0], step 0, message worker.answer#0: samples[2]: recorded" in said
    assert "1 of 3 elements differ" in said


@pytest.mark.parametrize(("field", "value"), [("lineage", "counter.number#1"), ("time_ns", 5), ("causes", ("a.b#0",))])
def test_a_changed_header_diverges(toys: Path, tmp_path: Path, field: str, value: object):
    id = "gatherer.total#3"
    path = changed(toys, tmp_path, id, lambda sealed: msgspec.structs.replace(sealed, **{field: value}))
    code, said = verify(path)
    assert code == 1
    assert f"message {id}: {field}" in said


def test_an_input_that_no_longer_decodes_is_one_clear_line(toys: Path, tmp_path: Path):
    place = bytes(Recording(toys).envelope("counter.number#2").body).index(b"value")
    code, said = verify(changed(toys, tmp_path, "counter.number#2", lambda sealed: one_byte(sealed, place, ord("V"))))
    assert code == 1
    (line,) = (line for line in said.splitlines() if line.startswith("DIVERGED"))
    assert "step 2" in line
    assert "cannot be executed: input counter.number#2" in line


def test_an_envelope_that_no_longer_decodes_is_one_clear_line(toys: Path, tmp_path: Path):
    code, said = verify(changed(toys, tmp_path, "counter.number#2", lambda _: b"\xc1"))
    assert code == 1
    assert "cannot be executed: counter.number#2 is not recorded" in said
    assert "INCOMPLETE" in said


def test_another_setting_diverges(toys: Path):
    code, said = verify(toys, "splitter.parts=3")
    assert code == 1
    assert "stage splitter[0], step 0, message splitter.piece#0: count: recorded 4, replayed 3" in said


def test_a_lost_output_is_not_verified(tmp_path: Path):
    lost = "gatherer.total#4"
    path, _ = record_toys(tmp_path, keep=lambda record: None if getattr(record, "id", "") == lost else record)
    code, said = verify(path)
    assert code == 1
    assert f"NOT VERIFIED: 44 of 44 messages compared, none differs; INCOMPLETE: 1 missing: {lost}" in said


def test_a_torn_recording_is_verified_as_far_as_it_goes(toys: Path, tmp_path: Path):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(toys.read_bytes()[:-600])
    code, said = verify(torn)
    assert code == 1
    assert "45 of 45 messages compared, none differs; INCOMPLETE: torn at byte" in said


def test_each_incarnation_is_a_fresh_instance_that_goes_on_counting(tmp_path: Path):
    """As if the gatherer had been restarted after its second step."""

    def restarted(record: Envelope | Step) -> Envelope | Step:
        if isinstance(record, Step) and record.stage == "gatherer" and record.number >= 2:
            return msgspec.structs.replace(record, incarnation=1, number=record.number - 2)
        return record

    killed = Lost("gatherer", 0, 0, "killed", 0)
    code, said = verify(record_toys(tmp_path, keep=restarted, more=[killed])[0])
    assert code == 0, said
    assert "gatherer: 2 steps, 2 messages" in said
    assert "gatherer after restart 1: 3 steps, 3 messages" in said


@pytest.mark.parametrize(
    ("recorded", "diverged"),
    [
        ("ValueError: limit 1 (odd.py:7 in on_number)", 0),
        ("ValueError: limit 1", 0),
        ("ValueError: limit 12 (odd.py:7 in on_number)", 1),
        ("", 1),
    ],
)
def test_an_error_is_the_same_where_all_of_it_is(toys: Path, recorded: str, diverged: int):
    recording = Recording(toys)
    comparison = Comparison(recording, change(recording).nodes["gatherer"], {})
    step = Step("gatherer", 0, 0, 0, "on_answers", (), (), 0, 0, 0, 0, "failed", recorded)
    comparison.add(Execution(step, error="ValueError: limit 1"))
    assert comparison.result.diverged == diverged


def test_who_interrupts_a_handler_at_the_terminal_ends_the_replay(
    toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def interrupted(*_: object, **more: object) -> None:
        raise KeyboardInterrupt

    recording = Recording(toys)
    step = next(step for step in recording.steps if step.stage == "gatherer")
    again = Reexecution(recording, change(recording).nodes["gatherer"], [step], seed=0, directory=tmp_path)
    monkeypatch.setattr(Gatherer, "on_answers", interrupted)
    with pytest.raises(KeyboardInterrupt):
        again.execute(step)


@pytest.mark.parametrize(("journalled", "said_so"), [(4, "44 of 45 messages of 3"), (0, "40 of 45 messages of 3")])
def test_what_no_step_has_emitted_is_said_not_to_be_compared(tmp_path: Path, journalled: int, said_so: str):
    """As if the gatherer had been killed after it had sent a total and before its step was journalled."""

    def before(record: Envelope | Step) -> Envelope | Step | None:
        late = isinstance(record, Step) and record.stage == "gatherer" and record.number >= journalled
        return None if late else record

    path, verdict = record_toys(tmp_path, keep=before, more=[Lost("gatherer", 0, 0, "killed", 0)])
    assert verdict.complete, verdict
    code, said = verify(path)
    assert code == 0, said
    assert f"IDENTICAL: {said_so} stages; of no step that was done: gatherer.total#{journalled}" in said


def test_where_nothing_is_compared_nothing_is_verified(tmp_path: Path):
    file = tmp_path / "alone.yaml"
    file.write_text("name: alone\nstages: {counter: {stage: tests.runner.common.toys:Counter}}")
    graph = load_graph(file)
    path, _ = record(graph, tmp_path / "alone.mcap", ToyRun(graph, tmp_path).records())
    code, said = verify(path)
    assert code == 1
    assert "NOT VERIFIED: 0 of 0 messages compared, none differs; COMPLETE" in said


def test_a_setting_that_does_not_exist_is_refused(toys: Path):
    code, said = verify(toys, "worker.wrong=0")
    assert code == 2
    assert "worker.config.wrong: unknown key 'wrong'" in said


def test_a_stage_that_dies_is_one_clear_line(toys: Path, tmp_path: Path):
    code, said = verify(toys, "worker.die_at=2")
    assert code == 1
    assert "worker (1 of 2): could not be executed: its process killed by SIGKILL" in said
    assert "NOT VERIFIED" in said


def test_without_verify_only_says_what_would_be_executed(toys: Path):
    code, said = replay(toys)
    assert code == 0
    assert "device: its messages are taken from the recording" in said
    assert "executed again" in said
    assert "IDENTICAL" not in said


def with_metadata(toys: Path, target: Path, **aspects: str) -> Path:
    """A copy whose origin says something else."""
    return rewrite(toys, target, lambda _, data: data, aspects)


def test_names_what_has_changed_since(toys: Path, tmp_path: Path):
    packages = {**json.loads(Recording(toys).run["packages"]), "mcap": "0.0.1"}
    code, said = verify(with_metadata(toys, tmp_path / "copy.mcap", packages=json.dumps(packages), revision="0ld"))
    assert code == 0
    assert said.startswith("changed since the recording: mcap 0.0.1 -> ")
    assert "source 0ld -> " in said


def elsewhere(toys: Path, target: Path, by: float) -> Path:
    """As if recorded on another processor, where one float came out differently."""
    machine = {**json.loads(Recording(toys).run["machine"]), "processor": "Z80"}
    samples = Recording(toys).envelope("worker.answer#0")

    def nudge(topic: str, data: bytes) -> bytes:
        sealed = unpack(Envelope, data) if topic == "worker/answer" else None
        if sealed is None or sealed.id != samples.id:
            return data
        answer = decode(Answer, sealed.body)
        moved = msgspec.structs.replace(answer, samples=answer.samples + by)
        return pack(msgspec.structs.replace(sealed, body=envelope(moved, **HEADER).body))

    return rewrite(toys, target, nudge, {"machine": json.dumps(machine)})


def test_on_another_machine_it_says_so_first_and_tolerances_apply(toys: Path, tmp_path: Path):
    code, said = verify(elsewhere(toys, tmp_path / "near.mcap", 1e-7), TABLE)
    assert code == 0, said
    assert said.startswith("FINGERPRINT DIFFERS: processor Z80 -> ")
    assert "WITHIN TOLERANCES: 2 of 45 messages of 3 stages differ, none by more than " in said
    assert "IDENTICAL" not in said


def test_beyond_its_tolerance_a_message_diverges_on_another_machine_too(toys: Path, tmp_path: Path):
    code, said = verify(elsewhere(toys, tmp_path / "far.mcap", 1e-3), TABLE)
    assert code == 1
    assert "DIVERGED first at stage worker[0], step 0, message worker.answer#0: samples[0]" in said


def test_a_graph_without_tolerances_has_none(toys: Path, tmp_path: Path):
    code, said = verify(elsewhere(toys, tmp_path / "near.mcap", 1e-7))
    assert code == 1
    assert said.startswith("FINGERPRINT DIFFERS")
    assert "DIVERGED first" in said


def test_what_is_equal_is_identical_on_another_machine(toys: Path, tmp_path: Path):
    code, said = verify(elsewhere(toys, tmp_path / "equal.mcap", 0.0), TABLE)
    assert code == 0
    assert "IDENTICAL: 45 messages" in said


def test_on_the_same_machine_tolerances_never_apply(toys: Path, tmp_path: Path):
    here = Recording(toys).run["machine"]
    nudged = elsewhere(toys, tmp_path / "near.mcap", 1e-7)
    code, said = verify(rewrite(nudged, tmp_path / "here.mcap", lambda _, data: data, {"machine": here}), TABLE)
    assert code == 1
    assert "TOLERANCES" not in said
    assert "DIVERGED first at stage worker[0]" in said


@pytest.mark.parametrize(
    ("table", "error"),
    [
        (
            "tests.runner.common.toys:TOLERANCE",
            "no table 'TOLERANCE' in tests.runner.common.toys; did you mean",
        ),
        ("tests.runner.common.toys:Counter", "no table 'Counter' in tests.runner.common.toys; valid: TOLERANCES"),
    ],
)
def test_a_table_that_is_none_is_refused(toys: Path, tmp_path: Path, table: str, error: str):
    code, said = verify(elsewhere(toys, tmp_path / "near.mcap", 0.0), f"tolerances={table}")
    assert code == 2
    assert error in said


@pytest.mark.parametrize("workers", [1, 3])
def test_any_number_of_workers_gives_the_same_bytes(toys: Path, workers: int):
    code, said = verify(toys, workers=workers)
    assert code == 0, said
    assert "IDENTICAL: 45 messages of 3 stages" in said


@pytest.mark.parametrize(("then", "now"), [(2, 1), (1, 2)])
def test_another_number_of_replicas_gives_the_same_ids(tmp_path: Path, then: int, now: int):
    path, _ = record_toys(tmp_path, f"worker.replicas={then}")
    code, said = verify(path, f"worker.replicas={now}")
    assert code == 0, said
    assert "IDENTICAL: 45 messages of 3 stages" in said
    _, said = replay(path, "--until", "worker.answer#7", "--set", f"worker.replicas={now}")
    assert "executed again: identical to the recording" in said
