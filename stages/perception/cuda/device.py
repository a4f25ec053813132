"""Which device the filter runs on: the one place where ``device: auto | cpu | cuda`` becomes a :class:`Device`.

The GPU's costs equal the CPU's up to rounding, not byte by byte. A recording holds the configuration and with it the
device; ``auto`` replays to the same bytes only where the same kind of device is at hand.
"""

from __future__ import annotations

from typing import Any

from runner.contract import Refused
from stages.perception.filter.iterations import CPU, Device

DEVICES = ("auto", "cpu", "cuda")


def chosen_device(device: str, *, place: str) -> Device:
    """What ``auto``, ``cpu`` or ``cuda`` comes to on this machine; ``place`` is the setting's name for a refusal."""
    if device not in DEVICES:
        raise Refused(f"{place} is '{device}'; choose {', '.join(DEVICES[:-1])} or {DEVICES[-1]}")
    if device == "cpu":
        return CPU
    obstacle = cuda_obstacle()
    if obstacle is None:
        from stages.perception.cuda.iterations import CUDA

        return CUDA
    if device == "cuda":
        raise Refused(f"{place} is 'cuda', but {obstacle}; choose auto or cpu")
    return CPU


def cuda_obstacle() -> str | None:
    """Why kernels cannot run on a GPU here, in a few words; None where they can."""
    import numba.cuda  # a third of a second that the CPU path need not wait for

    cuda: Any = numba.cuda
    if cuda.is_available():
        # The target that ships with numba is an older one, on which these kernels were never compiled.
        own = numba.config.ENABLE_CUDASIM or cuda.implementation == "NVIDIA"  # pyright: ignore
        return None if own else "the package numba-cuda is not installed (extra 'cuda')"
    reason = str(cuda.cuda_error() or "no device").strip().splitlines()[0].rstrip(".")
    return f"numba finds no GPU ({reason})"
