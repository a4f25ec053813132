"""Hypotheses in, one posterior each: the sequential particle filter over the objects of a hypothesised scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from runner.contract import Context, Refused, Stage
from stages.messages import Candidate, Hypothesis, ObjectPose, Observation, Posterior
from stages.messages.digest import ParticleTrace
from stages.perception.evaluators import DEVICES, chosen_device
from stages.perception.likelihood import ObservedScene
from stages.perception.particle_filter import FilterSettings, Track
from stages.perception.poses import pose
from stages.perception.scene_filter import Found, SceneFilter, Suspect
from stages.scene.catalogue import Catalogue
from stages.scene.naming import unique_names


class ParticleFilter(Stage):
    """Equations 3 to 10 for one hypothesis at a time."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings."""

        catalogue: str
        """A catalogue's YAML file, or a BOP ``models`` folder."""
        form: Literal["default", "paper"] = "default"
        """``paper`` is the plain form of the paper: fixed diffusion, fixed scale, unbounded distances."""
        particles: int = 625
        iterations: int = 400
        """Cap for all objects of a hypothesis together; the default form stops earlier where it has converged."""
        dof: Literal[3, 6] = 6
        """3: upright objects on the support plane (x, y, yaw). 6: any pose."""
        lambda_r: float = 1.0
        """Scale of equation 8 in the weights by which hypotheses are ranked, per metre and pixel."""
        seed: int = 0
        without: tuple[str, ...] = ()
        """Improvements over the paper's plain form that are switched off, each by its name."""
        device: Literal["auto", "cpu", "cuda"] = "cpu"
        """What weighs the particles. ``auto`` takes a GPU where there is one; its costs differ in the last bits."""

        def __post_init__(self) -> None:
            if self.form not in ("default", "paper"):
                raise Refused(f"particle_filter.form is '{self.form}'; choose default or paper")
            if self.device not in DEVICES:
                raise Refused(f"particle_filter.device is '{self.device}'; choose auto, cpu or cuda")
            if self.dof not in (3, 6):
                raise Refused(f"particle_filter.dof is {self.dof}; choose 3 or 6")
            for name, least in (("particles", 25), ("iterations", 1)):
                if getattr(self, name) < least:
                    raise Refused(f"particle_filter.{name} is {getattr(self, name)}; it must be at least {least}")
            if self.lambda_r <= 0:
                raise Refused(f"particle_filter.lambda_r is {self.lambda_r}; it must be above 0")

    def __init__(self, config: Config) -> None:
        self.config = config
        make = FilterSettings.paper if config.form == "paper" else FilterSettings
        settings = make(particles=config.particles, iterations=config.iterations, dof=config.dof).without(
            *config.without
        )
        settings = replace(settings, device=chosen_device(config.device, place="particle_filter.device"))
        self._filter = SceneFilter(Catalogue.load(Path(config.catalogue)), settings, seed=config.seed)
        self._filter.warm_up()

    def on_hypothesis(self, hypothesis: Hypothesis, observation: Observation, ctx: Context) -> Posterior:
        """The most likely scene of the hypothesis and its unnormalised weight."""
        scene = ObservedScene.of(observation.depth, observation.foreground, observation.K, observation.T_camera_table)
        candidates = hypothesis.candidates
        result = self._filter.estimate(scene, [Suspect(c.label, c.box) for c in candidates])
        names = unique_names([candidate.label for candidate in candidates])
        ctx.log(f"hypothesis {hypothesis.index + 1} of {hypothesis.count}: cost {result.cost:.1f}")
        return Posterior(
            index=hypothesis.index,
            count=hypothesis.count,
            objects=tuple(_object(*each) for each in zip(names, candidates, result.objects, strict=True)),
            log_weight=-self.config.lambda_r * result.cost,
            traces=tuple(_trace(found.track) for found in result.objects),
            left_out=hypothesis.left_out,
        )


def _object(name: str, candidate: Candidate, found: Found) -> ObjectPose:
    T = found.track.T_camera_object
    return ObjectPose(
        name=name,
        label=candidate.label,
        T_camera_object=pose(T[:, :3], T[:, 3]),
        confidence=candidate.confidence,
        cost=found.cost,
        box=candidate.box,
        visible=found.visible,
    )


def _trace(track: Track) -> ParticleTrace:
    return ParticleTrace(iterations=track.iterations, costs=np.array(track.costs, float), positions=track.positions)
