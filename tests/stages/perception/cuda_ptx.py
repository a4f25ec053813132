"""Compiles every CUDA kernel for a Hopper card (sm_90) and prints what ptxas says; needs a toolkit, but no GPU.

``NUMBA_FORCE_CUDA_CC=9.0 python -m tests.stages.perception.cuda_ptx FOLDER``
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numba.cuda.dispatcher
from numba import cuda, float32, int32, void

from stages.perception import cuda_kernels

f1, f2, f3 = float32[::1], float32[:, ::1], float32[:, :, ::1]
i1, i2 = int32[::1], int32[:, ::1]
SIGNATURES = {
    "evaluate": (cuda_kernels.evaluate, void(f1, i2, f3, f2, f2, i1, f2, f2, f2, f3, i1, i1, f1)),
}


def ptx(name: str) -> str:
    """The kernel's assembly for compute capability 9.0."""
    kernel, signature = SIGNATURES[name]
    code, _ = cuda.compile(kernel.py_func, signature, device=False, cc=(9, 0), abi="numba", output="ptx")
    return code


def main(folder: Path) -> None:
    # Device functions that kernels call ask for the current device; nothing else of the compiler does.
    device = SimpleNamespace(compute_capability=(9, 0))
    numba.cuda.dispatcher.get_current_device = lambda: device
    for name in SIGNATURES:
        source = folder / f"{name}.ptx"
        source.write_text(ptx(name))
        command = ["ptxas", "-v", "-arch=sm_90", str(source), "-o", str(folder / f"{name}.cubin")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        print(name, done.returncode, done.stderr, sep="\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
