"""The CUDA kernels without a GPU: in numba's simulator, and compiled for a Hopper card."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_kernels_in_the_simulator() -> None:
    done = run("pytest", "-p", "no:cacheprovider", "tests/stages/perception/cuda_simulated.py",
               NUMBA_ENABLE_CUDASIM="1")  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "skipped" not in done.stdout
