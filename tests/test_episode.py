"""The main job as a user runs it: shown, disturbed, restored, with a particle filter killed at work, then replayed."""

import hashlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.robot.pictures import sheet, views
from runner.message.codec import pack
from runner.recording.recording import Recording
from tests.runner.transport.test_bad_input import public_address, stranger

ROOT = Path(__file__).parent.parent
RUNNER = (sys.executable, "-m", "runner.cli")


def pid_of(log: Path) -> int:
    """The process whose output goes to a log file."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if (process / "fd" / "1").readlink() == log:
                return int(process.name)
        except OSError:
            continue
    raise AssertionError(f"no process writes to {log}")


def lines_of(process: subprocess.Popen[str]) -> Iterator[str]:
    assert process.stdout is not None
    for line in process.stdout:
        yield line.rstrip("\n")


def kill_once_at_work(lines: Iterator[str], recordings: Path) -> list[str]:
    """Kills the first particle filter a second after it has been given the start scene; returns what was printed."""
    printed: list[str] = []
    for line in lines:
        printed.append(line)
        if " detector " in line and " start: " in line:
            time.sleep(1.0)
            (log,) = recordings.glob("tray-*/log/particle_filter-0.txt")
            os.kill(pid_of(log), signal.SIGKILL)
    return printed


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_scene_is_restored_though_a_particle_filter_is_killed_and_replays_to_the_byte(tmp_path: Path) -> None:
    command = (*RUNNER, "up", "graph.yaml", "--set", "world.seed=3", "--recordings", str(tmp_path))
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        printed = kill_once_at_work(lines_of(process), tmp_path)
    assert process.returncode == 0, "\n".join(printed)
    (recording,) = tmp_path.glob("tray-*.mcap")
    assert f"recording {recording}: COMPLETE" in printed
    (report,) = tmp_path.glob("tray-*/report.txt")
    assert "particle_filter" in report.read_text().split("restarts")[1]
    for name in ("domain.pddl", "goal-breakfast.pddl", "problem-01.pddl"):
        assert (report.parent / name).is_file()
    seen = views(recording)
    assert list(seen) == ["goal", "start", "middle", "end"] and len({rgb.tobytes() for rgb in seen.values()}) == 4
    assert sheet([list(seen.items())] * 2).size == (4 * 320, 2 * 240)
    replay = subprocess.run(
        (*RUNNER, "replay", str(recording), "--verify"), cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert replay.returncode == 0, replay.stdout + replay.stderr
    assert "IDENTICAL" in replay.stdout


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_zenoh_subscriber_hears_every_message_of_the_job_once_and_byte_for_byte(tmp_path: Path) -> None:
    address = public_address()
    settings = (
        "--set",
        "world.seed=3",
        "--set",
        f"listen={address}",
        "--recordings",
        str(tmp_path),
    )
    heard: Counter[tuple[str, str]] = Counter()
    with subprocess.Popen((*RUNNER, "up", "graph.yaml", *settings), cwd=ROOT, stdout=subprocess.PIPE, text=True) as job:
        lines = lines_of(job)
        printed = [next(lines)]
        with stranger(address) as session:
            session.declare_subscriber(
                "**", lambda sample: heard.update([(str(sample.key_expr), digest(sample.payload.to_bytes()))])
            )
            printed += lines
    assert job.returncode == 0, "\n".join(printed)
    (path,) = tmp_path.glob("tray-*.mcap")
    recording = Recording(path)
    assert recording.verdict.complete
    recorded = Counter(
        (f"{path.stem}/m/{recording.messages[one.id].topic}", digest(pack(one))) for one in recording.envelopes()
    )
    messages = Counter({one: count for one, count in heard.items() if "/m/" in one[0]})
    assert set(recorded.values()) == {1}
    assert messages == recorded
    assert {digest(pack(step)) for step in recording.steps} <= {text for key, text in heard if "/s/" in key}


def digest(payload: bytes) -> str:
    """Stands for the bytes of a message."""
    return hashlib.sha256(payload).hexdigest()
