"""How populations go through a phase of the schedule, on whichever device: its iterations, and how the CPU does them.

``Iterations`` is the narrow place between the filter and a device. The schedule, the windows, first guesses and the
last polish are the same on both sides of it; random numbers and rounding are each device's own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.perception.filter.likelihood import CpuEvaluator, MakeEvaluator, ObjectLikelihood
from stages.perception.filter.proposals import Guess, Proposals
from stages.perception.filter.settings import FilterSettings
from stages.perception.rendering.rasteriser import KERNEL

POLISH_STEPS, POLISH_GATE = 2, 0.03
"""Gauss-Newton steps within an iteration, and the distance in metres from which readings take no part in them."""
PROGRESS = 0.995
"""Share of the best cost so far that counts as progress when it is undercut."""
THINNED = 25
"""One in so many particles is kept for views."""
_CHECKED = 4
"""Iterations between looks at whether all populations have settled: on a GPU each look waits for the device."""


@dataclass(frozen=True, slots=True)
class IterationSettings:
    """What one iteration makes of a generation."""

    count: int
    """Particles of the next generation."""
    metres: float
    radians: float
    """Standard deviations of the diffusion."""
    flipped: int
    """The first so many particles are flipped, the last ``renewed`` drawn anew, the first ``polished`` polished."""
    renewed: int
    polished: int


def steps(settings: FilterSettings, start: float, end: float, iterations: int) -> tuple[IterationSettings, ...]:
    """The iterations of a phase in which the annealing goes from ``start`` to ``end``, both between 0 and 1."""
    return tuple(_step(settings, start + (end - start) * (i / iterations)) for i in range(iterations))


def _step(settings: FilterSettings, progress: float) -> IterationSettings:
    count = settings.count(progress)
    flipped = int(settings.flips * count)
    return IterationSettings(
        count,
        settings.metres[0] ** (1 - progress) * settings.metres[1] ** progress,
        settings.radians[0] ** (1 - progress) * settings.radians[1] ** progress,
        flipped,
        int(settings.renewed * (1 - progress) * count),
        flipped + int(settings.polished * count) if settings.polished else 0,
    )


@dataclass(frozen=True)
class Population:
    """The particles of one object, and what their successors come from."""

    poses: Floats
    """First generation, N x 3 x 4."""
    likelihood: ObjectLikelihood
    directions: Floats
    """Twists the object may make, 6 x D."""
    proposals: Proposals
    guess: Guess
    rng: np.random.Generator


@dataclass(frozen=True)
class Generation:
    """What is kept of an iteration."""

    cost: float
    """The least, metres times pixels."""
    positions: Floats
    """Some particles, n x 3, camera frame."""


class Iterations(Protocol):
    """Populations on their way through one phase."""

    def iterate(self, count: int) -> bool:
        """Does up to ``count`` more iterations; returns whether any population has some left."""
        ...

    def best(self) -> list[float]:
        """The least cost of each population so far."""
        ...

    def population(self) -> list[Floats]:
        """The last generation of each population, N x 3 x 4; where elitism is on its last particle is the best of the
        generation before."""
        ...

    def history(self) -> list[list[Generation]]:
        """Of each population what is kept of its iterations."""
        ...


@dataclass(frozen=True)
class Device:
    """Where particles are weighed, resampled, moved and polished."""

    evaluator: MakeEvaluator
    iterations: Callable[[Sequence[Population], Sequence[IterationSettings], FilterSettings], Iterations]


def iterated(
    populations: Sequence[Population], plan: Sequence[IterationSettings], settings: FilterSettings, device: Device
) -> Iterations:
    """All populations after the phase; each ends as it would alone, on a GPU they go together."""
    # A schedule of one iteration has no second half: nothing to send to a device.
    iterations = (device if plan else CPU).iterations(populations, plan, settings)
    while iterations.iterate(_CHECKED):
        pass
    return iterations


class HostIterations:
    """Iterations on the CPU, one population after the other."""

    def __init__(
        self, populations: Sequence[Population], plan: Sequence[IterationSettings], settings: FilterSettings
    ) -> None:
        self._each = [_Course(population, plan, settings) for population in populations]

    def iterate(self, count: int) -> bool:
        """As in :class:`Iterations`."""
        left = [each.iterate(count) for each in self._each]
        return any(left)

    def best(self) -> list[float]:
        """As in :class:`Iterations`."""
        return [each.best for each in self._each]

    def population(self) -> list[Floats]:
        """As in :class:`Iterations`."""
        return [each.poses for each in self._each]

    def history(self) -> list[list[Generation]]:
        """As in :class:`Iterations`."""
        return [each.history for each in self._each]


CPU = Device(CpuEvaluator, HostIterations)


class _Course:
    """One population on the CPU."""

    def __init__(self, population: Population, plan: Sequence[IterationSettings], settings: FilterSettings) -> None:
        self._population = population
        self._settings = settings
        self._left = list(plan)
        self._stale = 0
        self.poses = population.poses
        self.best = np.inf
        self.history: list[Generation] = []

    def iterate(self, count: int) -> bool:
        for _ in range(min(count, len(self._left))):
            self._advance(self._left.pop(0))
            if self._settled():
                self._left.clear()
                break
        return bool(self._left)

    def _advance(self, step: IterationSettings) -> None:
        costs = self._population.likelihood.energies(self.poses)
        champion = int(np.argmin(costs))
        least = float(costs[champion])
        self.history.append(Generation(least, self.poses[::THINNED, :, 3].copy()))
        self._stale = 0 if least < PROGRESS * self.best else self._stale + 1
        self.best = min(self.best, least)
        self.poses = self._next(costs, self.poses[champion], step)

    def _settled(self) -> bool:
        explains = self.best < self._population.likelihood.base
        return explains and self._stale >= self._settings.patience and self._settings.schedule is not None

    def _next(self, costs: Floats, champion: Floats, step: IterationSettings) -> Floats:
        """Resampling and transition: equation 5, then the improvements that are switched on."""
        given, rng = self._population, self._population.rng
        proposals, T_camera_table = given.proposals, given.guess.T_camera_table
        chosen = self.poses[resampled(costs, self._settings, step.count, rng)]
        following = proposals.diffuse(chosen, given.directions, metres=step.metres, radians=step.radians, rng=rng)
        following = following[rng.permutation(step.count)]
        if step.flipped:
            following[: step.flipped] = proposals.flipped(following[: step.flipped], T_camera_table, rng)
        if step.renewed:
            following[-step.renewed :] = proposals.initial(given.guess, step.renewed, rng)
        if step.polished:
            following[: step.polished] = given.likelihood.refine(
                following[: step.polished], given.directions, steps=POLISH_STEPS, gate=POLISH_GATE
            )
        if self._settings.elitism:
            following[-1] = champion
        return following


def resampled(costs: Floats, settings: FilterSettings, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Systematic resampling by the weights of equations 7 and 8: indices of ``count`` particles."""
    weights = _weights(costs, settings, count)
    positions = (rng.random() + np.arange(count)) / count
    return np.minimum(np.searchsorted(np.cumsum(weights), positions), len(costs) - 1)


def _weights(costs: Floats, settings: FilterSettings, count: int) -> Floats:
    """Normalised weights exp(-lambda_r d); the scale is found by bisection where none is given."""
    excess = costs - costs.min()
    if settings.lambda_r is not None:
        return _normalised(np.exp(-settings.lambda_r * excess))
    return _normalised(np.exp(-_scale(excess, settings.effective * count) * excess))


@numba.njit(**KERNEL)
def _scale(excess, effective):  # pyright: ignore[reportMissingParameterType]
    """The scale at which as many of the weights exp(-scale excess) count: bisection of its logarithm."""
    low, high = -12.0, 12.0
    for _ in range(24):
        middle = (low + high) / 2
        scale, total, squares = np.exp(middle), 0.0, 0.0
        for i in range(excess.shape[0]):
            weight = np.exp(-scale * excess[i])
            total += weight
            squares += weight * weight
        if total * total > effective * squares:
            low = middle
        else:
            high = middle
    return np.exp(low)


def _normalised(weights: Floats) -> Floats:
    return weights / weights.sum()
