"""The recording that comes with the source: one small image through all of perception (`make reference`)."""

import subprocess
import sys
from pathlib import Path

import pytest

from runner.recording.provenance import fingerprint, machine, numerical, package_versions
from runner.recording.recording import Recording

ROOT = Path(__file__).parents[1]
REFERENCE = ROOT / "recordings" / "reference.mcap"
MOST_BYTES = 2_000_000
HINT = "where perception was changed on purpose, `make reference` records it again"


def test_it_is_small_complete_and_kept():
    recording = Recording(REFERENCE)
    assert REFERENCE.stat().st_size <= MOST_BYTES
    assert recording.verdict.complete
    assert {"Frame", "Observation", "Posterior", "SceneEstimate", "SceneGraph"} <= {
        message.type for message in recording.messages.values()
    }
    ignored = subprocess.run(["git", "-C", ROOT, "check-ignore", "-q", REFERENCE], check=False)
    assert ignored.returncode != 0


@pytest.mark.slow
def test_it_replays_bit_for_bit_or_says_why_not_and_stays_within_tolerances():
    """On the processor and libraries of the recording every byte is the same; elsewhere that is said first."""
    command = [sys.executable, "-m", "runner.cli", "replay", str(REFERENCE), "--verify"]
    replay = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=280, check=False)
    said = replay.stdout
    assert replay.returncode == 0, f"{said}{replay.stderr}\n{HINT}"
    recording = Recording(REFERENCE)
    if fingerprint(machine(), package_versions(), numerical(recording.graph)) == recording.fingerprint:
        assert "IDENTICAL: 31 messages of 6 stages" in said
    else:
        assert said.startswith("FINGERPRINT DIFFERS")
        assert "IDENTICAL" in said or "WITHIN TOLERANCES" in said
