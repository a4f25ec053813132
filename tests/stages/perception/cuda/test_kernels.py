"""The CUDA kernels without a GPU: in numba's simulator, and compiled for a Hopper card."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[4]
NO_TOOLKIT = 3


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_kernels_in_the_simulator() -> None:
    done = run("pytest", "-p", "no:cacheprovider", "tests/stages/perception/cuda/simulated.py",
               NUMBA_ENABLE_CUDASIM="1")  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "skipped" not in done.stdout


@pytest.mark.slow
def test_kernels_compile_for_a_hopper_card(tmp_path: Path) -> None:
    done = run("tests.stages.perception.cuda.ptx", str(tmp_path), NUMBA_FORCE_CUDA_CC="9.0")
    if done.returncode == NO_TOOLKIT:
        pytest.skip(done.stdout.strip())
    assert done.returncode == 0, done.stdout + done.stderr
    cost, evolution, polish = done.stdout.splitlines()
    assert " 0 bytes spilt, 0 instructions in double precision" in cost
    # Its doubles are in the sine of arguments beyond 10^5, which never occur.
    assert evolution.startswith("evolve: ")
    assert " 0 bytes spilt, " in evolution
    # Few particles are polished, and in double precision as on the CPU.
    assert polish.startswith("refine: ")
