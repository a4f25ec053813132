"""Which device weighs poses: the one place where ``device: auto | cpu | cuda`` becomes a function.

The GPU's costs equal the CPU's up to rounding, not byte by byte. A recording holds the configuration and with it the
device; ``auto`` replays to the same bytes only where the same kind of device is at hand.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, Protocol

from runner.contract import Refused
from stages.geometry.arrays import Floats

if TYPE_CHECKING:
    from stages.perception.filter.likelihood import ObjectLikelihood
    from stages.perception.rendering.rasteriser import Float32s

Device = Literal["cpu", "cuda"]
DEVICES = ("auto", "cpu", "cuda")


class Evaluator(Protocol):
    """What a device does with poses P x 3 x 4 of one object in one window."""

    def changes(self, poses: Floats) -> Float32s:
        """Changes of cost, P."""
        ...

    def refined(self, poses: Floats, directions: Floats, *, steps: int, gate: float) -> Floats:
        """Poses after Gauss-Newton steps, as ``ObjectLikelihood.refine``."""
        ...


def chosen_device(device: str, *, place: str) -> Device:
    """What ``auto``, ``cpu`` or ``cuda`` comes to on this machine; ``place`` is the setting's name for a refusal."""
    if device not in DEVICES:
        raise Refused(f"{place} is '{device}'; choose {', '.join(DEVICES[:-1])} or {DEVICES[-1]}")
    if device == "cpu":
        return "cpu"
    obstacle = cuda_obstacle()
    if obstacle is None:
        return "cuda"
    if device == "cuda":
        raise Refused(f"{place} is 'cuda', but {obstacle}; choose auto or cpu")
    return "cpu"


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


def cuda_evaluator(likelihood: ObjectLikelihood) -> Evaluator:
    """The GPU's costs and polish of one object in one window; both stay on the device as long as this lives."""
    from stages.perception.cuda.batch import Batch, Look

    return Batch([likelihood.shape], [Look.of(likelihood)])
