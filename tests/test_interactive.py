"""The robot at somebody's command: a goal is taught, disturbed and restored from another terminal."""

import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from runner.contract import Message
from runner.message.codec import open_envelope
from runner.recording.recording import Recording
from runner.testing import read_until
from stages.messages import RobotCommand, RobotState

M = TypeVar("M", bound=Message)
ROOT = Path(__file__).parent.parent
RUNNER = (sys.executable, "-m", "runner.cli")


def runner(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run((*RUNNER, *arguments), cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)


BY_HAND = """
(define (problem tea) (:domain scene) (:objects cup tray - item) (:init) (:goal (in cup tray)))
"""


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_arm_is_stopped_on_its_way_by_a_command_and_by_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    graph = tmp_path / "slow.yaml"
    text = (ROOT / "graphs" / "interactive.yaml").read_text()
    graph.write_text(text.replace("stages.world:World", "tests.slow_world:SlowWorld"))
    settings = ("--set", "world.seed=3", "--set", "corrector.calibrate=false", "--recordings", str(tmp_path / "rec"))
    up = (*RUNNER, "up", str(graph), *settings)
    restore = (*RUNNER, "call", "demonstrator", "restore", "name=breakfast")
    with subprocess.Popen(up, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        read_until(process, "processes are ready")
        assert runner("call", "demonstrator", "teach", "name=breakfast").returncode == 0
        assert runner("call", "world", "arrange", "kind=start").returncode == 0
        with subprocess.Popen(restore, cwd=ROOT, stdout=subprocess.PIPE, text=True) as asked:
            first = grasped(process)
            stop = runner("call", "executor", "stop")
            verdict = asked.communicate(timeout=60)[0]
        for answer in (stop.stdout, verdict):
            assert f"reason: stopped, as asked; in the hand: {first}" in answer
        assert f"held: {first}" in stop.stdout
        with subprocess.Popen(restore, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as asked:
            second = grasped(process)
            time.sleep(2)
            process.send_signal(signal.SIGINT)
            printed = process.communicate(timeout=60)[0]
            assert "the graph ended before it was done" in asked.communicate(timeout=60)[0]
    assert f"stopped on the way; {second} is in the hand" in printed
    assert re.search(r"the arm stands; the fingers are \d+ mm apart", printed)
    (recording,) = (tmp_path / "rec").glob("interactive-*.mcap")
    assert f"recording {recording}: COMPLETE" in printed
    commands, states = (of(recording, kind) for kind in (RobotCommand, RobotState))
    (at,) = [k for k, state in enumerate(states) if state.stopped == "stop"]
    stood, later = states[at : at + 2]
    np.testing.assert_allclose(later.positions, stood.positions, atol=0.01)  # once the next task reads the encoders
    assert commands[-1].label == f"lift {second}"  # which no state answers


def grasped(process: subprocess.Popen[str]) -> str:
    """What the hand has closed on, as soon as it has."""
    line = read_until(process, "grasped with").splitlines()[-1]
    return line.split()[3].rstrip(":")


def of(path: Path, kind: type[M]) -> list[M]:
    """Every recorded message of a type, in order."""
    return [open_envelope(kind, one) for one in Recording(path).envelopes() if one.type == kind.__name__]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_goal_is_taught_disturbed_and_restored_by_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    by_hand = tmp_path / "scene-programming" / "goals" / "tea" / "goal.pddl"
    by_hand.parent.mkdir(parents=True)
    by_hand.write_text(BY_HAND)
    command = (
        *RUNNER,
        "up",
        "graphs/interactive.yaml",
        "--set",
        "world.seed=3",
        "--set",
        "corrector.calibrate=false",
        "--recordings",
        str(tmp_path / "rec"),
    )
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        printed = read_until(process, "processes are ready")
        taught = runner("call", "demonstrator", "teach", "name=breakfast")
        assert taught.returncode == 0, taught.stdout + taught.stderr
        assert 'goal "breakfast" remembered: 6 objects' in taught.stdout
        unknown = runner("call", "demonstrator", "restore", "name=lunch")
        assert (unknown.returncode, "no such goal; valid: breakfast, tea" in unknown.stderr) == (2, True)
        disturbed = runner("call", "world", "arrange", "kind=start")
        assert "start scene laid out" in disturbed.stdout
        restored = runner("call", "demonstrator", "restore", "name=breakfast")
        assert restored.returncode == 0, restored.stdout + restored.stderr
        assert "  success: True" in restored.stdout.splitlines()
        again = runner("call", "demonstrator", "restore", "name=breakfast")
        assert "every relation of the goal holds" in again.stdout
        tea = runner("call", "demonstrator", "restore", "name=tea")
        assert "  success: True" in tea.stdout.splitlines(), tea.stdout + tea.stderr
        idle = runner("call", "executor", "stop")
        assert (idle.returncode, "the arm is not under way" in idle.stderr) == (2, True)
        renamed = runner("call", "goals", "rename", "name=breakfast", "to=brunch")
        assert 'goal "breakfast" is now "brunch"' in renamed.stdout
        assert runner("down").returncode == 0
        printed += process.communicate(timeout=60)[0]
    assert process.returncode == 0, printed
    (recording,) = (tmp_path / "rec").glob("interactive-*.mcap")
    assert f"recording {recording}: COMPLETE" in printed
    kept = runner("goals", "--graph", "graphs/interactive.yaml").stdout
    assert kept.startswith("brunch\n    6 objects: the ") and "runner call goals forget name=brunch" in kept
    assert "tea\n    2 objects: the cup and the tray" in kept
    shutil.rmtree(tmp_path / "scene-programming")
    replay = runner("replay", str(recording), "--verify")
    assert replay.returncode == 0, replay.stdout + replay.stderr
