"""The scalar functions of the CPU kernel, compiled once more for the GPU: one source for both devices.

``ceil`` and ``floor`` have no ufunc lowering in numba-cuda; libdevice's take their names. In numba's simulator, which
runs kernels as Python, the functions are what they are.
"""

# pyright: basic

from __future__ import annotations

import warnings
from types import FunctionType
from typing import Any

import numba.cuda
import numpy as np

from stages.perception.rendering import pixel_math

cuda: Any = numba.cuda
"""numba.cuda, whose type information covers neither its launches nor its shared arrays."""
SIMULATED = bool(numba.config.ENABLE_CUDASIM)  # pyright: ignore
"""Whether kernels run as Python on the CPU: set NUMBA_ENABLE_CUDASIM=1 before Python starts."""

# One block per particle or population is what the work has; numba warns of any grid below 128.
warnings.filterwarnings("ignore", message="Grid size")

if SIMULATED:
    ceil: Any = np.ceil
    floor: Any = np.floor
else:
    from numba.cuda import libdevice

    ceil, floor = libdevice.ceilf, libdevice.floorf


def on_device(function: Any, **names: Any) -> Any:
    """A device function from the Python source of a CPU one, with some of its global names bound anew."""
    source = function.py_func
    names = {"ceil": ceil, "floor": floor, **names}
    return cuda.jit(device=True)(FunctionType(source.__code__, {**source.__globals__, **names}, source.__name__))


project = on_device(pixel_math.project)
screen_matrix = on_device(pixel_math.screen_matrix)
triangle_setup = on_device(pixel_math.triangle_setup, project=project)
pixel_cost = on_device(pixel_math.pixel_cost)
height_row = on_device(pixel_math.height_row)
