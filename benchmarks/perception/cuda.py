"""Times the particle filter on a GPU: `python -m benchmarks.cuda`; says so in a line where there is none."""

# pyright: basic

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from benchmarks.perception.kernel import (
    CATALOGUE,
    PARTICLES,
    SCENE,
    SHAPES,
    SIZES,
    _camera,
    _observed,
    _Quiet,
    _upright,
    problem,
)
from stages.geometry.arrays import Floats
from stages.messages import Candidate, Hypothesis, Observation, Posterior
from stages.messages.digest import LoneCandidate
from stages.particle_filter import ParticleFilter
from stages.perception.cuda.device import cuda_obstacle
from stages.perception.filter.iterations import IterationSettings, Population
from stages.perception.filter.likelihood import ObjectLikelihood
from stages.perception.filter.proposals import Guess, Proposals
from stages.perception.filter.settings import FilterSettings
from stages.scene.catalogue import Catalogue, CatalogueObject
from stages.scene.metrics import pose_errors

ITERATIONS = 200
HYPOTHESES = 56
DEVICES = ("cpu", "cuda")


def exchanged(
    likelihood: ObjectLikelihood, poses: Floats, *, iterations: int = ITERATIONS, launch: Any = None
) -> float:
    """Milliseconds of costs where poses come from the host and costs go back."""
    from stages.perception.cuda.batch import Batch, CostInputs

    batch = Batch([likelihood.shape], [CostInputs.of(likelihood)], launch)
    return _milliseconds(lambda n: [batch.changes(poses) for _ in range(n)], iterations)


def resident(
    item: CatalogueObject, likelihood: ObjectLikelihood, poses: Floats, *, copies: int = 1,
    iterations: int = ITERATIONS, launch: Any = None,
) -> float:  # fmt: skip
    """Milliseconds per iteration of populations that stay on the device: costs, weights, resampling, transition,
    polish of as many particles as the filter's."""
    from stages.perception.cuda.iterations import CudaIterations

    settings = replace(FilterSettings(particles=len(poses)), schedule=None)
    proposals, T_camera_table = Proposals(item, 6), np.eye(4)
    guess = Guess(poses[:, :, 3].astype(float), T_camera_table)
    flipped, few = int(settings.flips * len(poses)), int(settings.polished * len(poses))
    # The spread stays what it is, so that every iteration is as much work as the first.
    step = IterationSettings(len(poses), 0.01, 0.2, flipped, int(settings.renewed * len(poses)), flipped + few)
    populations = [
        Population(poses, likelihood, proposals.directions(T_camera_table), proposals, guess, np.random.default_rng(h))
        for h in range(copies)
    ]
    going = CudaIterations(populations, [step] * (iterations + 3), settings, launch=launch)
    return _milliseconds(going.iterate, iterations)


def _milliseconds(run: Any, iterations: int) -> float:
    """Wall time per iteration, after a few that compile and warm up."""
    from stages.perception.cuda.scalars import cuda

    run(min(3, iterations))
    cuda.synchronize()
    start = time.perf_counter()
    run(iterations)
    cuda.synchronize()
    return 1000 * (time.perf_counter() - start) / iterations


def deviation(likelihood: ObjectLikelihood, poses: Floats) -> float:
    """The greatest difference between the GPU's costs and the CPU's, as a share of the cost without the object."""
    from stages.perception.cuda.batch import Batch, CostInputs

    changes = Batch([likelihood.shape], [CostInputs.of(likelihood)]).changes(poses)
    return float(abs(likelihood.base + changes - likelihood.costs(poses)).max() / likelihood.base)


@dataclass(frozen=True)
class Table:
    """A picture of four objects, and where they are."""

    observation: Observation
    candidates: tuple[Candidate, ...]
    poses: tuple[Floats, ...]
    """4 x 4 each."""


def table(width: int = 640) -> Table:
    """The benchmark's scene."""
    catalogue = Catalogue.load(CATALOGUE)
    K, T_camera_table = _camera(width)
    items = [catalogue[label] for label in SCENE]
    poses = [T_camera_table @ _upright(item, *place) for item, place in zip(items, SCENE.values(), strict=True)]
    seen, boxes = _observed(items, poses, K, T_camera_table, width)
    observation = Observation(
        depth=seen.depth, rgb=np.zeros((*seen.depth.shape, 3), np.uint8), foreground=seen.foreground, K=K,
        T_camera_table=T_camera_table, T_base_camera=None,
    )  # fmt: skip
    candidates = tuple(Candidate(box=box, label=label, confidence=0.9) for label, box in zip(SCENE, boxes, strict=True))
    return Table(observation, candidates, tuple(poses))


def stage_seconds(stage: ParticleFilter, seen: Table) -> tuple[float, Posterior]:
    """What the stage takes for the scene: a look at each candidate, then the hypothesis that has them all."""
    quiet, count, start = cast(Any, _Quiet()), len(seen.candidates), time.perf_counter()
    prospects = [
        LoneCandidate(index=i, count=count, n_objects=count, candidate=each) for i, each in enumerate(seen.candidates)
    ]
    looks = [stage.on_prospect(prospect, seen.observation, quiet).start for prospect in prospects]
    starts = tuple(look for look in looks if look is not None)
    hypothesis = Hypothesis(index=0, count=1, candidates=seen.candidates, starts=starts)
    found = stage.on_hypothesis(hypothesis, seen.observation, quiet)
    return time.perf_counter() - start, found


def worst(found: Posterior, seen: Table) -> str:
    """The greatest errors of the scene's poses."""
    catalogue = Catalogue.load(CATALOGUE)
    errors = [
        pose_errors(each.T_camera_object, T, catalogue[each.label].symmetries.transforms())
        for each, T in zip(found.objects, seen.poses, strict=True)
    ]
    metres, radians = np.array(errors).max(0)
    return f"errors up to {1000 * metres:.1f} mm, {np.rad2deg(radians):.1f} degrees"


def _costs(catalogue: Catalogue) -> None:
    print(f"ms per iteration of {PARTICLES} particles\n{'':46s}" + "".join(f"{s:>14s}" for s in SHAPES))
    for width, triangles in SIZES:
        items = [catalogue[shape] for shape in SHAPES]
        problems = [problem(item, width, triangles) for item in items]
        size = f"{width}x{width * 3 // 4}, {triangles} triangles"
        _row(f"{size}, costs only, from host to host", [exchanged(*p) for p in problems])
        _row(f"{size}, whole iteration on the GPU", [resident(i, *p) for i, p in zip(items, problems, strict=True)])
        several = [resident(i, *p, copies=HYPOTHESES, iterations=20) for i, p in zip(items, problems, strict=True)]
        _row(f"{size}, {HYPOTHESES} hypotheses, each", [each / HYPOTHESES for each in several])
        _row(f"{size}, costs differ from the CPU's by", [deviation(*p) for p in problems], "14.1e")


def _row(name: str, values: list[float], form: str = "14.3f") -> None:
    print(f"{name:46s}" + "".join(format(value, form) for value in values))


def _scenes() -> None:
    seen = table()
    for form in ("default", "paper"):
        for device in DEVICES:
            # The first scene pays for compiling; with another seed nothing of it is remembered.
            for seed in (0, 1):
                config = ParticleFilter.Config(
                    catalogue=CATALOGUE, form=cast(Any, form), device=cast(Any, device), seed=seed
                )
                seconds, found = stage_seconds(ParticleFilter(config), seen)
            print(f"four objects through the stage, {form} form, {device}: {seconds:.2f} s, {worst(found, seen)}")


def main() -> None:
    """Prints the tables, or why there is nothing to measure."""
    obstacle = cuda_obstacle()
    if obstacle is not None:
        print(f"nothing measured: {obstacle}")
        return
    from stages.perception.cuda.scalars import cuda

    print(cuda.get_current_device().name)
    _costs(Catalogue.load(Path(CATALOGUE)))
    _scenes()


if __name__ == "__main__":
    main()
