import os
import resource
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from runner.contract import EXIT_REFUSED, Message, Spec
from runner.message.codec import Envelope, Journal, LogLine, Step, encode, envelope, pack, unpack
from runner.message.packet import RECORDER, Packet, Process
from runner.process.children import reason_in, spawn
from runner.process.recorder import EXIT_INCOMPLETE
from runner.recording.recording import Recording
from runner.recording.writer import Manifest, topic
from runner.transport.bus import Bus
from runner.transport.presence import Presence
from runner.transport.session import new_endpoint
from tests.runner.common.waiting import wait_until

HEIGHT, WIDTH = 480, 640


class Picture(Message, frozen=True, kw_only=True):
    rgb: Annotated[NDArray[np.uint8], Spec("uint8", ("H", "W", 3))]
    depth: Annotated[NDArray[np.float32], Spec("float32", ("H", "W"))]


class Session:
    """A recorder process and a bus that speaks to it."""

    def __init__(self, folder: Path, *program: str, log: Path | None = None) -> None:
        self.path = folder / "pictures.mcap"
        self.log = log or folder / "log.txt"
        endpoint = new_endpoint()
        self.bus = Bus("test", endpoint, process=Process("camera", 0), listen=True)
        self._recorded: list[tuple[str, str]] = []
        self.bus.subscribe("j/*", self._on_journal)
        graph = '{"name": "pictures", "seed": 0, "view": null, "stages": {"camera": {"replicas": 1}}}'
        task = Manifest("test", endpoint, str(self.path), graph, (), {"camera/picture": topic(Picture)})
        self.process = spawn(*program or ("runner.process.recorder",), task=msgspec.json.encode(task), log=self.log)
        self._presence = Presence()
        self._steps = 0
        self.bus.watch(self._presence.update)

    def wait(self) -> None:
        assert self._presence.wait_for([(RECORDER, 0)], lambda: self.process.poll() is not None)

    def send(self, number: int, picture: Picture) -> str:
        own = f"camera.picture#{number}"
        sealed = envelope(picture, id=own, lineage=own, time_ns=number, causes=())
        self.bus.publish("m/camera/picture", pack(sealed))
        return own

    def journal(self, *emitted: str) -> None:
        self._tell(Step("camera", 0, 0, self._steps, "source", (), emitted, 0, 0, 0, 0))
        self._steps += 1

    def _tell(self, step: Step) -> None:
        self.bus.publish(f"s/{step.stage}", pack(step))

    def _on_journal(self, packet: Packet) -> None:
        self._recorded += [(step.stage, step.outcome) for step in unpack(Journal, packet.payload).steps]

    def stop(self) -> int:
        for stage, steps in (("camera", self._steps), ("supervisor", 0)):
            self._tell(Step(stage, 0, 0, steps, "", (), (), 0, 0, 0, 0, "ended"))
        wait_until(lambda: ("supervisor", "ended") in self._recorded)
        self.process.terminate()
        code = self.process.wait(60)
        self.bus.close()
        return code


@pytest.fixture
def pictures() -> list[Picture]:
    rng = np.random.default_rng(0)
    size = (HEIGHT, WIDTH)
    return [
        Picture(rgb=rng.integers(0, 256, (*size, 3), np.uint8), depth=rng.normal(1, 0.2, size).astype(np.float32))
        for _ in range(3)
    ]


def test_records_a_30_hz_stream_of_rgbd_without_loss(tmp_path: Path, pictures: list[Picture]):
    session = Session(tmp_path)
    session.wait()
    for number in range(60):
        session.journal(session.send(number, pictures[number % 3]))
        time.sleep(1 / 30)
    assert session.stop() == 0
    recording = Recording(session.path)
    assert len(recording.messages) == len(recording.steps) == 60
    assert recording.verdict.complete
    assert reason_in(session.log) == f"{session.path}: COMPLETE"
    assert bytes(recording.envelope("camera.picture#59").body) == encode(pictures[2])


def test_a_recorder_that_stands_still_for_a_moment_loses_nothing(tmp_path: Path, pictures: list[Picture]):
    session = Session(tmp_path)
    session.wait()
    os.kill(session.process.pid, signal.SIGSTOP)
    threading.Timer(0.5, os.kill, (session.process.pid, signal.SIGCONT)).start()
    for number in range(30):
        session.journal(session.send(number, pictures[number % 3]))
    assert session.stop() == 0
    assert len(Recording(session.path).messages) == 30


def test_a_lost_message_is_in_the_verdict_and_the_exit_status(tmp_path: Path, pictures: list[Picture]):
    session = Session(tmp_path)
    session.wait()
    session.send(0, pictures[0])
    session.journal("camera.picture#0", "camera.picture#1")
    assert session.stop() == EXIT_INCOMPLETE
    assert "INCOMPLETE: 1 missing: camera.picture#1" in reason_in(session.log)


def test_a_full_disk_stops_nobody_and_what_is_missing_is_named(tmp_path: Path, pictures: list[Picture]):
    """The kernel refuses to let the file grow beyond a limit, as a full disk does."""
    session = Session(tmp_path)
    session.wait()
    resource.prlimit(session.process.pid, resource.RLIMIT_FSIZE, (5_000_000, 5_000_000))
    sent = [session.send(number, pictures[number % 3]) for number in range(12)]
    for id in sent:
        session.journal(id)
    assert session.stop() == EXIT_INCOMPLETE
    said = reason_in(session.log)
    assert "INCOMPLETE: writing failed: File too large" in said
    recording = Recording(session.path)
    there = set(recording.messages)
    assert there < set(sent)
    assert f"{12 - len(there)} missing: {sorted(set(sent) - there, key=sent.index)[0]}" in said
    assert recording.torn


def test_a_corrupt_message_is_refused_in_one_line_and_the_recorder_lives_on(tmp_path: Path, pictures: list[Picture]):
    session = Session(tmp_path)
    session.wait()
    session.bus.publish("m/camera/picture", b"\xff\x00 nonsense")
    session.bus.publish("s/camera", b"")
    session.journal(session.send(0, pictures[0]))
    session.bus.publish("l/camera", pack(LogLine("camera", 0, "info", "done", 0)))
    time.sleep(1)
    assert session.stop() == 0
    recording = Recording(session.path)
    complaints = [line.text for line in recording.log if line.stage == RECORDER]
    assert len(complaints) == 2
    assert all("message refused" in text and "\n" not in text for text in complaints)
    assert {type(record).__name__ for record in recording.envelopes()} == {Envelope.__name__}


def test_sigint_is_left_to_the_supervisor(tmp_path: Path):
    session = Session(tmp_path)
    session.wait()
    session.process.send_signal(signal.SIGINT)
    with pytest.raises(subprocess.TimeoutExpired):
        session.process.wait(0.5)
    assert session.stop() == 0
    assert Recording(session.path).verdict.complete


def test_a_recording_that_cannot_be_created_is_refused(tmp_path: Path):
    (tmp_path / "pictures.mcap").touch()
    session = Session(tmp_path)
    assert session.process.wait(60) == EXIT_REFUSED
    assert "cannot be created: File exists" in reason_in(session.log)
    session.bus.close()


def test_a_recording_that_cannot_be_begun_is_refused(tmp_path: Path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))  # which the recorder inherits; as a full disk
    try:
        session = Session(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert session.process.wait(60) == EXIT_REFUSED
    assert reason_in(session.log) == f"recording {session.path}: cannot be written: File too large"
    session.bus.close()


@pytest.mark.parametrize("where", ["taker", "speaker"])
def test_a_recorder_that_fails_ends_and_the_recording_says_why(tmp_path: Path, where: str, pictures: list[Picture]):
    session = Session(tmp_path, "tests.runner.process.fails", where)
    session.wait()
    session.journal(session.send(0, pictures[0]))
    assert session.process.wait(60) == EXIT_INCOMPLETE
    session.bus.close()
    reason = "the recorder failed: MemoryError: no room for a step"
    assert reason_in(session.log).startswith(f"{session.path}: INCOMPLETE: {reason}; ")
    assert "Traceback" in session.log.read_text()
    assert reason in str(Recording(session.path).verdict)


def test_a_recorder_ends_as_it_must_also_where_the_disk_under_its_log_is_full(tmp_path: Path, pictures: list[Picture]):
    session = Session(tmp_path, "tests.runner.process.fails", "taker", log=Path("/dev/full"))
    session.wait()
    session.journal(session.send(0, pictures[0]))
    assert session.process.wait(60) == EXIT_INCOMPLETE
    session.bus.close()
    assert "the recorder failed: MemoryError" in str(Recording(session.path).verdict)
    refused = Session(tmp_path, log=Path("/dev/full"))
    assert refused.process.wait(60) == EXIT_REFUSED
    refused.bus.close()
