"""How one hypothesis is estimated: the filter's settings, and what each improvement over the paper's form sets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from runner.contract import Refused
from stages.perception.filter.likelihood import CostForm
from stages.perception.filter.proposals import Dof


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
    """Apparent diameter in the second half."""
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
    "resolution": {"fine_pixels": np.inf},
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
