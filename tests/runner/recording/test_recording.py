import hashlib
import io
import json
import os
import shutil
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import jsonschema
import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from runner.contract import Refused
from runner.graph.reading import load_graph
from runner.inspect.info import describe
from runner.message.codec import Envelope, LogLine, Step, envelope, open_envelope
from runner.message.ids import MessageId
from runner.recording import writer as writer_module
from runner.recording.container import Container, Growing, is_being_written
from runner.recording.provenance import file_hashes
from runner.recording.recording import Completeness, Recording
from runner.recording.recover import recover
from runner.recording.writer import RecordingWriter
from tests.runner.common.recordings import TOYS, ToyRun, manifest, offsets, put, record, record_toys, rewrite
from tests.runner.common.toys import Number, Total
from tests.runner.common.waiting import wait_until

TOPICS = {"counter/number", "splitter/piece", "worker/answer", "gatherer/total", "sink/finished"}
FEW = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, verdict = record_toys(tmp_path_factory.mktemp("toys"))
    assert verdict == Completeness(True)
    return path


def writer(path: Path, refused: list[str] | None = None) -> RecordingWriter:
    graph = load_graph(TOYS, (f"sink.path={path.with_suffix('.txt')}",))
    return RecordingWriter(manifest(graph, path), (refused if refused is not None else []).append)


def number(sequence: int) -> Envelope:
    own = f"counter.number#{sequence}"
    return envelope(Number(value=sequence), id=own, lineage=own, time_ns=sequence, causes=())


# ------------------------------------------------------------------------------------ content


def in_chunks(path: Path, count: int) -> Path:
    """A recording of so many messages, each in a chunk of its own."""
    recorder = writer(path)
    for sequence in range(count):
        flushed = threading.Event()
        put(recorder, number(sequence))
        recorder.after_flush(flushed.set)
        assert flushed.wait(10)
    recorder.close()
    return path


def test_the_index_at_the_end_names_every_chunk_and_grows_by_bytes_only(tmp_path: Path):
    with in_chunks(tmp_path / "a.mcap", 3).open("rb") as file:
        summary = make_reader(file).get_summary()
        found = [message.sequence for _, _, message in make_reader(file).iter_messages(topics=["counter/number"])]
    assert summary is not None and summary.statistics is not None
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count == 3
    assert found == [0, 1, 2]
    # Which the recording's writer replaces:
    assert {"_Writer__chunk_indices", "_Writer__chunk_builder"} <= set(vars(Writer(io.BytesIO())))


def test_holds_every_message_and_step(toys: Path):
    recording = Recording(toys)
    assert len(recording.messages) == 51
    assert len(recording.steps) == 40
    assert not recording.torn
    assert not recording.damage
    assert recording.verdict == Completeness(True)
    assert recording.graph["stages"]["worker"]["replicas"] == 2
    assert recording.metadata["verdict"]["verdict"] == "COMPLETE"


def test_reads_messages_by_id_across_chunks(tmp_path: Path):
    path = tmp_path / "numbers.mcap"
    recorder = writer(path)
    for sequence in range(12):
        put(recorder, number(sequence))
        time.sleep(0.06)
    recorder.close()
    recording = Recording(path)
    assert len({message.offset for message in recording.messages.values()}) > 1
    for sequence in (11, 0, 5):
        assert open_envelope(Number, recording.envelope(f"counter.number#{sequence}")).value == sequence
    with pytest.raises(KeyError):
        recording.envelope("counter.number#99")


def test_any_mcap_reader_reads_it(toys: Path):
    with toys.open("rb") as file:
        found = list(make_reader(file).iter_messages(topics=["worker/answer"]))
    assert len(found) == 20
    schema, channel, message = found[0]
    assert (channel.topic, channel.message_encoding) == ("worker/answer", "msgpack")
    assert schema is not None
    assert (schema.name, schema.encoding) == ("Answer", "jsonschema")
    assert json.loads(schema.data)["title"] == "Answer"
    assert message.sequence == 0


def test_another_reader_validates_every_payload_against_its_schema(toys: Path):
    """msgpack and JSON Schema are all that is needed; binary data is compared as text."""
    validated: Counter[str] = Counter()
    with toys.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages():
            assert schema is not None
            described = json.loads(schema.data)
            jsonschema.Draft202012Validator.check_schema(described)
            value = msgpack.unpackb(message.data)
            text = json.loads(json.dumps(value, default=lambda data: data.decode("latin-1")))
            jsonschema.validate(text, described)
            broken = {**text, "time_ns": "never"}
            assert not jsonschema.Draft202012Validator(described).is_valid(broken)
            validated[schema.name] += 1
    assert validated == {"Number": 5, "Piece": 20, "Answer": 20, "Total": 5, "Finished": 1, "Step": 48}


def test_says_what_ran_where(toys: Path):
    run = Recording(toys).run
    assert run["seed"] == "7"
    assert json.loads(run["settings"])[0].startswith("sink.path=")
    assert json.loads(run["packages"])["numpy"] == np.__version__
    assert json.loads(run["machine"])["python"]
    assert run["fingerprint"] == Recording(toys).fingerprint
    text = describe(toys)
    assert f"runner    {run['runner']}" in text
    assert f"fingerprint {run['fingerprint']}: numpy {np.__version__} of" in text
    assert f"numpy {np.__version__}" in text


def test_hashes_all_that_a_setting_names(tmp_path: Path):
    catalogue, mesh = tmp_path / "catalogue.yaml", tmp_path / "cup.ply"
    catalogue.write_text("objects: {cup: {mesh: {file: cup.ply}}}\n")
    settings = {"catalogue": str(catalogue), "mesh": str(mesh), "folder": str(tmp_path), "name": "cup"}
    graph = {"stages": {"camera": {"config": settings}}}
    found: list[dict[str, str]] = []
    for content in ("a mesh", "another"):
        mesh.write_text(content)
        found.append(file_hashes(graph))
    assert found[1].keys() == {str(catalogue), str(mesh), str(tmp_path)}
    assert all(found[0][key] != found[1][key] for key in found[1])
    assert found[1][str(mesh)] == hashlib.sha256(b"another").hexdigest()


def test_refuses_to_overwrite(toys: Path):
    with pytest.raises(Refused, match="cannot be created: File exists"):
        writer(toys)


# ------------------------------------------------------------------------------------ verdict


@pytest.mark.parametrize("lost", ["counter.number#2", "worker.answer#7", "gatherer.total#4", "sink.finished#0"])
def test_a_lost_message_makes_it_incomplete(tmp_path: Path, lost: str):
    path, verdict = record_toys(tmp_path, keep=lambda record: None if getattr(record, "id", "") == lost else record)
    assert verdict == Completeness(False, (lost,))
    assert Recording(path).verdict == verdict
    assert f"INCOMPLETE: 1 missing: {lost}" in describe(path)


def test_a_message_that_came_twice_is_counted_once(tmp_path: Path):
    path = tmp_path / "twice.mcap"
    graph = load_graph(TOYS, (f"sink.path={tmp_path / 'out.txt'}",))
    records = list(ToyRun(graph, tmp_path).records())
    assert record(graph, path, [records[0], *records])[1].complete
    recording = Recording(path)
    assert recording.verdict.complete
    assert len(recording.messages) == 51
    assert recording.repeated == {"counter.number#0"}


def test_two_messages_of_one_id_make_it_incomplete(tmp_path: Path):
    graph = load_graph(TOYS, (f"sink.path={tmp_path / 'out.txt'}",))
    records = list(ToyRun(graph, tmp_path).records())
    other = envelope(Number(value=9), id="counter.number#0", lineage="counter.number#0", time_ns=1, causes=())
    path, verdict = record(graph, tmp_path / "two.mcap", [other, *records])
    assert str(verdict) == "INCOMPLETE: two messages have the id counter.number#0"
    assert Recording(path).verdict == verdict


def test_a_full_disk_ends_the_recording_and_not_the_process(tmp_path: Path):
    refused: list[str] = []
    recorder = writer(tmp_path / "full.mcap", refused)
    recorder._writer = _FullDisk()  # pyright: ignore
    put(recorder, number(0))
    verdict = recorder.close()
    put(recorder, number(1))
    assert not verdict.complete
    assert "No space left on device" in verdict.reason
    assert "No space left on device" in refused[0]


def test_a_disk_that_stalls_holds_nobody_up_and_what_does_not_fit_in_memory_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    create, disk = writer_module._create, threading.Event()
    monkeypatch.setattr(writer_module, "_create", lambda path: _StalledDisk(create(path), disk))
    monkeypatch.setattr(writer_module, "BACKLOG_BYTES", 5000)
    path = tmp_path / "stalled.mcap"
    disk.set()
    recorder = writer(path)
    disk.clear()
    for sequence in range(200):
        put(recorder, number(sequence))
    disk.set()
    verdict = recorder.close()
    recording = Recording(path)
    assert not verdict.complete
    assert "payloads dropped: the disk was too slow" in verdict.reason
    assert set(verdict.missing) == {f"counter.number#{sequence}" for sequence in range(200)} - set(recording.messages)
    assert json.loads(recording.metadata["verdict"]["missing"]) == list(verdict.missing)
    assert f"missing {verdict.missing[-1]}" in describe(path)


class _StalledDisk:
    """A file whose writes wait for the disk."""

    def __init__(self, file: IO[bytes], disk: threading.Event) -> None:
        self._file, self._disk = file, disk

    def write(self, data: bytes) -> int:
        self._disk.wait()
        return self._file.write(data)

    def __getattr__(self, name: str):
        return getattr(self._file, name)


class _FullDisk:
    def __getattr__(self, name: str):
        raise OSError(28, "No space left on device")


# ------------------------------------------------------------------------------------ whatever ends the writer


class Failing:
    """What it stands for, until one of its methods is called for the n-th time."""

    def __init__(self, real: Any, method: str, error: BaseException, at: int = 3) -> None:
        self._real, self._method, self._error, self._left = real, method, error, at

    def __getattr__(self, name: str) -> Any:
        return self._call if name == self._method else getattr(self._real, name)

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)

    def _call(self, *arguments: Any) -> Any:
        self._left -= 1
        if self._left == 0:
            raise self._error
        return (getattr(self._real, self._method) if self._method else self._real)(*arguments)


def fail_to_add(recorder: RecordingWriter, error: BaseException) -> None:
    recorder._writer = Failing(recorder._writer, "add_message", error)  # pyright: ignore


def fail_to_flush(recorder: RecordingWriter, error: BaseException) -> None:
    recorder._writer = Failing(recorder._writer, "flush", error, at=1)  # pyright: ignore


def fail_to_read_back(recorder: RecordingWriter, error: BaseException) -> None:
    recorder._container = Failing(recorder._container, "entries_at", error, at=1)  # pyright: ignore


def fail_to_prove(recorder: RecordingWriter, error: BaseException) -> None:
    recorder._proof = Failing(recorder._proof, "enter", error)  # pyright: ignore


def fail_to_finish(recorder: RecordingWriter, error: BaseException) -> None:
    recorder._writer = Failing(recorder._writer, "finish", error, at=1)  # pyright: ignore


def fail_in_an_action(recorder: RecordingWriter, error: BaseException) -> None:
    recorder.after_flush(Failing(print, "", error, at=1))


FAILURES = [fail_to_add, fail_to_flush, fail_to_read_back, fail_to_prove, fail_to_finish, fail_in_an_action]


@pytest.mark.parametrize("error", [MemoryError(), ValueError("odd"), OSError("odd"), SystemExit(1)], ids=repr)
@pytest.mark.parametrize("fail", FAILURES, ids=lambda fail: fail.__name__)
def test_whatever_ends_the_writer_is_named_and_so_is_all_that_is_not_there(
    tmp_path: Path, fail: Callable[[RecordingWriter, BaseException], None], error: BaseException
):
    path = tmp_path / "ended.mcap"
    recorder = writer(path)
    fail(recorder, error)
    records = [*map(number, range(6)), LogLine("counter", 0, "info", "hello", 0)]
    for one in records:
        put(recorder, one)
    verdict = recorder.close()
    put(recorder, number(6))
    verdicts = (verdict, recorder.close())
    there = set(Recording(path).messages)
    for found, sent in zip(verdicts, (6, 7), strict=True):
        assert not found.complete
        assert f"writing failed: {type(error).__name__}" in found.reason or f"writing failed: {error}" in found.reason
        assert set(found.missing) >= {f"counter.number#{sequence}" for sequence in range(sent)} - there
        assert found.counts == {"counter/number": sent, "log/counter": 1}
    assert not Recording(path).verdict.complete


@pytest.mark.parametrize("where", ["content", "length"])
def test_what_cannot_be_read_back_as_it_was_written_is_named(tmp_path: Path, where: str):
    """A file system that forgets, or somebody else who writes to the file."""
    path = tmp_path / "spoilt.mcap"
    graph = load_graph(TOYS, (f"sink.path={tmp_path / 'out.txt'}",))
    recorder = RecordingWriter(manifest(graph, path), print)
    recorder._file = SpoilingFile(recorder._file, path, where)  # pyright: ignore
    recorder._writer._Writer__stream = recorder._file  # pyright: ignore
    for one in ToyRun(graph, tmp_path).records():
        put(recorder, one)
    verdict = recorder.close()
    assert not verdict.complete
    assert "read back: byte" in verdict.reason
    assert not Recording(path).verdict.complete


class SpoilingFile:
    """A file of which a part is lost between writing and reading."""

    def __init__(self, file: IO[bytes], path: Path, where: str) -> None:
        self._file, self._path, self._where = file, path, where

    def write(self, data: bytes) -> int:
        if self._where == "content" and len(data) > 1000:
            data = data[:500] + b"spoilt" + data[506:]
        return self._file.write(data)

    def flush(self) -> None:
        self._file.flush()
        if self._where == "length":
            os.truncate(self._path, self._path.stat().st_size - 1000)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def test_a_recording_that_is_moved_while_it_is_written_is_complete(tmp_path: Path):
    path, moved = tmp_path / "a.mcap", tmp_path / "b.mcap"
    graph = load_graph(TOYS, (f"sink.path={tmp_path / 'out.txt'}",))
    recorder = RecordingWriter(manifest(graph, path), print)
    path.rename(moved)
    path.write_bytes(b"of somebody else")
    for one in ToyRun(graph, tmp_path).records():
        put(recorder, one)
    assert recorder.close() == Recording(moved).verdict == Completeness(True)


def test_a_recording_that_is_deleted_while_it_is_written_is_not_complete(tmp_path: Path):
    recorder = writer(tmp_path / "deleted.mcap")
    (tmp_path / "deleted.mcap").unlink()
    put(recorder, number(0))
    verdict = recorder.close()
    assert "writing failed: No such file or directory" in verdict.reason
    assert verdict.missing == ("counter.number#0",)


# ------------------------------------------------------------------------------------ torn, damaged, foreign


def test_a_torn_recording_is_read_up_to_the_tear(toys: Path, tmp_path: Path):
    """Without its last 8 bytes, inside the summary, inside the verdict, and inside the last chunk."""
    content = toys.read_bytes()
    for cut in (len(content) - 4, len(content) - 600, content.index(b"COMPLETE") + 3):
        torn = tmp_path / "torn.mcap"
        torn.write_bytes(content[:cut])
        recording = Recording(torn)
        assert recording.torn
        assert len(recording.messages) == 51
        assert "INCOMPLETE: torn at byte" in describe(torn)


@given(share=st.floats(0, 1))
@FEW
def test_a_cut_anywhere_is_a_report_or_one_clear_line(toys: Path, tmp_path: Path, share: float):
    content = toys.read_bytes()
    torn = tmp_path / "cut.mcap"
    torn.write_bytes(content[: int(share * (len(content) - 1))])
    try:
        assert "INCOMPLETE: torn at byte" in describe(torn)
    except Refused as refused:
        assert str(refused).startswith(str(torn))
        assert "\n" not in str(refused)


def test_a_file_that_goes_on_after_its_end_is_not_complete(toys: Path, tmp_path: Path):
    content, path = toys.read_bytes(), tmp_path / "long.mcap"
    for more in (b"\n", content):
        path.write_bytes(content + more)
        verdict = Recording(path).verdict
        assert str(verdict) == f"INCOMPLETE: damaged at byte {len(content)}: the file goes on after its end"


@pytest.mark.parametrize("recovered", [False, True])
def test_where_messages_lie_is_under_a_checksum_too(toys: Path, tmp_path: Path, recovered: bool):
    path, damaged = recover(toys, tmp_path / "a.mcap")[1] if recovered else toys, tmp_path / "b.mcap"
    assert Recording(path).verdict.complete
    content = bytearray(path.read_bytes())
    (end,) = offsets(content, Opcode.DATA_END)
    content[offsets(content, Opcode.MESSAGE_INDEX)[1] - 1] ^= 1
    damaged.write_bytes(content)
    assert Recording(damaged).damage == [f"byte {end}: the checksum of the data section does not match its content"]


@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@FEW
def test_a_flipped_bit_anywhere_is_found_or_one_clear_line(toys: Path, tmp_path: Path, share: float, bit: int):
    content = bytearray(toys.read_bytes())
    content[int(share * len(content))] ^= 1 << bit
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    try:
        assert f"{damaged}: INCOMPLETE" in describe(damaged)
        for sealed in Recording(damaged).envelopes():
            assert sealed.id
    except Refused as refused:
        assert "\n" not in str(refused)


@pytest.mark.parametrize("damage", [b'["counter.number!1"]', b"[1234567890123456789]"])
def test_damage_among_the_missing_of_the_verdict_hides_nothing(tmp_path: Path, damage: bytes):
    path = tmp_path / "gap.mcap"
    recorder = writer(path)
    for sequence in (0, 2):
        put(recorder, number(sequence))
    recorder.close()
    content = path.read_bytes()
    path.write_bytes(content.replace(b'["counter.number#1"]', damage.ljust(20)))
    assert path.read_bytes() != content
    assert Recording(path).verdict.missing == ("counter.number#1",)


def test_a_damaged_chunk_is_named_and_the_rest_is_read(tmp_path: Path):
    path = tmp_path / "damaged.mcap"
    recorder = writer(path)
    for sequence in range(10):
        put(recorder, number(sequence))
        time.sleep(0.06)
    recorder.close()
    content = bytearray(path.read_bytes())
    content[content.index(b"\x03\x00\x00\x00lz4") + 60] ^= 0xFF
    path.write_bytes(content)
    recording = Recording(path)
    assert "chunk" in str(recording.damage[0])
    assert "counter.number#0" not in recording.messages
    assert "counter.number#9" in recording.messages
    assert not recording.verdict.complete


def test_a_summary_that_is_not_what_was_written_is_damage_and_no_word_of_it_holds(toys: Path, tmp_path: Path):
    content, damaged = toys.read_bytes(), tmp_path / "damaged.mcap"
    summary, offsets = struct.unpack_from("<QQ", content, len(content) - 28)
    for at in (*range(summary + 9, offsets, 211), content.index(b"worker/answer", summary)):
        damaged.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        recording = Recording(damaged)
        assert not recording.verdict.complete, at
        assert {message.topic for message in recording.messages.values()} == TOPICS
    assert recording.damage == [f"byte {len(content) - 37}: the checksum of the summary does not match its content"]
    _, target = recover(damaged, tmp_path / "clean.mcap")
    assert {message.topic for message in Recording(target).messages.values()} == TOPICS
    assert str(Recording(target).verdict) == str(recording.verdict)


def test_a_summary_without_a_checksum_is_damage(toys: Path, tmp_path: Path):
    content = toys.read_bytes()
    (tmp_path / "damaged.mcap").write_bytes(content[:-20] + bytes(12) + content[-8:])
    assert "the checksum of the summary" in str(Recording(tmp_path / "damaged.mcap").verdict)


def test_damage_to_a_chunk_of_a_recovered_file_is_a_report(toys: Path, tmp_path: Path):
    _, path = recover(toys, tmp_path / "clean.mcap")
    content = path.read_bytes()
    begin = offsets(content, Opcode.CHUNK)[0]
    for at in range(begin, begin + 3000, 50):
        path.write_bytes(content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :])
        assert "INCOMPLETE: damaged at byte " in describe(path)


def test_a_topic_that_a_damaged_chunk_names_is_taken_from_elsewhere(toys: Path, tmp_path: Path):
    path = rewrite(toys, tmp_path / "damaged.mcap", lambda _, data: data, compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
    content[content.index(b"worker/answer")] ^= 1
    for cut, topics in ((None, TOPICS), (content.index(b"COMPLETE"), TOPICS - {"worker/answer"} | {"vorker/answer"})):
        path.write_bytes(content[:cut])
        recording = Recording(path)
        assert "the chunk's checksum does not match" in recording.damage[0]
        assert len(recording.messages) == 51
        assert {message.topic for message in recording.messages.values()} == topics


@pytest.mark.parametrize("opcode", [Opcode.CHUNK, Opcode.MESSAGE_INDEX])
@pytest.mark.parametrize("which", [0, 2, 5])
def test_damage_to_a_frame_costs_no_more_than_its_chunk(tmp_path: Path, opcode: Opcode, which: int):
    content = in_chunks(tmp_path / "whole.mcap", 6).read_bytes()
    path, at = tmp_path / "damaged.mcap", offsets(content, opcode)[which]
    lengths = [(at + 1 + bit // 8, bytes([content[at + 1 + bit // 8] ^ 1 << bit % 8])) for bit in range(0, 64, 5)]
    for begin, damage in (*lengths, (at - (20 if which else 0), bytes(30)), (at, b"\0")):
        path.write_bytes(content[:begin] + damage + content[begin + len(damage) :])
        recording = Recording(path)
        assert not recording.verdict.complete
        assert not recording.torn
        assert {0, 1, 2, 3, 4, 5} - {which} <= {sealed.sequence for sealed in map(MessageId.of, recording.messages)}
        assert [sealed.id for sealed in recording.envelopes()] == list(recording.messages)
        assert {"run", "verdict"} == set(recording.metadata)


def test_damage_to_a_frame_costs_what_follows_where_nothing_says_how_it_goes_on(tmp_path: Path):
    content = bytearray(in_chunks(tmp_path / "whole.mcap", 3).read_bytes())
    content[offsets(content, Opcode.CHUNK)[1] + 3] ^= 1
    content[-12] ^= 1  # of the checksum of the summary
    (tmp_path / "damaged.mcap").write_bytes(content)
    recording = Recording(tmp_path / "damaged.mcap")
    assert recording.torn
    assert list(recording.messages) == ["counter.number#0"]


def test_damage_to_the_verdict_hides_nothing_else(toys: Path, tmp_path: Path):
    content = bytearray(toys.read_bytes())
    content[offsets(content, Opcode.METADATA)[1] + 4] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(content)
    recording = Recording(tmp_path / "damaged.mcap")
    assert not recording.torn
    assert len(recording.messages) == 51


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"", "empty or cut off"), (b"\x89MC", "empty or cut off"), (b"name: toys\nseed: 7\n", "not an MCAP file")],
)
def test_refuses_what_is_no_mcap(tmp_path: Path, content: bytes, reason: str):
    path = tmp_path / "foreign.mcap"
    path.write_bytes(content)
    with pytest.raises(Refused, match=reason):
        Recording(path)


def test_refuses_a_foreign_mcap_a_missing_file_and_a_folder(toys: Path, tmp_path: Path):
    foreign = io.BytesIO()
    other = Writer(foreign)
    other.start("ros2")
    other.finish()
    path = tmp_path / "foreign.mcap"
    path.write_bytes(foreign.getvalue())
    with pytest.raises(Refused, match="no 'run' metadata"):
        Recording(path)
    with pytest.raises(Refused, match=r"no such file; recordings in .*: toys\.mcap"):
        Recording(toys.with_name("nothing.mcap"))
    with pytest.raises(Refused, match="is a directory"):
        Recording(tmp_path)


def test_refuses_what_is_no_regular_file(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.mcap")
    reading, writing = os.pipe()
    for path in (tmp_path / "pipe.mcap", Path(f"/dev/fd/{reading}"), Path("/dev/null")):
        with pytest.raises(Refused, match=f"{path}: is no regular file: a recording is read more than once"):
            Recording(path)
    os.close(reading)
    os.close(writing)


# ------------------------------------------------------------------------------------ while it grows


def test_a_killed_recorder_loses_no_more_than_the_last_moments(tmp_path: Path):
    path, copy = tmp_path / "growing.mcap", tmp_path / "killed.mcap"
    recorder = writer(path)
    put(recorder, number(0))
    wait_until(lambda: "counter.number#0" in Recording(path).messages)
    put(recorder, number(1))
    shutil.copy(path, copy)
    recorder.close()
    recording = Recording(copy)
    assert list(recording.messages)[:1] == ["counter.number#0"]
    assert recording.torn


def test_a_recording_that_grows_is_called_that_and_not_torn(tmp_path: Path):
    path = tmp_path / "growing.mcap"
    recorder, flushed = writer(path), threading.Event()
    put(recorder, number(0))
    recorder.after_flush(flushed.set)
    assert flushed.wait(10)
    text = describe(path)
    assert text.startswith(f"{path}: INCOMPLETE: is still being written\n")
    assert "counter/number" in text
    assert "damage" not in text
    recorder.close()
    assert "still being written" not in describe(path)


def test_follows_a_recording_until_its_writer_lets_go(tmp_path: Path):
    path = tmp_path / "growing.mcap"
    recorder = writer(path)
    put(recorder, number(0))
    with path.open("rb") as file:
        assert is_being_written(file)
        entries = (record for record in Container(Growing(file), str(path)) if hasattr(record, "topic"))
        assert next(entries).topic == "counter/number"
        put(recorder, LogLine("counter", 0, "info", "hello", 0))
        put(recorder, Step("counter", 0, 0, 0, "source", (), ("counter.number#0",), 0, 0, 0, 0))
        assert next(entries).topic == "log/counter"
        recorder.close()
        assert [entry.topic for entry in entries] == ["journal/counter"]
        assert not is_being_written(file)


def test_info_counts_rates_and_times(toys: Path):
    text = describe(toys)
    assert f"{toys}: COMPLETE" in text
    assert "graph     toys (seed 7, --set sink.path=" in text
    row = next(line for line in text.splitlines() if line.startswith("worker/answer"))
    assert row.split()[1:3] == ["Answer", "20"]
    assert open_envelope(Total, Recording(toys).envelope("gatherer.total#4")).last
