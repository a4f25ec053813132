"""Meshes and windows on the GPU, and the costs of particles of any of them in any of these in one launch."""

# pyright: basic

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.geometry.arrays import Floats
from stages.perception.cuda.cost_kernel import evaluate
from stages.perception.cuda.polish_kernel import refine
from stages.perception.cuda.scalars import SIMULATED, cuda
from stages.perception.filter.likelihood import CostForm, ObjectLikelihood, Shape, Window
from stages.perception.rendering.rasteriser import LANES, Float32s, Soup

THREADS = 2 if SIMULATED else 128
"""Per particle; a power of two. Sums are taken in this many strands, so another number changes the last bits. In the
simulator each is a thread of Python."""
Z_BUFFER_BYTES = 32 * 1024
"""Shared memory for a particle's z-buffer, at most 47 KB: seven blocks fit on a multiprocessor of a Hopper card at
once, and rectangles up to 90 x 90 pixels are drawn in one go."""
_TEAMWORK = 2048
"""Triangles times threads per triangle that a block aims at: small meshes have large triangles."""


@dataclass(frozen=True)
class CostInputs:
    """What particles are compared with: a window, the plane below (unit normal, offset) and the form of the cost."""

    window: Window
    plane: Float32s
    form: CostForm

    @staticmethod
    def of(likelihood: ObjectLikelihood) -> CostInputs:
        """What a likelihood compares with."""
        return CostInputs(likelihood.window, likelihood.plane, likelihood.form)


@dataclass(frozen=True)
class Launch:
    """How a batch is cut up; results depend on ``threads`` alone, and on that only by rounding."""

    threads: int = THREADS
    z_buffer_bytes: int = Z_BUFFER_BYTES
    team: int | None = None
    """Threads per triangle, a power of two that divides ``threads``; None chooses by the number of triangles."""


class Batch:
    """M meshes and W windows on the device; particles name theirs by index.

    All populations of a frame that are at the same place of their sequences go through one launch, whatever their
    hypothesis: ``windows`` tells the backgrounds of the hypotheses apart, ``objects`` the meshes.
    """

    def __init__(self, shapes: Sequence[Shape], inputs: Sequence[CostInputs], launch: Launch | None = None) -> None:
        self.launch = launch or Launch()
        self._meshes = _meshes(shapes, self.launch)
        self._windows = _windows(inputs)
        self.bases = np.array([each.window.base for each in inputs])
        """Cost of each window without the object, W, metres times pixels."""
        widest = max(each.window.view.width for each in inputs)
        # Polish looks at the rows above and below.
        words = max(self.launch.z_buffer_bytes // 4, 3 * widest)
        words = min(words, max(each.window.factor.size for each in inputs))
        self._shared_bytes = 4 * (words + self.launch.threads)
        self._room: list[Any] = []
        self.middles = put(np.array([[*shape.centre, shape.diameter] for shape in shapes]), np.float32)
        """Centre and diameter of each mesh, M x 4, on the device."""

    def write_costs(self, poses: Any, objects: Any, windows: Any, out: Any, *, stream: Any = 0) -> None:
        """Changes of cost, P, for poses P x 3 x 4 float32 of objects P and windows P (int32); all on the device.

        Anything with ``__cuda_array_interface__`` is taken as it lies, torch tensors among them. Returns before the
        device has finished.
        """
        arrays = [_in_place(array) for array in (poses, objects, windows, out)]
        evaluate[len(poses), self.launch.threads, stream, self._shared_bytes](*self._meshes, *self._windows, *arrays)

    def polish(
        self,
        poses: Any,
        objects: Any,
        windows: Any,
        directions: Any,
        counts: Any,
        *,
        most: int,
        steps: int,
        gate: float,
        stream: Any = 0,
    ) -> None:
        """Moves in place the first of each of H populations by Gauss-Newton steps, ``counts[h]`` and at ``most`` so
        many; all on the device, poses H N x 3 x 4, directions H x 6 x D. Returns before the device has finished."""
        refine[(most, len(counts)), self.launch.threads, stream, self._shared_bytes](
            *self._meshes[:3], self.middles, *self._windows[:3], directions, poses, objects, windows, counts,
            np.int32(steps), np.float64(gate),
        )  # fmt: skip

    def refined(self, poses: Floats, directions: Floats, *, steps: int, gate: float) -> Floats:
        """Poses given on the host after Gauss-Newton steps, K x 3 x 4, of the first mesh in the first window."""
        none = put(np.zeros(len(poses)), np.int32)
        moved, counts = put(poses, np.float32), put(np.array([len(poses)]), np.int32)
        if len(poses):
            self.polish(moved, none, none, put(directions[None], np.float32), counts, most=len(poses), steps=steps,
                        gate=gate)  # fmt: skip
        return moved.copy_to_host().astype(float)

    def costs(self, poses: Any, objects: Any, windows: Any) -> Float32s:
        """Changes of cost of poses given on the host, P."""
        count = len(poses)
        if count == 0:
            return np.zeros(0, np.float32)
        places = [array[:count] for array in self._buffers(count)]
        for place, array in zip(places, (poses, objects, windows), strict=False):
            place.copy_to_device(np.ascontiguousarray(array, place.dtype))
        self.write_costs(*places)
        return places[-1].copy_to_host()

    def changes(self, poses: Floats) -> Float32s:
        """What ``kernels.change_of_cost`` writes, P, for the first mesh in the first window.

        Equal up to rounding, not byte by byte: the CPU adds along rows what the GPU adds in strands.
        """
        none = np.zeros(len(poses), np.int32)
        return self.costs(poses, none, none)

    def _buffers(self, count: int) -> list[Any]:
        """Room on the device for poses, objects, windows and costs; to allocate it each time would cost more than the
        kernel."""
        if not self._room or len(self._room[0]) < count:
            shapes = (((count, 3, 4), np.float32), (count, np.int32), (count, np.int32), (count, np.float32))
            self._room = [cuda.device_array(*shape) for shape in shapes]
        return self._room


def _in_place(array: Any) -> Any:
    """A view of a device array of any library, without a copy; in the simulator devices are the host's memory."""
    if hasattr(array, "copy_to_host"):
        return array
    return np.asarray(array) if SIMULATED else cuda.as_cuda_array(array)


def _meshes(shapes: Sequence[Shape], launch: Launch) -> list[Any]:
    """lanes, table, corners and support of all meshes, one after the other."""
    rows, blocks, supports = [], 0, 0
    for shape in shapes:
        team = launch.team or _team(shape.soup, launch.threads)
        rows.append([blocks, shape.soup.blocks, supports, len(shape.support), team])
        blocks, supports = blocks + shape.soup.blocks, supports + len(shape.support)
    arrays = (
        np.concatenate([shape.soup.lanes for shape in shapes]),
        np.array(rows, np.int32),
        np.stack([shape.soup.corners for shape in shapes]),
        np.concatenate([shape.support for shape in shapes]),
    )
    return [put(array, array.dtype) for array in arrays]


def put(array: Any, kind: Any) -> Any:
    """A copy on the device."""
    return cuda.to_device(np.ascontiguousarray(array, kind))


def _team(soup: Soup, threads: int) -> int:
    share = max(1, _TEAMWORK // (soup.blocks * LANES))
    return min(threads, 32, 1 << (share.bit_length() - 1))


def _windows(inputs: Sequence[CostInputs]) -> list[Any]:
    """views, first pixels, pixels (4 x N), planes and limits of all windows, one after the other."""
    sizes = [each.window.factor.size for each in inputs]
    layers = [
        np.stack([a.ravel() for a in (w.inverse_background, w.observed, w.factor, w.credit)])
        for w in (each.window for each in inputs)
    ]
    arrays = (
        np.stack([each.window.view.numbers for each in inputs]),
        np.cumsum([0, *sizes[:-1]]).astype(np.int32),
        np.concatenate(layers, 1).astype(np.float32),
        np.stack([each.plane for each in inputs]).astype(np.float32),
        np.array([limits(each.form) for each in inputs], np.float32),
    )
    return [put(array, array.dtype) for array in arrays]


def limits(form: CostForm) -> list[float]:
    """The numbers of a form as kernels take them."""
    return [form.truncation, form.occluder_margin, form.occluder_cost, form.contact_slack]
