"""The main job as a user runs it: shown, disturbed, restored, with a particle filter killed at work, then replayed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

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
    command = (*RUNNER, "up", "graph.yaml", "--set", "world.seed=1", "--recordings", str(tmp_path))
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        printed = kill_once_at_work(lines_of(process), tmp_path)
    assert process.returncode == 0, "\n".join(printed)
    (recording,) = tmp_path.glob("tray-*.mcap")
    assert f"recording {recording}: COMPLETE" in printed
    (report,) = tmp_path.glob("tray-*/report.txt")
    assert "particle_filter" in report.read_text().split("restarts")[1]
    for name in ("domain.pddl", "goal-breakfast.pddl", "problem-01.pddl"):
        assert (report.parent / name).is_file()
    replay = subprocess.run(
        (*RUNNER, "replay", str(recording), "--verify"), cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert replay.returncode == 0, replay.stdout + replay.stderr
    assert "IDENTICAL" in replay.stdout
