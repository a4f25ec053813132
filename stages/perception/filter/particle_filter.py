"""Sequential Bayesian filter with Iterated Likelihood Weighting (paper, equations 3 to 10).

Each object of a hypothesis is estimated in turn, the most confident first, with those before it fixed. The state is
NumPy: beside the kernel it costs next to nothing, and every operation here keeps its order of summation whatever the
number of threads, so that equal seeds give equal bytes in any process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stages.geometry.arrays import Floats
from stages.perception.filter.iterations import (
    CPU,
    PROGRESS,
    THINNED,
    Device,
    Generation,
    IterationSettings,
    Population,
    iterated,
    resampled,
    steps,
)
from stages.perception.filter.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window, credits
from stages.perception.filter.proposals import Guess, Proposals, distinct_best
from stages.perception.filter.settings import FilterSettings
from stages.perception.rendering.rasteriser import Float32s
from stages.scene.catalogue import CatalogueObject

Rectangle = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels, x1 and y1 exclusive."""
_GAIN = 0.002
"""Share of the cost without the object by which another pose must be better to replace an estimate."""

_FRESH = 2
"""New guesses per particle when an object is visited again."""
_LEADERS = 6
"""Poses that are polished to the end."""
_STEPS = 0.004, 0.002, 0.001
"""Metres by which the best pose is moved at last, and its outermost points by turns."""
_MOVES = 6
"""Moves of one size at most."""


@dataclass(frozen=True)
class Track:
    """What the filter of one object found."""

    T_camera_object: Floats
    """3 x 4."""
    cost: float
    """d(R, O) of the window, metres times pixels."""
    iterations: tuple[int, ...]
    costs: tuple[float, ...]
    """Best cost per kept iteration."""
    positions: Floats
    """Rows ``[iteration, x, y, z]`` of thinned particles of the kept iterations."""


@dataclass(frozen=True)
class _Phase:
    """A part of the schedule that keeps its window and its bound."""

    likelihood: ObjectLikelihood
    directions: Floats
    steps: tuple[IterationSettings, ...]


@dataclass(frozen=True)
class Task:
    """An object that is to be estimated from first guesses."""

    filter: ObjectFilter
    background: Float32s
    """H x W inverse depth of the plane and the objects before."""
    box: Rectangle
    rng: np.random.Generator


def run_together(scene: ObservedScene, tasks: Sequence[Task], *, iterations: int) -> list[Track]:
    """Filters of one scene side by side, each with so many iterations; each ends as it would alone.

    The filters have the same settings and device. On a GPU all their populations are one batch.
    """
    runs = [_Run(task, scene, iterations) for task in tasks]
    for number in range(2):
        _evolve(runs, number)
    return [run.finish() for run in runs]


class ObjectFilter:
    """Estimates the pose of one catalogue object in a box of a scene."""

    def __init__(self, item: CatalogueObject, settings: FilterSettings, *, device: Device = CPU) -> None:
        self.settings = settings
        self.device = device
        self.proposals = Proposals.of(item, settings.dof)
        self.coarse = Shape.of(item.simplified(300))
        self.fine = Shape.of(item.simplified(500))

    def run(
        self, scene: ObservedScene, background: Float32s, box: Rectangle, *, iterations: int, rng: np.random.Generator
    ) -> Track:
        """Filters from first guesses; ``background`` is the inverse depth of the plane and the objects before."""
        return run_together(scene, [Task(self, background, box, rng)], iterations=iterations)[0]

    def revisit(
        self, scene: ObservedScene, background: Float32s, box: Rectangle, track: Track, *, rng: np.random.Generator
    ) -> Track:
        """Looks again around a track's pose and its flips, now that ``background`` holds all other objects.

        Returns the track itself where nothing is clearly better.
        """
        run = _Run(Task(self, background, box, rng), scene, 1)
        run.around(track.T_camera_object)
        found, fine = run.finish(), run.phases[1].likelihood
        before = float(fine.energies(track.T_camera_object[None])[0])
        if found.cost > before - _GAIN * abs(fine.base):
            return track
        return replace(track, T_camera_object=found.T_camera_object, cost=found.cost)

    def guess(self, scene: ObservedScene, background: Float32s, box: Rectangle) -> Guess:
        """Readings in the box that the background leaves unexplained, or failing those any foreground, any reading,
        the plane itself."""
        part = np.s_[box[1] : box[3], box[0] : box[2]]
        rays = scene.view.rays()[part]
        depth = scene.depth[part]
        open_questions = credits(scene, background, self.settings.cost, part) > 0.006
        for chosen in (open_questions & scene.foreground[part], scene.foreground[part], depth > 0):
            if chosen.sum() >= 12:
                return Guess(rays[chosen] * depth[chosen, None], scene.T_camera_table)
        inverse = np.maximum(scene.plane_inverse[part], 1e-1)
        return Guess((rays / inverse[..., None]).reshape(-1, 3), scene.T_camera_table)

    def phases(
        self, scene: ObservedScene, background: Float32s, box: Rectangle, guess: Guess, iterations: int
    ) -> tuple[_Phase, _Phase]:
        """The coarse half of the schedule and the fine one."""
        settings = self.settings
        count = min(iterations, settings.schedule or iterations)
        apparent = self.fine.diameter / float(np.median(guess.points[:, 2])) * scene.view.fx
        region = _expanded(box, 0.5 * apparent, scene)
        sharp = settings.cost if settings.fine_truncation is None else settings.cost.truncated(settings.fine_truncation)
        directions = self.proposals.directions(scene.T_camera_table)

        def likelihood(shape: Shape, detail: float, form: CostForm) -> ObjectLikelihood:
            stride = max(1, int(apparent / detail))
            window = Window.of(scene, background, box, region, stride=stride, form=form)
            return ObjectLikelihood(shape, window, scene, form, evaluator=self.device.evaluator)

        rough = self.coarse if settings.coarse_pixels else self.fine
        first = likelihood(rough, settings.coarse_pixels or settings.fine_pixels, settings.cost)
        second = likelihood(self.fine, settings.fine_pixels, sharp)
        half = count // 2
        return (
            _Phase(first, directions, steps(settings, 0.0, 0.5, count - half)),
            _Phase(second, directions, steps(settings, 0.5, 1.0, half)),
        )


class _Run:
    """The particles of one object from first guesses, or from a known pose, to the best one."""

    def __init__(self, task: Task, scene: ObservedScene, iterations: int) -> None:
        owner, self._rng = task.filter, task.rng
        self.device = owner.device
        self._settings, self._proposals = owner.settings, owner.proposals
        self._guess = owner.guess(scene, task.background, task.box)
        self.phases = owner.phases(scene, task.background, task.box, self._guess, iterations)
        self._poses = np.zeros((0, 3, 4))
        self._iteration = 0
        self._kept: list[tuple[int, Generation]] = []

    @property
    def settings(self) -> FilterSettings:
        """Those of the object's filter."""
        return self._settings

    def begin(self) -> None:
        """First generation: the better ones of many guesses, or the paper's uniform ones."""
        settings = self._settings
        if not settings.overdraw:
            self._poses = self._proposals.uniform(self._guess, settings.particles, self._rng)
            return
        poses = self._proposals.initial(self._guess, settings.overdraw * settings.particles, self._rng)
        costs = self.phases[0].likelihood.energies(poses)
        self._poses = poses[resampled(costs, settings, settings.particles, self._rng)]
        few = int(2 * settings.polished * settings.particles)
        if few:
            phase = self.phases[0]
            self._poses[:few] = phase.likelihood.refine(self._poses[:few], phase.directions, steps=2, gate=0.04)

    def population(self, number: int) -> Population:
        """The present generation, ready for a phase."""
        phase = self.phases[number]
        return Population(self._poses, phase.likelihood, phase.directions, self._proposals, self._guess, self._rng)

    def went(self, poses: Floats, history: Sequence[Generation]) -> None:
        """Takes over what came out of a phase."""
        self._poses = poses
        for generation in history:
            self._keep(generation)

    def around(self, pose: Floats) -> None:
        """A small generation about a known pose: the best of its surroundings and of new guesses, polished too."""
        phase = self.phases[0]
        near = np.repeat(pose[None], self._settings.particles // 8, 0)
        near = self._proposals.diffuse(near, phase.directions, metres=0.008, radians=np.deg2rad(15.0), rng=self._rng)
        fresh = self._proposals.initial(self._guess, _FRESH * self._settings.particles, self._rng)
        poses = np.concatenate([pose[None], near, fresh])
        cheap = distinct_best(poses, phase.likelihood.energies(poses), 40, metres=0.006, radians=np.deg2rad(10.0))
        self._poses = np.concatenate([pose[None], poses[cheap]])
        if self._settings.polished:
            polished = phase.likelihood.refine(poses[cheap], phase.directions, steps=4, gate=0.03)
            self._poses = np.concatenate([self._poses, polished])

    def finish(self) -> Track:
        """The particle of least cost (equation 10), after polish where that lowers its cost further."""
        poses, likelihood = self._poses, self.phases[1].likelihood
        costs = likelihood.energies(poses)
        if self._settings.polished:
            poses = self._leaders(poses, costs)
            costs = likelihood.energies(poses)
        champion = int(np.argmin(costs))
        self._keep(Generation(float(costs[champion]), poses[::THINNED, :, 3].copy()))
        pose, cost = poses[champion], float(costs[champion])
        return self._track(*(self._searched(pose, cost) if self._settings.polished else (pose, cost)))

    def _searched(self, pose: Floats, cost: float) -> tuple[Floats, float]:
        """Pattern search (Hooke and Jeeves, 1961) along and about the object's own axes, with ever smaller steps.

        Gauss-Newton steps read distances on smooth faces; this moves rims and silhouettes to where they are seen.
        """
        fine = self.phases[1]
        radius = fine.likelihood.shape.diameter / 2
        for step in _STEPS:
            for _ in range(_MOVES):
                twists = self._proposals.own_directions(pose, fine.directions) * step
                twists[:3] /= radius
                both = np.concatenate([twists.T, -twists.T])
                around = self._proposals.moved(np.repeat(pose[None], len(both), 0), both)
                costs = fine.likelihood.energies(around)
                best = int(np.argmin(costs))
                if costs[best] >= PROGRESS * cost:
                    break
                pose, cost = around[best], float(costs[best])
        return pose, cost

    def _leaders(self, poses: Floats, costs: Floats) -> Floats:
        """The best of the distinct poses and of all flips of the first, before and after polish; polish sorts them out
        where pixels are few, and takes the few that remain to the end."""
        coarse, fine = self.phases
        best = poses[distinct_best(poses, costs, 12, metres=0.01, radians=np.deg2rad(10.0))]
        flips = self._proposals.all_flips(best[0], self._guess.T_camera_table)[1:]
        rough = coarse.likelihood.refine(np.concatenate([best, flips]), coarse.directions, steps=5, gate=0.03)
        leaders = np.concatenate([best, rough])
        costs = fine.likelihood.energies(leaders)
        few = leaders[distinct_best(leaders, costs, _LEADERS, metres=0.003, radians=np.deg2rad(4.0))]
        return np.concatenate([few, fine.likelihood.refine(few, fine.directions, steps=6, gate=0.03)])

    def _keep(self, generation: Generation) -> None:
        if self._iteration % 4 == 0:
            self._kept.append((self._iteration, generation))
        self._iteration += 1

    def _track(self, pose: Floats, cost: float) -> Track:
        rows = [np.column_stack([np.full(len(g.positions), float(i)), g.positions]) for i, g in self._kept]
        costs = tuple(generation.cost for _, generation in self._kept)
        positions = np.concatenate(rows) if rows else np.zeros((0, 4))
        return Track(pose, cost, tuple(i for i, _ in self._kept), costs, positions)


def _evolve(runs: Sequence[_Run], number: int) -> None:
    """Takes all runs through a phase of the schedule, which they share."""
    if number == 0:
        for run in runs:
            run.begin()
    plan, settings = runs[0].phases[number].steps, runs[0].settings
    iterations = iterated([run.population(number) for run in runs], plan, settings, runs[0].device)
    for run, poses, history in zip(runs, iterations.population(), iterations.history(), strict=True):
        run.went(poses, history)


def _expanded(box: Rectangle, margin: float, scene: ObservedScene) -> Rectangle:
    x0, y0, x1, y1 = box
    m = int(np.ceil(margin))
    return max(0, x0 - m), max(0, y0 - m), min(scene.view.width, x1 + m), min(scene.view.height, y1 + m)


def pixels(box: Floats, scene: ObservedScene, *, margin: float = 0.06) -> Rectangle:
    """A candidate's box, grown by ``margin`` of its size, in whole pixels inside the image; never empty."""
    x0, y0, x1, y1 = box
    dx, dy = margin * (x1 - x0) + 1, margin * (y1 - y0) + 1
    left = int(np.clip(np.floor(x0 - dx), 0, scene.view.width - 2))
    top = int(np.clip(np.floor(y0 - dy), 0, scene.view.height - 2))
    right = int(np.clip(np.ceil(x1 + dx), left + 2, scene.view.width))
    bottom = int(np.clip(np.ceil(y1 + dy), top + 2, scene.view.height))
    return left, top, right, bottom
