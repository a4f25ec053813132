"""The robot at somebody's command: a goal is taught, disturbed and restored from another terminal."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from runner.testing import read_until

ROOT = Path(__file__).parent.parent
RUNNER = (sys.executable, "-m", "runner.cli")


def runner(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run((*RUNNER, *arguments), cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_goal_is_taught_disturbed_and_restored_by_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    command = (
        *RUNNER,
        "up",
        "graphs/interactive.yaml",
        "--set",
        "world.seed=1",
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
        assert (unknown.returncode, "no such goal; valid: breakfast" in unknown.stderr) == (2, True)
        disturbed = runner("call", "world", "arrange", "kind=start")
        assert "start scene laid out" in disturbed.stdout
        restored = runner("call", "demonstrator", "restore", "name=breakfast")
        assert restored.returncode == 0, restored.stdout + restored.stderr
        assert "  success: True" in restored.stdout.splitlines()
        again = runner("call", "demonstrator", "restore", "name=breakfast")
        assert "every relation of the goal holds" in again.stdout
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
    shutil.rmtree(tmp_path / "scene-programming")
    replay = runner("replay", str(recording), "--verify")
    assert replay.returncode == 0, replay.stdout + replay.stderr
