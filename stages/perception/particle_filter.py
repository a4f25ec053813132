"""Sequential Bayesian filter with Iterated Likelihood Weighting (paper, equations 3 to 10).

Each object of a hypothesis is estimated in turn, the most confident first, with those before it fixed. The state is
NumPy: beside the kernel it costs next to nothing, and every operation here keeps its order of summation whatever the
number of threads, so that equal seeds give equal bytes in any process.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from runner.contract import Refused
from stages.perception.evaluators import Device
from stages.perception.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window, credits
from stages.perception.proposals import Dof, Guess, Proposals, distinct_best
from stages.perception.rasteriser import KERNEL, Float32s
from stages.scene.catalogue import CatalogueObject, Floats

Rectangle = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels, x1 and y1 exclusive."""
_GAIN = 0.002
"""Share of the cost without the object by which another pose must be better to replace an estimate."""

_FRESH = 2
"""New guesses per particle when an object is visited again."""
_LEADERS = 6
"""Poses that are polished to the end."""


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """How one hypothesis is estimated. Every improvement over the paper's plain form can be switched off alone."""

    particles: int = 625
    fine_particles: int | None = 80
    """Particles left at the end: their number falls geometrically with the annealing; None keeps all of them."""
    iterations: int = 400
    """For all objects of a hypothesis together."""
    dof: Dof = 6
    cost: CostForm = field(default_factory=CostForm)
    lambda_r: float | None = None
    """Scale of equation 8 while particles are weighted; None chooses it in each iteration so that the effective
    sample size is ``effective`` of the particles."""
    effective: float = 0.25
    overdraw: int = 4
    """First guesses per particle; 0 draws them uniformly in the box as the paper does."""
    metres: tuple[float, float] = (0.03, 0.001)
    """Diffusion at the first and the last iteration, geometrically annealed."""
    radians: tuple[float, float] = (np.deg2rad(30.0), np.deg2rad(0.7))
    flips: float = 0.06
    """Share of the particles that are flipped about the object's axes, modulo its symmetries."""
    renewed: float = 0.05
    """Share of the particles that are drawn anew."""
    polished: float = 0.06
    """Share of the particles that take Gauss-Newton steps; they survive only if the likelihood agrees."""
    elitism: bool = True
    coarse_pixels: float | None = 36.0
    """Apparent diameter in the first half of the iterations; None looks at full detail all the time."""
    fine_pixels: float = 60.0
    fine_truncation: float | None = 0.015
    """Bound per pixel in the second half, metres; None keeps that of ``cost``."""
    schedule: int | None = 32
    """Iterations that the annealing takes at most; None uses all that the object has."""
    patience: int = 5
    """A half of the schedule ends after so many iterations without progress."""
    sweeps: int = 2
    """Times that objects are visited again once all are known, where something has changed since or they fit badly."""
    poor: float = 0.005
    """Mean distance from which a fit is bad, metres."""
    joint: bool = True
    """All objects of the winning scene are polished together."""
    contact: bool = True
    """Objects that reach into one another, or that nothing supports, cost something."""
    colour: bool = True
    """Colour decides between poses that depth cannot tell apart."""
    device: Device = "cpu"
    """Where the filter's particles are weighed; polish runs on the CPU in either case."""

    def without(self, *improvements: str) -> FilterSettings:
        """These settings with improvements over the paper's plain form switched off, each by its name.

        Raises:
            Refused: there is no improvement of that name; names those that there are.
        """
        settings = self
        for name in improvements:
            if name not in IMPROVEMENTS:
                raise Refused(f"'{name}' is no improvement that can be switched off; choose {', '.join(IMPROVEMENTS)}")
            changes = dict(IMPROVEMENTS[name])
            form = replace(settings.cost, **changes.pop("cost", {}))
            settings = replace(settings, cost=form, **changes)
        return settings

    def count(self, progress: float) -> int:
        """Particles at a progress of the annealing between 0 and 1."""
        if self.fine_particles is None:
            return self.particles
        return round(self.particles ** (1 - progress) * min(self.fine_particles, self.particles) ** progress)

    @staticmethod
    def paper(*, particles: int = 625, iterations: int = 400, dof: Dof = 6) -> FilterSettings:
        """The paper's plain form: every improvement is switched off."""
        return FilterSettings(particles=particles, iterations=iterations, dof=dof).without(*IMPROVEMENTS)


_TURN = np.deg2rad(10.0)
IMPROVEMENTS: dict[str, dict[str, Any]] = {
    "bounded likelihood": {"cost": {"truncation": 100.0, "plain": True}, "fine_truncation": None},
    "occlusion": {"cost": {"occluder_margin": 100.0, "occluder_cost": 0.0}},
    "annealing": {"metres": (0.01, 0.01), "radians": (_TURN, _TURN)},
    "adaptive scale": {"lambda_r": 1.0},
    "flips": {"flips": 0.0},
    "coarse to fine": {"coarse_pixels": None},
    "truncation": {"fine_truncation": None},
    "re-initialisation": {"renewed": 0.0},
    "elitism": {"elitism": False},
    "joint refinement": {"sweeps": 0, "joint": False},
    "polish": {"polished": 0.0},
    "contact": {"cost": {"contact_slack": 100.0}, "contact": False},
    "overdraw": {"overdraw": 0},
    "early stop": {"schedule": None},
    "tapering": {"fine_particles": None},
    "colour": {"colour": False},
}
"""What each improvement over the paper's plain form sets when it is switched off; ``cost`` are fields of CostForm."""


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
    start: float
    """Progress of the annealing, 0 to 1, at the first and after the last iteration."""
    end: float
    iterations: int


class ObjectFilter:
    """Estimates the pose of one catalogue object in a box of a scene."""

    def __init__(self, item: CatalogueObject, settings: FilterSettings) -> None:
        self.settings = settings
        self.proposals = Proposals(item, settings.dof)
        self.coarse = Shape.of(item.simplified(300))
        self.fine = Shape.of(item.simplified(500))

    def run(
        self, scene: ObservedScene, background: Float32s, box: Rectangle, *, iterations: int, rng: np.random.Generator
    ) -> Track:
        """Filters from first guesses; ``background`` is the inverse depth of the plane and the objects before."""
        guess = self._guess(scene, background, box)
        coarse, fine = self._phases(scene, background, box, guess, iterations)
        population = _Population(self, guess, rng)
        poses = population.begin(coarse)
        for phase in (coarse, fine):
            poses = population.evolve(poses, phase)
        return population.finish(poses, coarse, fine)

    def revisit(
        self, scene: ObservedScene, background: Float32s, box: Rectangle, track: Track, *, rng: np.random.Generator
    ) -> Track:
        """Looks again around a track's pose and its flips, now that ``background`` holds all other objects.

        Returns the track itself where nothing is clearly better.
        """
        guess = self._guess(scene, background, box)
        coarse, fine = self._phases(scene, background, box, guess, 1)
        population = _Population(self, guess, rng)
        found = population.finish(population.around(track.T_camera_object, coarse), coarse, fine)
        before = float(fine.likelihood.energies(track.T_camera_object[None])[0])
        if found.cost > before - _GAIN * abs(fine.likelihood.base):
            return track
        return replace(track, T_camera_object=found.T_camera_object, cost=found.cost)

    def _guess(self, scene: ObservedScene, background: Float32s, box: Rectangle) -> Guess:
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

    def _phases(
        self, scene: ObservedScene, background: Float32s, box: Rectangle, guess: Guess, iterations: int
    ) -> tuple[_Phase, _Phase]:
        settings = self.settings
        count = min(iterations, settings.schedule or iterations)
        apparent = self.fine.diameter / float(np.median(guess.points[:, 2])) * scene.view.fx
        region = _expanded(box, 0.5 * apparent, scene)
        sharp = settings.cost if settings.fine_truncation is None else settings.cost.truncated(settings.fine_truncation)
        directions = self.proposals.directions(scene.T_camera_table)

        def likelihood(shape: Shape, detail: float, form: CostForm) -> ObjectLikelihood:
            stride = max(1, int(apparent / detail))
            window = Window.of(scene, background, box, region, stride=stride, form=form)
            return ObjectLikelihood(shape, window, scene, form, device=settings.device)

        rough = self.coarse if settings.coarse_pixels else self.fine
        first = likelihood(rough, settings.coarse_pixels or settings.fine_pixels, settings.cost)
        second = likelihood(self.fine, settings.fine_pixels, sharp)
        half = count // 2
        return _Phase(first, directions, 0.0, 0.5, count - half), _Phase(second, directions, 0.5, 1.0, half)


class _Population:
    """The particles of one object as they evolve."""

    def __init__(self, owner: ObjectFilter, guess: Guess, rng: np.random.Generator) -> None:
        self._settings = owner.settings
        self._proposals = owner.proposals
        self._guess = guess
        self._rng = rng
        self._iteration = 0
        self._kept: list[tuple[int, float, Floats]] = []

    def begin(self, phase: _Phase) -> Floats:
        """First generation: the better ones of many guesses, or the paper's uniform ones."""
        settings = self._settings
        if not settings.overdraw:
            return self._proposals.uniform(self._guess, settings.particles, self._rng)
        poses = self._proposals.initial(self._guess, settings.overdraw * settings.particles, self._rng)
        costs = phase.likelihood.energies(poses)
        chosen = self._resampled(costs, settings.particles)
        return self._polished(poses[chosen], phase, int(2 * settings.polished * settings.particles), gate=0.04)

    def evolve(self, poses: Floats, phase: _Phase) -> Floats:
        """Weights, resamples and diffuses until the phase ends; returns the last generation, the best one first."""
        best, stale = np.inf, 0
        for i in range(phase.iterations):
            costs = phase.likelihood.energies(poses)
            champion = int(np.argmin(costs))
            self._keep(poses, float(costs[champion]))
            improved = costs[champion] < 0.995 * best
            best, stale = min(best, float(costs[champion])), 0 if improved else stale + 1
            explains = best < phase.likelihood.base
            settled = explains and stale >= self._settings.patience and self._settings.schedule is not None
            progress = phase.start + (phase.end - phase.start) * (i / phase.iterations)
            poses = self._next(poses, costs, poses[champion], phase, progress)
            if settled:
                break
        return poses

    def around(self, pose: Floats, phase: _Phase) -> Floats:
        """A small generation about a known pose: the best of its surroundings and of new guesses, polished too."""
        near = np.repeat(pose[None], self._settings.particles // 8, 0)
        near = self._proposals.diffuse(near, phase.directions, metres=0.008, radians=np.deg2rad(15.0), rng=self._rng)
        fresh = self._proposals.initial(self._guess, _FRESH * self._settings.particles, self._rng)
        poses = np.concatenate([pose[None], near, fresh])
        cheap = distinct_best(poses, phase.likelihood.energies(poses), 40, metres=0.006, radians=np.deg2rad(10.0))
        nearby = np.concatenate([pose[None], poses[cheap]])
        if not self._settings.polished:
            return nearby
        return np.concatenate([nearby, phase.likelihood.refine(poses[cheap], phase.directions, steps=4, gate=0.03)])

    def finish(self, poses: Floats, coarse: _Phase, phase: _Phase) -> Track:
        """The particle of least cost (equation 10), after polish where that lowers its cost further."""
        costs = phase.likelihood.energies(poses)
        if self._settings.polished:
            poses = self._leaders(poses, costs, coarse, phase)
            costs = phase.likelihood.energies(poses)
        champion = int(np.argmin(costs))
        self._keep(poses, float(costs[champion]))
        return self._track(poses[champion], float(costs[champion]))

    def _leaders(self, poses: Floats, costs: Floats, coarse: _Phase, fine: _Phase) -> Floats:
        """The best of the distinct poses and of all flips of the first, before and after polish; polish sorts them out
        where pixels are few, and takes the few that remain to the end."""
        best = poses[distinct_best(poses, costs, 12, metres=0.01, radians=np.deg2rad(10.0))]
        flips = self._proposals.all_flips(best[0], self._guess.T_camera_table)[1:]
        rough = coarse.likelihood.refine(np.concatenate([best, flips]), coarse.directions, steps=5, gate=0.03)
        leaders = np.concatenate([best, rough])
        costs = fine.likelihood.energies(leaders)
        few = leaders[distinct_best(leaders, costs, _LEADERS, metres=0.003, radians=np.deg2rad(4.0))]
        return np.concatenate([few, fine.likelihood.refine(few, fine.directions, steps=6, gate=0.03)])

    def _next(self, poses: Floats, costs: Floats, champion: Floats, phase: _Phase, progress: float) -> Floats:
        """Resampling and transition: equation 5, then the improvements that are switched on."""
        settings, rng, count = self._settings, self._rng, self._settings.count(progress)
        metres = settings.metres[0] ** (1 - progress) * settings.metres[1] ** progress
        radians = settings.radians[0] ** (1 - progress) * settings.radians[1] ** progress
        chosen = poses[self._resampled(costs, count)]
        following = self._proposals.diffuse(chosen, phase.directions, metres=metres, radians=radians, rng=rng)
        following = following[rng.permutation(count)]
        flipped, renewed = int(settings.flips * count), int(settings.renewed * (1 - progress) * count)
        if flipped:
            following[:flipped] = self._proposals.flipped(following[:flipped], self._guess.T_camera_table, rng)
        if renewed:
            following[-renewed:] = self._proposals.initial(self._guess, renewed, rng)
        following = self._polished(following, phase, flipped + int(settings.polished * count), gate=0.03)
        if settings.elitism:
            following[-1] = champion
        return following

    def _polished(self, poses: Floats, phase: _Phase, count: int, *, gate: float) -> Floats:
        if self._settings.polished and count:
            poses[:count] = phase.likelihood.refine(poses[:count], phase.directions, steps=2, gate=gate)
        return poses

    def _resampled(self, costs: Floats, count: int) -> NDArray[np.intp]:
        """Systematic resampling by the weights of equations 7 and 8."""
        weights = _weights(costs, self._settings, count)
        positions = (self._rng.random() + np.arange(count)) / count
        return np.minimum(np.searchsorted(np.cumsum(weights), positions), len(costs) - 1)

    def _keep(self, poses: Floats, cost: float) -> None:
        if self._iteration % 4 == 0:
            self._kept.append((self._iteration, cost, poses[::25, :, 3].copy()))
        self._iteration += 1

    def _track(self, pose: Floats, cost: float) -> Track:
        rows = [np.column_stack([np.full(len(p), float(i)), p]) for i, _, p in self._kept]
        iterations, costs, _ = zip(*self._kept, strict=True) if self._kept else ((), (), ())
        positions = np.concatenate(rows) if rows else np.zeros((0, 4))
        return Track(pose, cost, tuple(iterations), tuple(costs), positions)


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
