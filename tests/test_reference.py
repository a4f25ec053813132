"""The recording that comes with the source: one small image through all of perception (`make reference`)."""

import os
import platform
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


def replayed(**settings: str) -> str:
    """What ``runner replay --verify`` says of it."""
    command = [sys.executable, "-m", "runner.cli", "replay", str(REFERENCE), "--verify"]
    replay = subprocess.run(
        command, cwd=ROOT, env=os.environ | settings, capture_output=True, text=True, timeout=280, check=False
    )
    assert replay.returncode == 0, f"{replay.stdout}{replay.stderr}\n{HINT}"
    return replay.stdout


@pytest.mark.slow
def test_it_replays_bit_for_bit_or_says_why_not_and_stays_within_tolerances():
    """On the processor and libraries of the recording every byte is the same; elsewhere that is said first."""
    said = replayed()
    recording = Recording(REFERENCE)
    if fingerprint(machine(), package_versions(), numerical(recording.graph)) == recording.fingerprint:
        assert "IDENTICAL: 31 messages of 6 stages" in said
    else:
        assert said.startswith("FINGERPRINT DIFFERS")
        assert "IDENTICAL" in said or "WITHIN TOLERANCES" in said


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="names processors of the x86-64 family")
@pytest.mark.parametrize(
    "settings",
    [
        {"NUMBA_CPU_NAME": "haswell", "OPENBLAS_CORETYPE": "Haswell", "ATEN_CPU_CAPABILITY": "avx2"},
        {"NUMBA_CPU_NAME": "nehalem", "OPENBLAS_CORETYPE": "Nehalem", "ATEN_CPU_CAPABILITY": "default"},
    ],
    ids=lambda settings: settings["NUMBA_CPU_NAME"],
)
def test_another_processor_is_named_and_stays_within_tolerances(settings: dict[str, str]):
    settings |= {"NUMBA_CPU_FEATURES": ""}
    said = replayed(**settings)
    assert said.startswith("FINGERPRINT DIFFERS") and f"NUMBA_CPU_NAME={settings['NUMBA_CPU_NAME']}" in said
    assert "WITHIN TOLERANCES" in said
