"""What a killed run leaves: every command reads it, and `runner recover` writes it as a clean recording."""

import os
import random
import resource
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from mcap.reader import make_reader

from runner.cli.main import main
from runner.contract import Refused
from runner.message.codec import Step, envelope, pack
from runner.recording.container import is_being_written, new_file
from runner.recording.recording import Recording
from runner.recording.recover import recover
from runner.supervise.supervisor import EXIT_INCOMPLETE
from tests.runner.common.recordings import record_toys, rewrite
from tests.runner.common.runs import DOUBLES, processes_of, start
from tests.runner.common.toys import Number
from tests.runner.common.waiting import wait_until
from tests.runner.process.test_recorder import Session

LOST_NS = 500_000_000
"""A kill costs no more than this."""
ATTEMPTS = 3
"""A machine that is busy elsewhere may give the recorder no time before it is killed: then the kill is tried again."""
OLD = Path(__file__).parents[1] / "weather-1.mcap"


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_toys(tmp_path_factory.mktemp("toys"), "view=tests.runner.common.toy_views:ToyViews")[0]


def torn(toys: Path, folder: Path, share: float = 0.7) -> Path:
    """A toy recording in many chunks, cut off."""
    path = folder / "torn.mcap"
    content = toys.read_bytes()
    path.write_bytes(content[: content.index(b"COMPLETE") if share == 1 else int(share * len(content))])
    return path


def payloads(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    with path.open("rb") as file:
        messages = make_reader(file).iter_messages(log_time_order=False)
        return [(c.topic, m.log_time, m.publish_time, m.sequence, m.data) for _, c, m in messages]


def test_a_whole_recording_is_copied_with_everything_in_it(toys: Path, tmp_path: Path):
    _, target = recover(toys, tmp_path / "copy.mcap")
    before, after = Recording(toys), Recording(target)
    assert payloads(target) == payloads(toys)
    assert after.metadata == before.metadata
    assert after.verdict.complete
    with toys.open("rb") as one, target.open("rb") as other:
        schemas = [
            {item.name: item.data for item in summary.schemas.values()}
            for summary in (make_reader(one).get_summary(), make_reader(other).get_summary())
            if summary is not None
        ]
    assert schemas[0] == schemas[1]


def test_a_torn_recording_becomes_a_clean_one_that_says_so(toys: Path, tmp_path: Path):
    path = torn(toys, tmp_path, 1)
    assert main(["recover", str(path)]) == 0
    clean = Recording(tmp_path / "torn.recovered.mcap")
    assert not clean.torn
    assert not clean.damage
    assert list(clean.messages) == list(Recording(path).messages)
    assert "INCOMPLETE: torn at byte" in str(clean.verdict)
    with (tmp_path / "torn.recovered.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.chunk_indexes


def test_a_run_that_is_damaged_is_said_so_also_when_it_is_recovered(toys: Path, tmp_path: Path):
    content, damaged = bytearray(toys.read_bytes()), tmp_path / "damaged.mcap"
    content[content.index(b'"numpy": "') + len(b'"numpy": "')] ^= 1
    damaged.write_bytes(content)
    _, target = recover(damaged, tmp_path / "clean.mcap")
    for path in (damaged, target):
        assert str(Recording(path).verdict) == "INCOMPLETE: metadata 'run' is not what was written"


def test_a_recording_whose_verdict_says_nothing_of_the_run_is_complete(tmp_path: Path):
    _, target = recover(OLD, tmp_path / "copy.mcap")
    for path in (OLD, target):
        assert "run" not in Recording(path).metadata["verdict"]
        assert Recording(path).verdict.complete


def test_what_the_journal_names_beyond_the_tear_is_missing(toys: Path, tmp_path: Path):
    def lose(topic: str, data: bytes) -> bytes:
        return b"nonsense" if topic == "gatherer/total" else data

    _, target = recover(rewrite(toys, tmp_path / "damaged.mcap", lose), tmp_path / "clean.mcap")
    clean = Recording(target)
    assert not clean.damage
    assert "gatherer.total#0" in clean.verdict.missing
    assert clean.metadata["verdict"]["verdict"] == "INCOMPLETE"


def test_nothing_is_overwritten_and_nothing_that_still_grows_is_copied(toys: Path, tmp_path: Path):
    (tmp_path / "there.mcap").touch()
    with pytest.raises(Refused, match=r"there\.mcap: cannot be written: File exists"):
        recover(toys, tmp_path / "there.mcap")
    session = Session(tmp_path)
    session.wait()
    with pytest.raises(Refused, match="still being written"):
        recover(session.path)
    session.stop()


def test_a_new_file_may_go_into_a_folder_that_is_not_there_yet(tmp_path: Path):
    path = tmp_path / "foo" / "bar" / "baz"
    with new_file(path) as file:
        file.write(b"qux")
    assert [path.read_bytes(), *path.parent.iterdir()] == [b"qux", path]


def test_files_of_others_beside_the_new_one_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, foreign = tmp_path / "a.mcap", tmp_path / "a.mcap.part"
    foreign.write_bytes(b"foreign")
    with new_file(path) as file:
        file.write(b"one")
    with pytest.raises(Refused, match="File exists"), new_file(path):
        pass
    assert {path.name: b"one", foreign.name: b"foreign"} == {one.name: one.read_bytes() for one in tmp_path.iterdir()}
    path.unlink()
    monkeypatch.setattr(os, "getpid", iter((1, 2)).__next__)  # of two processes at once
    with pytest.raises(Refused, match="File exists"), new_file(path) as slower:
        slower.write(b"slower")
        with new_file(path) as faster:
            faster.write(b"faster")
    assert {path.name: b"faster", foreign.name: b"foreign"} == {
        one.name: one.read_bytes() for one in tmp_path.iterdir()
    }


@pytest.mark.parametrize("share", [0.3, 0.7, 1.0])
def test_every_reading_command_reads_a_torn_recording(toys: Path, tmp_path: Path, share: float):
    path = torn(toys, tmp_path, share)
    drawing = [["view", str(path), "--save", str(tmp_path / "toys.rrd")]]
    drawing += [["export", str(path), "--foxglove", str(tmp_path / "foxglove.mcap")]]
    for command in (*reading(path), *drawing):
        assert main(command) in (0, 1), command


def reading(path: Path) -> list[list[str]]:
    """Every command that reads a recording, on this one."""
    why = [["why", id, str(path)] for id in list(Recording(path).messages)[-1:]]
    return [["info", str(path)], ["replay", str(path)], ["latency", str(path)], ["diff", str(path), str(path)], *why]


# ------------------------------------------------------------------------------------ killed at any moment


def publish_until_killed(session: Session, kill: Callable[[], None], seconds: float) -> int:
    """Sends numbered messages with their wall time, kills after a while, and returns the time of the kill."""
    due, number = time.monotonic() + seconds, 0
    while time.monotonic() < due:
        own, now = f"camera.picture#{number}", time.time_ns()
        sealed = envelope(Number(value=0), id=own, lineage=own, time_ns=now, causes=())
        step = Step("camera", 0, 0, number, "source", (), (own,), now, 0, 0, 0)
        session.bus.publish("m/camera/picture", pack(sealed))
        session.bus.publish("s/camera", pack(step))
        number += 1
        time.sleep(0.002)
    killed = time.time_ns()
    kill()
    return killed


def lost_ns(path: Path, topic: str, killed: int) -> int:
    """Time before the kill of which nothing is left; what is there must be without a gap."""
    recording = Recording(path)
    assert not recording.verdict.complete
    assert ("INCOMPLETE: torn at byte" in str(recording.verdict)) == recording.torn
    found = [recording.envelope(id) for id, message in recording.messages.items() if message.topic == topic]
    assert [sealed.id for sealed in found] == [f"{topic.replace('/', '.')}#{number}" for number in range(len(found))]
    recovered, target = recover(path, path.with_name(f"{killed}.mcap"))
    assert list(Recording(target).messages) == list(recovered.messages)
    return killed - max((sealed.time_ns for sealed in found), default=0)


@pytest.mark.parametrize("moment", range(3))
def test_a_recorder_killed_at_any_moment_loses_half_a_second_at_most(tmp_path: Path, moment: int):
    seconds = random.Random(moment).uniform(0.3, 1.5)
    lost: list[int] = []
    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        session = Session(folder)
        session.wait()
        killed = publish_until_killed(session, session.process.kill, seconds)
        session.process.wait()
        session.bus.close()
        lost.append(lost_ns(session.path, "camera/picture", killed))
        if lost[-1] <= LOST_NS:
            return
    raise AssertionError(f"lost {lost} ns")


def children(process: subprocess.Popen[str]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children()


def recorder_of(process: subprocess.Popen[str]) -> int:
    (recorder,) = (child for child in children(process) if "runner.process.recorder" in " ".join(child.cmdline()))
    return recorder.pid


def test_a_disk_that_is_full_slows_no_graph_and_is_its_exit_status(tmp_path: Path):
    process = start(DOUBLES, tmp_path, "counter.count=150", "counter.period=0.01", "sink.count=150")
    wait_for_output(process, tmp_path)
    (path,) = tmp_path.glob("*.mcap")
    resource.prlimit(recorder_of(process), resource.RLIMIT_FSIZE, (path.stat().st_size + 3000,) * 2)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == EXIT_INCOMPLETE
    assert len((tmp_path / "out.txt").read_text().splitlines()) == 150
    assert "INCOMPLETE: writing failed: File too large" in output
    assert "missing: counter.number#" in output
    assert "the recording is INCOMPLETE" in output


def wait_for_output(process: subprocess.Popen[str], folder: Path) -> None:
    while not (folder / "out.txt").exists():
        assert process.poll() is None
        time.sleep(0.02)


def everything(process: subprocess.Popen[str]) -> None:
    for pid in [*(child.pid for child in children(process)), process.pid]:  # of whom the first kills none of the others
        os.kill(pid, signal.SIGKILL)


def recorder(process: subprocess.Popen[str]) -> None:
    os.kill(recorder_of(process), signal.SIGKILL)


def supervisor(process: subprocess.Popen[str]) -> None:
    process.kill()


@pytest.mark.slow
@pytest.mark.parametrize("kill", [recorder, supervisor, everything])
@pytest.mark.parametrize("moment", range(3))
def test_a_graph_killed_at_any_moment_leaves_a_recording(
    tmp_path: Path, kill: Callable[[subprocess.Popen[str]], None], moment: int
):
    seconds = random.Random(f"{kill.__name__}{moment}").uniform(0.2, 3.0)
    lost: list[int] = []
    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        process = start(DOUBLES, folder, "counter.count=100000", "counter.period=0.005", "sink.count=100000")
        wait_for_output(process, folder)
        time.sleep(seconds)
        killed = time.time_ns()
        kill(process)
        process.communicate(timeout=60)
        assert process.returncode != 0
        (path,) = folder.glob("*.mcap")
        with path.open("rb") as file:  # which a process that dies lets go of last
            wait_until(lambda file=file, folder=folder: not (processes_of(folder) or is_being_written(file)))
        lost.append(lost_ns(path, "counter/number", killed))
        for command in reading(path):
            assert main(command) in (0, 1), command
        if lost[-1] <= LOST_NS:
            return
    raise AssertionError(f"lost {lost} ns")
