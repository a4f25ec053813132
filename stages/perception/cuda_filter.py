"""Populations of particles that live on the GPU: whole iterations are queued and none is waited for.

Everything an iteration needs (the step of the schedule, the last generation's energies) lies on the device, so two
launches are all that an iteration is. Polish and early stopping are the CPU's: this is for the long middle of the
filter, where all objects that are at the same place of their sequences, of all hypotheses, go together.
"""

# pyright: basic

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.perception.cuda_batch import Batch, Look
from stages.perception.cuda_evolution import evolve
from stages.perception.cuda_math import cuda
from stages.perception.likelihood import Shape
from stages.scene.catalogue import Floats

THREADS = 128


@dataclass(frozen=True, kw_only=True)
class Population:
    """The particles of one object of one hypothesis, and where their successors may come from."""

    mesh: int
    window: int
    poses: Floats
    """First generation, N x 3 x 4; N is the same for all populations of a batch."""
    directions: Floats
    """Twists (rotation about the centre, translation; camera frame) the object may make, 6 x D."""
    flips: Floats
    """Rotations in the object's frame, F x 3 x 3."""
    pool: Floats
    """First guesses for renewed particles, R x 3 x 4; R is the same for all populations of a batch."""


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How particles move, iteration by iteration, S x 3: metres, radians, share that is drawn anew."""

    rows: Floats
    effective: float = 0.25
    scale: float = 0.0
    """lambda_r of equation 8; 0 chooses it in each iteration for ``effective``, a share of the particles."""
    flipped: float = 0.06
    elitism: bool = True

    @staticmethod
    def annealed(
        iterations: int, *, metres: tuple[float, float], radians: tuple[float, float], renewed: float = 0.05
    ) -> Schedule:
        """Geometric annealing from the first value of each pair to the second."""
        progress = np.arange(iterations) / max(1, iterations - 1)
        spread = [a ** (1 - progress) * b**progress for a, b in (metres, radians)]
        return Schedule(rows=np.stack([*spread, renewed * (1 - progress)], 1))


class CudaFilter:
    """H populations of N particles each, evolved together on one GPU."""

    def __init__(
        self, shapes: Sequence[Shape], looks: Sequence[Look], populations: Sequence[Population], schedule: Schedule, *,
        seed: int, batch: Batch | None = None,
    ) -> None:  # fmt: skip
        self._batch = batch or Batch(shapes, looks)
        self._threads = min(THREADS, self._batch.launch.threads)
        self._size = len(populations[0].poses)
        self._seed = np.int64(seed)
        poses = np.concatenate([p.poses for p in populations])
        self._poses, self._following = _put(poses, np.float32), _put(poses, np.float32)
        self._objects = _put(np.repeat([p.mesh for p in populations], self._size), np.int32)
        self._windows = _put(np.repeat([p.window for p in populations], self._size), np.int32)
        self._changes = _put(np.zeros(len(poses)), np.float32)
        self._tables = _tables(populations, shapes, looks, self._batch, schedule)
        self._steps = _put(np.zeros(len(populations)), np.int32)
        self._history = _put(np.full((len(populations), len(schedule.rows) + 1), np.inf), np.float32)

    def iterate(self, iterations: int, *, stream: Any = 0) -> None:
        """Queues iterations and returns at once."""
        shared = 4 * (self._threads + self._size)
        for _ in range(iterations):
            self._batch.write_costs(self._poses, self._objects, self._windows, self._changes, stream=stream)
            evolve[len(self._steps), self._threads, stream, shared](
                self._changes, self._poses, self._following, *self._tables, self._seed, self._steps, self._history
            )
            self._poses, self._following = self._following, self._poses

    def generation(self) -> Floats:
        """Waits for what is queued and returns the particles, H x N x 3 x 4; the last of each population is the best
        of the generation before where elitism is on."""
        return self._poses.copy_to_host().reshape(len(self._steps), self._size, 3, 4).astype(float)

    def history(self) -> Floats:
        """Waits for what is queued and returns the best energy of each iteration so far, H x S."""
        steps = int(self._steps.copy_to_host().max())
        return self._history.copy_to_host()[:, :steps].astype(float)


def _tables(
    populations: Sequence[Population], shapes: Sequence[Shape], looks: Sequence[Look], batch: Batch, schedule: Schedule
) -> list[Any]:
    """What ``evolve`` reads besides particles, in its order."""
    flips = [len(p.flips) for p in populations]
    first_flips = np.cumsum([0, *flips[:-1]])
    rows = [(p.mesh, p.window, first, count) for p, first, count in zip(populations, first_flips, flips, strict=True)]
    windows = [
        [*look.window.box, *np.minimum(look.window.reach, 1e6), base, not look.form.plain]
        for look, base in zip(looks, batch.bases, strict=True)
    ]
    settings = [schedule.effective, schedule.scale, schedule.flipped, schedule.elitism]
    floats = (
        np.concatenate([p.flips for p in populations]),
        np.stack([p.directions for p in populations]),
        np.stack([p.pool for p in populations]),
        schedule.rows,
        np.array(settings, float),
    )
    return [
        _put(np.array(rows), np.int32),
        _put(np.array([[*shape.centre, shape.diameter] for shape in shapes]), np.float32),
        _put(np.stack([look.window.view.numbers for look in looks]), np.float32),
        _put(np.array(windows, float), np.float32),
        *(_put(array, np.float32) for array in floats),
    ]


def _put(array: Any, kind: Any) -> Any:
    return cuda.to_device(np.ascontiguousarray(array, kind))
