"""Compiles every CUDA kernel for a Hopper card (sm_90) and prints what ptxas says; needs a toolkit, but no GPU.

``NUMBA_FORCE_CUDA_CC=9.0 python -m tests.stages.perception.cuda.ptx FOLDER``
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numba.cuda.dispatcher
from numba import cuda, float32, float64, int32, int64, void

from stages.perception.cuda import cost_kernel, polish_kernel, transition_kernel

f1, f2, f3, f4 = float32[::1], float32[:, ::1], float32[:, :, ::1], float32[:, :, :, ::1]
i1, i2, seeds = int32[::1], int32[:, ::1], int64[::1]
SIGNATURES = {
    "evaluate": (cost_kernel.evaluate, void(f1, i2, f3, f2, f2, i1, f2, f2, f2, f3, i1, i1, f1)),
    "evolve": (
        transition_kernel.evolve,
        void(f1, f3, f3, i1, i2, f2, f3, f2, f3, f3, f4, f2, i2, f1, seeds, i2, i1, f2, f4),
    ),
    "refine": (polish_kernel.refine, void(f1, i2, f3, f2, f2, i1, f2, f3, f3, i1, i1, i1, int32, float64)),
}
MISSING = 3
"""Exit status where the toolkit is not at hand."""


def obstacle() -> str:
    """Why nothing can be compiled here, or nothing."""
    if importlib.util.find_spec("numba_cuda") is None:
        return "the package numba-cuda is not installed"
    from cuda import pathfinder

    for library in ("nvvm", "nvrtc"):
        try:
            pathfinder.load_nvidia_dynamic_lib(library)
        except pathfinder.DynamicLibNotFoundError:
            return f"CUDA's {library} library is not installed"
    try:
        subprocess.run(["ptxas", "--version"], capture_output=True, check=True)
    except FileNotFoundError:
        return "ptxas is not on the path"
    return ""


def ptx(name: str) -> str:
    """The kernel's assembly for compute capability 9.0."""
    kernel, signature = SIGNATURES[name]
    code, _ = cuda.compile(kernel.py_func, signature, device=False, cc=(9, 0), abi="numba", output="ptx")
    return code


def report(name: str, folder: Path) -> str:
    """Registers, spills and double-precision instructions of one kernel, in a line."""
    source = folder / f"{name}.ptx"
    source.write_text(ptx(name))
    command = ["ptxas", "-v", "-arch=sm_90", str(source), "-o", str(folder / f"{name}.cubin")]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    registers, spilt = re.search(r"Used (\d+) registers", said), re.search(r"(\d+) bytes spill stores", said)
    assert registers and spilt, said
    doubles = len(re.findall(r"^\s*\w+[\w.]*\.f64\s", source.read_text(), re.MULTILINE))
    return f"{name}: {registers[1]} registers, {spilt[1]} bytes spilt, {doubles} instructions in double precision"


def main(folder: Path) -> int:
    if reason := obstacle():
        print(reason)
        return MISSING
    # Device functions that kernels call ask for the current device; nothing else of the compiler does.
    device = SimpleNamespace(compute_capability=(9, 0))
    numba.cuda.dispatcher.get_current_device = lambda: device
    for name in SIGNATURES:
        print(report(name, folder))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
