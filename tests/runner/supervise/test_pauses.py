"""A process that stands still for longer than any lease has not died: nothing is lost, and the verdict is true."""

import os
import signal
import time
from pathlib import Path

import pytest

from runner.recording.recording import Recording
from runner.testing import read_until
from tests.runner.common.runs import TOYS, changed, finish, pid_of, processes_of, start

COUNT = 80
VICTIMS = {"worker": "worker-0", "publisher": "splitter-0", "recorder": "recorder-0", "supervisor": ""}


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [12, 25])
def test_a_pause_of_any_process_loses_nothing(tmp_path: Path, seconds: float):
    """All at once, each in a graph of its own: they wait most of the time."""
    folders = {victim: tmp_path / victim for victim in VICTIMS}
    graphs, seen = {}, {}
    for victim, folder in folders.items():
        folder.mkdir()
        settings = (f"counter.go={tmp_path / 'go'}", "counter.waits=0", f"counter.count={COUNT}", "counter.period=0.2")
        graphs[victim] = start(changed(TOYS, folder, Counter="GatedCounter"), folder, *settings)
    for victim, process in graphs.items():
        seen[victim] = read_until(process, "processes are ready")
    (tmp_path / "go").touch()
    time.sleep(1)
    pids = {victim: pid_of(folders[victim], name) if name else graphs[victim].pid for victim, name in VICTIMS.items()}
    for pid in pids.values():
        os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    for pid in pids.values():
        os.kill(pid, signal.SIGCONT)
    for victim, process in graphs.items():
        ended = finish(process, folders[victim], seen[victim])
        assert (ended.code, len(ended.result)) == (0, COUNT), (victim, ended.output)
        assert "restarts (" not in ended.output, (victim, ended.output)
        recording = Recording(ended.recording)
        assert recording.verdict.complete, (victim, recording.verdict)
        steps = [step.stage for step in recording.steps]
        expected = {"counter": COUNT, "splitter": COUNT, "worker": 4 * COUNT, "gatherer": COUNT, "sink": COUNT}
        assert {stage: steps.count(stage) for stage in expected} == expected, victim
        assert processes_of(folders[victim]) == []
