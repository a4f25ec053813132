"""Hypotheses in, one posterior each: the sequential particle filter over the objects of a hypothesised scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from runner.contract import Context, Refused, Stage
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.messages import Candidate, Hypothesis, ObjectPose, Observation, Posterior
from stages.messages.digest import LoneCandidate, LoneEstimate, LonePose, ParticleTrace, Search
from stages.perception.cuda.device import DEVICES, chosen_device
from stages.perception.filter.likelihood import ObservedScene
from stages.perception.filter.particle_filter import Track
from stages.perception.filter.settings import FilterSettings
from stages.perception.hypotheses.composition import charge
from stages.perception.hypotheses.scene_filter import Found, SceneFilter, Suspect
from stages.perception.hypotheses.suggestions import Suggestions
from stages.scene.catalogue import Catalogue
from stages.scene.naming import unique_names


class ParticleFilter(Stage):
    """Equations 3 to 10 for one hypothesis at a time."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings."""

        catalogue: Path
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
        """Where an object's filter runs. ``auto`` takes a GPU where there is one; its random numbers are its own."""

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

    @classmethod
    def prepare(cls, config: Config) -> None:
        """Lays out the objects and loads the kernels; a GPU belongs to the process that opens it."""
        if config.device == "cpu":
            cls(config)

    def __init__(self, config: Config) -> None:
        self.config = config
        make = FilterSettings.paper if config.form == "paper" else FilterSettings
        settings = make(particles=config.particles, iterations=config.iterations, dof=config.dof).without(
            *config.without
        )
        device = chosen_device(config.device, place="particle_filter.device")
        catalogue = Catalogue.shared(config.catalogue)
        self._filter = SceneFilter(catalogue, settings, device=device, seed=config.seed)
        self._filter.warm_up()
        self._suggestions = Suggestions(catalogue)
        self._seen: tuple[Observation, ObservedScene] | None = None

    def on_prospect(self, prospect: LoneCandidate, view: Observation, ctx: Context) -> LoneEstimate:
        """A look at one candidate alone, where the form takes one."""
        candidate = prospect.candidate
        nothing = LoneEstimate(
            index=prospect.index, count=prospect.count, n_objects=prospect.n_objects, candidate=candidate
        )
        if candidate is None or not self._filter.looks_first:
            return nothing
        scene, suspect = self._scene(view), _suspect(candidate)
        track = self._filter.look(scene, suspect, among=prospect.count)
        unknown = prospect.n_objects is None
        start = LonePose(T_camera_object=_pose(track), trace=_trace(track))
        if unknown:
            start = self._start(scene, suspect, track)
        return msgspec.structs.replace(
            nothing, start=start, glimpse=self._filter.glimpse(scene, suspect, track, anywhere=unknown)
        )

    def on_hypothesis(self, hypothesis: Hypothesis, observation: Observation, ctx: Context) -> Posterior:
        """The most likely scene of the hypothesis and its unnormalised weight."""
        scene = self._scene(observation)
        suspects = _suspects(hypothesis.candidates, hypothesis.search)
        starts = [_track(start) for start in hypothesis.starts]
        reached = self._reached(scene, hypothesis)
        search = hypothesis.search
        asked = [_suspect(offer.candidate) for offer in search.offers] if search else []
        result = self._filter.estimate(scene, suspects, starts, reached=reached, asked=asked)
        names = unique_names([candidate.label for candidate in hypothesis.candidates])
        remark = f"above {reached:.1f}, which is reached: dropped" if result.dropped else ""
        ctx.log(f"hypothesis {hypothesis.index + 1} of {hypothesis.count}: cost {result.cost:.1f} {remark}".rstrip())
        tracks = [found.track for found in result.objects]
        # In one that is dropped nobody looks for what has no start.
        objects = [_object(*each) for each in zip(names, hypothesis.candidates, result.objects, strict=False)]
        new_charges = self._charges(scene, hypothesis, objects, tracks)
        charges = hypothesis.charges + new_charges
        # Nobody goes on from what is worse than the scene that is known.
        best = result.cost + sum(new_charges) <= reached
        suggests = search is not None and search.suggestions and best
        return Posterior(
            index=hypothesis.index,
            count=hypothesis.count,
            objects=tuple(objects),
            log_weight=-self.config.lambda_r * (result.cost + sum(charges)),
            traces=tuple(_trace(found.track) for found in result.objects),
            left_out=hypothesis.left_out,
            dropped=result.dropped,
            lambda_r=self.config.lambda_r,
            charges=charges,
            unexplained=result.unexplained,
            suggested=self._suggestions.of(scene, objects, result.layers) if suggests else (),
            search=search,
        )

    def _scene(self, observation: Observation) -> ObservedScene:
        """The observation made ready, once for all parts that come with it."""
        if self._seen is None or self._seen[0] is not observation:
            seen = observation
            scene = ObservedScene.of(seen.depth, seen.foreground, seen.K, seen.T_camera_table)
            self._seen = seen, scene
        return self._seen[1]

    def _charges(
        self, scene: ObservedScene, hypothesis: Hypothesis, objects: Sequence[ObjectPose], tracks: Sequence[Track]
    ) -> tuple[float, ...]:
        """What the objects that were looked for among the others cost by being there: where one must be, no more than
        those did in whose place it comes; where it cannot be, all that it claims."""
        first = len(hypothesis.charges)
        before = hypothesis.incumbent_charged - hypothesis.charged
        charges: list[float] = []
        new = zip(hypothesis.candidates[first:], tracks[first:], hypothesis.shares, strict=False)
        for k, (candidate, track, share) in enumerate(new, first):
            collides = self._suggestions.collides(scene, objects, k)
            if not collides and self._suggestions.carries(scene, objects, k):
                charges.append(before)
            else:
                start = self._start(scene, _suspect(candidate), track)
                charges.append(charge(candidate.box, start, 1.0 if collides else share))
        return tuple(charges)

    def _start(self, scene: ObservedScene, suspect: Suspect, track: Track) -> LonePose:
        rise, claim, explained = self._filter.worth(scene, suspect, track)
        return LonePose(T_camera_object=_pose(track), trace=_trace(track), rise=rise, claim=claim, explained=explained)

    def _reached(self, scene: ObservedScene, hypothesis: Hypothesis) -> float:
        """What a scene of the hypothesis may cost and still weigh as much as the known one."""
        if not hypothesis.starts:
            return np.inf
        suspects = _suspects([placed.candidate for placed in hypothesis.incumbent], hypothesis.search)
        poses = [placed.T_camera_object[:3] for placed in hypothesis.incumbent]
        # For the incumbent itself the charges cancel exactly.
        difference = hypothesis.incumbent_charged - hypothesis.charged
        return self._filter.begun_cost(scene, suspects, poses) + difference


def _suspect(candidate: Candidate) -> Suspect:
    return Suspect(candidate.label, candidate.box)


def _suspects(candidates: Sequence[Candidate], search: Search | None) -> list[Suspect]:
    """The candidates of one scene; boxes of its label that frame none of them may frame an object too."""
    taken = {candidate.box.tobytes() for candidate in candidates}
    free = [offer.candidate for offer in search.offers if offer.candidate.box.tobytes() not in taken] if search else []
    return [Suspect(c.label, c.box, tuple(f.box for f in free if f.label == c.label)) for c in candidates]


def _object(name: str, candidate: Candidate, found: Found) -> ObjectPose:
    return ObjectPose(
        name=name,
        label=candidate.label,
        T_camera_object=_pose(found.track),
        confidence=candidate.confidence,
        cost=found.cost,
        box=candidate.box,
        visible=found.visible,
    )


def _pose(track: Track) -> Floats:
    T = track.T_camera_object
    return pose(T[:, :3], T[:, 3])


def _trace(track: Track) -> ParticleTrace:
    return ParticleTrace(iterations=track.iterations, costs=np.array(track.costs, float), positions=track.positions)


def _track(start: LonePose) -> Track:
    trace = start.trace
    return Track(start.T_camera_object[:3].copy(), np.inf, trace.iterations, tuple(trace.costs), trace.positions)
