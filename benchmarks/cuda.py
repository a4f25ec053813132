"""Times the particle filter on a GPU: `python -m benchmarks.cuda`; says so in a line where there is none."""

# pyright: basic

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, cast

import numpy as np

from benchmarks.kernel import CATALOGUE, PARTICLES, SCENE, SHAPES, SIZES, _camera, _observed, _Quiet, _upright, problem
from stages.messages import Candidate, Hypothesis, Observation
from stages.particle_filter import ParticleFilter
from stages.perception.evaluators import cuda_obstacle
from stages.perception.likelihood import ObjectLikelihood
from stages.perception.poses import exp_so3
from stages.scene.catalogue import Catalogue, Floats

ITERATIONS = 200
HYPOTHESES = 56


def exchanged(
    likelihood: ObjectLikelihood, poses: Floats, *, iterations: int = ITERATIONS, launch: Any = None
) -> float:
    """Milliseconds per iteration where poses come from the host and costs go back: what the stage does."""
    from stages.perception.cuda_batch import Batch, Look, change_of_cost_cuda

    batch = Batch([likelihood.shape], [Look(likelihood.window, likelihood._plane, likelihood.form)], launch)
    return _milliseconds(lambda n: [change_of_cost_cuda(batch, poses) for _ in range(n)], iterations)


def resident(
    likelihood: ObjectLikelihood, poses: Floats, *, copies: int = 1, iterations: int = ITERATIONS, launch: Any = None
) -> float:
    """Milliseconds per iteration of populations that stay on the device: costs, weights, resampling, transition."""
    from stages.perception.cuda_batch import Batch, Look
    from stages.perception.cuda_filter import CudaFilter, Population, Schedule

    looks = [Look(likelihood.window, likelihood._plane, likelihood.form)]
    flips = exp_so3(np.pi * np.eye(3))
    population = Population(mesh=0, window=0, poses=poses, directions=np.eye(6), flips=flips, pool=poses)
    # The spread stays what it is, so that every iteration is as much work as the first.
    schedule = Schedule.annealed(1, metres=(0.01, 0.01), radians=(0.2, 0.2))
    batch = Batch([likelihood.shape], looks, launch)
    filters = CudaFilter([likelihood.shape], looks, [population] * copies, schedule, seed=0, batch=batch)
    return _milliseconds(filters.iterate, iterations)


def _milliseconds(run: Any, iterations: int) -> float:
    """Wall time per iteration, after a few that compile and warm up."""
    from stages.perception.cuda_math import cuda

    run(min(3, iterations))
    cuda.synchronize()
    start = time.perf_counter()
    run(iterations)
    cuda.synchronize()
    return 1000 * (time.perf_counter() - start) / iterations


def scene(device: str) -> float:
    """Seconds of the particle filter's stage for four objects, 400 iterations of 625 particles in the paper's form."""
    catalogue = Catalogue.load(CATALOGUE)
    K, T_camera_table = _camera(640)
    items = [catalogue[label] for label in SCENE]
    poses = [T_camera_table @ _upright(item, *place) for item, place in zip(items, SCENE.values(), strict=True)]
    seen, boxes = _observed(items, poses, K, T_camera_table, 640)
    observation = Observation(
        depth=seen.depth, rgb=np.zeros((*seen.depth.shape, 3), np.uint8), foreground=seen.foreground, K=K,
        T_camera_table=T_camera_table, T_base_camera=None,
    )  # fmt: skip
    candidates = tuple(Candidate(box=box, label=label, confidence=0.9) for label, box in zip(SCENE, boxes, strict=True))
    config = ParticleFilter.Config(catalogue=str(CATALOGUE), form="paper", device=cast(Any, device))
    stage = ParticleFilter(config)
    start = time.perf_counter()
    stage.on_hypothesis(Hypothesis(index=0, count=1, candidates=candidates), observation, cast(Any, _Quiet()))
    return time.perf_counter() - start


def _table(catalogue: Catalogue) -> None:
    print(f"ms per iteration of {PARTICLES} particles\n{'':46s}" + "".join(f"{s:>14s}" for s in SHAPES))
    for width, triangles in SIZES:
        problems = [problem(catalogue[shape], width, triangles) for shape in SHAPES]
        size = f"{width}x{width * 3 // 4}, {triangles} triangles"
        _row(f"{size}, costs only, from host to host", [exchanged(*p) for p in problems])
        _row(f"{size}, whole iteration on the GPU", [resident(*p) for p in problems])
        batched = [resident(*p, copies=HYPOTHESES, iterations=20) / HYPOTHESES for p in problems]
        _row(f"{size}, {HYPOTHESES} hypotheses, each", batched)


def _row(name: str, times: list[float]) -> None:
    print(f"{name:46s}" + "".join(f"{t:14.3f}" for t in times))


def main() -> None:
    """Prints the tables, or why there is nothing to measure."""
    obstacle = cuda_obstacle()
    if obstacle is not None:
        print(f"nothing measured: {obstacle}")
        return
    from stages.perception.cuda_math import cuda

    print(cuda.get_current_device().name)
    _table(Catalogue.load(Path(CATALOGUE)))
    for device in ("cpu", "cuda"):
        print(f"four objects, paper's full budget, device {device}: {scene(device):.2f} s")


if __name__ == "__main__":
    main()
