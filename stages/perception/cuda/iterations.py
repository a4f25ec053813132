"""Populations of particles that live on the GPU: whole iterations are queued, and the host looks only now and then.

An iteration is three launches: costs, then weights, resampling and transition, then polish. All that it needs lies on
the device, and so does what ends it early: a population that has settled is passed over by what is still queued.
"""

# pyright: basic

from __future__ import annotations

from collections.abc import Sequence
from math import gcd
from typing import Any

import numpy as np

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.perception.cuda.batch import Batch, CostInputs, Launch, put
from stages.perception.cuda.cost_kernel import NOTHING
from stages.perception.cuda.transition_kernel import DONE, SIZE, STEP, evolve
from stages.perception.filter.iterations import (
    POLISH_GATE,
    POLISH_STEPS,
    THINNED,
    Device,
    Generation,
    IterationSettings,
    Population,
)
from stages.perception.filter.likelihood import CostForm, Shape, Window
from stages.perception.filter.settings import FilterSettings
from stages.perception.rendering.rasteriser import Float32s

_SHARED_BYTES = 48 * 1024
"""What a block may have without asking the driver for more."""
_GOLDEN = (5**0.5 - 1) / 2


class CudaIterations:
    """H populations evolved together on one GPU; each ends with the bytes that it would have alone."""

    def __init__(
        self, populations: Sequence[Population], plan: Sequence[IterationSettings], settings: FilterSettings, *,
        launch: Launch | None = None,
    ) -> None:  # fmt: skip
        likelihoods = [population.likelihood for population in populations]
        self._batch = Batch([each.shape for each in likelihoods], [CostInputs.of(each) for each in likelihoods], launch)
        self._threads = self._batch.launch.threads
        self._plan = list(plan)
        self._queued = 0
        self._capacity = max([len(p.poses) for p in populations] + [step.count for step in plan])
        if self._shared_bytes() > _SHARED_BYTES:
            raise Refused(
                f"particle_filter.particles is {self._capacity}; a GPU's block keeps the energies of at most "
                f"{_SHARED_BYTES // 4 - self._threads}"
            )
        self._lay_out(populations)
        self._directions = put(np.stack([p.directions for p in populations]), np.float32)
        self._tables = _tables(populations, self._batch, self._plan, settings, self._directions)
        self._keep_room(populations)

    def iterate(self, count: int, *, stream: Any = 0) -> bool:
        """Queues up to ``count`` iterations; where there are more to come, waits and looks whether any is needed."""
        for step in self._plan[self._queued : self._queued + count]:
            self._queue(step, stream)
        self._queued = min(len(self._plan), self._queued + count)
        return self._queued < len(self._plan) and not self._state.copy_to_host()[:, DONE].all()

    def best(self) -> list[float]:
        """As in :class:`Iterations`."""
        return [min((generation.cost for generation in each), default=np.inf) for each in self.history()]

    def population(self) -> list[Floats]:
        """As in :class:`Iterations`."""
        sizes = self._state.copy_to_host()[:, SIZE]
        poses = self._poses.copy_to_host().reshape(len(sizes), self._capacity, 3, 4).astype(float)
        return [each[:size] for each, size in zip(poses, sizes, strict=True)]

    def history(self) -> list[list[Generation]]:
        """As in :class:`Iterations`."""
        costs, traces = self._history.copy_to_host().astype(float), self._traces.copy_to_host().astype(float)
        steps = self._state.copy_to_host()[:, STEP]
        return [
            [Generation(float(costs[h, i]), traces[h, i, : -(-sizes[i] // THINNED)]) for i in range(steps[h])]
            for h, sizes in enumerate(self._sizes)
        ]

    def _shared_bytes(self) -> int:
        """What ``evolve`` keeps in shared memory."""
        return 4 * (self._threads + self._capacity)

    def _queue(self, step: IterationSettings, stream: Any) -> None:
        self._batch.write_costs(self._poses, self._objects, self._windows, self._changes, stream=stream)
        evolve[len(self._state), self._threads, stream, self._shared_bytes()](
            self._changes, self._poses, self._following, self._objects, *self._tables, self._state, self._polished,
            self._history, self._traces,
        )  # fmt: skip
        self._poses, self._following = self._following, self._poses
        if step.polished:
            self._batch.polish(
                self._poses, self._objects, self._windows, self._directions, self._polished, most=step.polished,
                steps=POLISH_STEPS, gate=POLISH_GATE, stream=stream,
            )  # fmt: skip

    def _lay_out(self, populations: Sequence[Population]) -> None:
        """Particles in places of equal number; what a population has too few of is no particle."""
        poses = np.zeros((len(populations), self._capacity, 3, 4))
        objects = np.full((len(populations), self._capacity), NOTHING)
        for h, population in enumerate(populations):
            poses[h, : len(population.poses)] = population.poses
            objects[h, : len(population.poses)] = h
        flat = poses.reshape(-1, 3, 4)
        self._poses, self._following = put(flat, np.float32), put(flat, np.float32)
        self._objects = put(objects.ravel(), np.int32)
        self._windows = put(np.repeat(np.arange(len(populations)), self._capacity), np.int32)
        self._changes = put(np.zeros(len(flat)), np.float32)

    def _keep_room(self, populations: Sequence[Population]) -> None:
        """For what is kept on the device."""
        count, length = len(populations), max(1, len(self._plan))
        self._sizes = [[len(p.poses), *(step.count for step in self._plan)] for p in populations]
        self._state = put(np.array([[len(p.poses), 0, 0, 0] for p in populations]), np.int32)
        self._polished = put(np.zeros(count), np.int32)
        self._history = put(np.zeros((count, length)), np.float32)
        self._traces = put(np.zeros((count, length, -(-self._capacity // THINNED), 3)), np.float32)


def evaluator(shape: Shape, window: Window, plane: Float32s, form: CostForm) -> Batch:
    """The GPU's costs and polish of one object in one window; both stay on the device as long as this lives."""
    return Batch([shape], [CostInputs(window, plane, form)])


CUDA = Device(evaluator, CudaIterations)


def _tables(
    populations: Sequence[Population],
    batch: Batch,
    plan: Sequence[IterationSettings],
    settings: FilterSettings,
    directions: Any,
) -> list[Any]:
    """What ``evolve`` reads and nobody writes, in its order."""
    flips = [p.proposals.flips for p in populations]
    firsts = np.cumsum([0, *(len(each) for each in flips[:-1])])
    rows = [[h, h, first, len(each)] for h, (first, each) in enumerate(zip(firsts, flips, strict=True))]
    patience = settings.patience if settings.schedule is not None else np.inf
    numbers = [settings.effective, settings.lambda_r or 0.0, settings.elitism, patience, populations[0].proposals.spins]
    return [
        put(np.array(rows), np.int32),
        batch.middles,
        put(np.stack([p.proposals.axes for p in populations]), np.float32),
        put(np.stack([_window(p) for p in populations]), np.float32),
        put(np.concatenate(flips), np.float32),
        directions,
        put(_pools(populations, plan), np.float32),
        put(np.array([[step.metres, step.radians] for step in plan]).reshape(-1, 2), np.float32),
        put(_numbers(plan, elitism=settings.elitism), np.int32),
        put(np.array(numbers, float), np.float32),
        put(np.array([p.rng.integers(2**62) for p in populations]), np.int64),
    ]


def _window(population: Population) -> Floats:
    likelihood = population.likelihood
    window = likelihood.window
    reach = np.minimum(window.reach, 1e6)
    return np.array([*window.view.numbers, *window.box, *reach, likelihood.base, not likelihood.form.plain], float)


def _pools(populations: Sequence[Population], plan: Sequence[IterationSettings]) -> Floats:
    """First guesses for all particles that the phase renews, H x R x 3 x 4."""
    count = max(1, sum(step.renewed for step in plan))
    return np.stack([p.proposals.initial(p.guess, count, p.rng) for p in populations])


def _numbers(plan: Sequence[IterationSettings], *, elitism: bool) -> Any:
    """The whole numbers of the schedule, S x 6."""
    fresh = np.cumsum([0, *(step.renewed for step in plan)])
    return np.array(
        [
            # The best particle takes the last place and stays what it is.
            [s.count, _stride(s.count), s.flipped, s.renewed, first, min(s.polished, s.count - int(elitism))]
            for s, first in zip(plan, fresh[:-1], strict=True)
        ]
    ).reshape(-1, 6)


def _stride(count: int) -> int:
    """The number nearest below the golden section of ``count`` that has no divisor in common with it."""
    stride = max(1, int(_GOLDEN * count))
    while gcd(stride, count) > 1:
        stride -= 1
    return stride
