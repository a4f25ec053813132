import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from runner.codec import Envelope, Step, pack, unpack
from runner.contract import Refused
from runner.recording import Recording
from runner.replay import replay
from tests.runner.recordings import record_toys, rewrite


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_toys(tmp_path_factory.mktemp("toys"))[0]


def verify(path: Path, *assignments: str) -> tuple[int, str]:
    lines: list[str] = []
    code = replay(path, verify=True, assignments=assignments, say=lines.append)
    return code, "\n".join(lines)


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
    assert "IDENTICAL: 45 messages of 4 stages" in said
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

    code, said = verify(record_toys(tmp_path, keep=restarted)[0])
    assert code == 0, said
    assert "gatherer: 2 steps, 2 messages" in said
    assert "gatherer after restart 1: 3 steps, 3 messages" in said


def test_a_stage_that_cannot_be_constructed_is_one_clear_line(toys: Path):
    code, said = verify(toys, "worker.seconds=0")
    assert code == 0, said
    with pytest.raises(Refused, match="wrong"):
        verify(toys, "worker.wrong=0")


def test_without_verify_only_says_what_would_be_executed(toys: Path):
    lines: list[str] = []
    assert replay(toys, verify=False, say=lines.append) == 0
    said = "\n".join(lines)
    assert "device: its messages are taken from the recording" in said
    assert "executed again" in said
    assert "IDENTICAL" not in said


def test_names_what_has_changed_since(toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    packages = json.loads(Recording(toys).run["packages"])
    monkeypatch.setattr("runner.replay.package_versions", lambda: {**packages, "numpy": "9.9"})
    _, said = verify(toys)
    assert f"changed since the recording: numpy {packages['numpy']} -> 9.9" in said
