"""Times the particle filter's kernel on one core beside other rasterisers: `python -m benchmarks.kernel`."""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from stages.geometry.arrays import Floats
from stages.geometry.masks import box_of
from stages.geometry.poses import compose, exp_so3, pose
from stages.perception.filter.likelihood import CostForm, ObjectLikelihood, ObservedScene, Shape, Window
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.scene.catalogue import Catalogue, CatalogueObject

PARTICLES = 625
CATALOGUE = Path(__file__).parents[2] / "stages" / "scene" / "catalogue.yaml"
SHAPES = ("sauce_bottle", "cereal_box", "mug")
SIZES = ((160, 500), (320, 500), (320, 2000))
"""Width of the image and triangles."""
SCENE = {"sauce_bottle": (-0.18, 0.02, 0.3), "cereal_box": (0.02, 0.12, 0.4), "mug": (-0.03, -0.1, 1.0),
         "tea_box": (0.17, -0.02, 0.2)}  # fmt: skip
"""Where the four objects of the whole budget stand: x, y in metres, yaw in radians."""
_FORM = CostForm(contact_slack=10.0)
"""The others do not know of the table that an object may not sink into."""
_AGREE = 0.05
"""Share of the cost without the object by which others may be off: multisampled depth lies off the pixels' centres."""


def problem(item: CatalogueObject, width: int, triangles: int) -> tuple[ObjectLikelihood, Floats]:
    """An object 0.85 m from the camera on a table, and particles within about 3 cm and 15 degrees of it."""
    K, T_camera_table = _camera(width)
    T = T_camera_table @ _upright(item, 0.0, 0.0, 0.7)
    scene, _ = _observed([item], [T], K, T_camera_table, width)
    whole = (0, 0, width, width * 3 // 4)
    window = Window.of(scene, scene.plane_inverse, whole, whole, stride=1, form=_FORM)
    return ObjectLikelihood(Shape.of(item.simplified(triangles)), window, scene, _FORM), _particles(T)


def _camera(width: int) -> tuple[Floats, Floats]:
    focal = 262.5 * width / 320
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (width * 3 // 4 - 1) / 2], [0, 0, 1]])
    return K, pose(exp_so3(np.array([np.pi / 2 + 0.7, 0, 0])), np.array([0, 0.03, 0.85]))


def _upright(item: CatalogueObject, x: float, y: float, yaw: float) -> Floats:
    return pose(exp_so3(np.array([0, 0, yaw])), np.array([x, y, -item.bounds[0, 2]]))


def _observed(
    items: list[CatalogueObject], poses: list[Floats], K: Floats, T_camera_table: Floats, width: int
) -> tuple[ObservedScene, list[Floats]]:
    """The depth image of objects on the table, and their boxes."""
    height = width * 3 // 4
    view = View.of(K, width, height)
    layers = [inverse_depth(Soup.of(item.mesh), T, view) for item, T in zip(items, poses, strict=True)]
    blank = np.ones((height, width), np.float32)
    plane = ObservedScene.of(blank, blank > 0, K, T_camera_table).plane_inverse
    nearest = np.maximum.reduce([plane, *layers])
    depth = np.where(nearest > 0.25, 1 / np.maximum(nearest, 0.25), 0).astype(np.float32)
    boxes = [box_of((layer > 0) & (layer >= nearest)) for layer in layers]
    return ObservedScene.of(depth, nearest > plane, K, T_camera_table), boxes


def _particles(T: Floats) -> Floats:
    rng = np.random.default_rng(0)
    poses = np.repeat(T[None, :3], PARTICLES, 0)
    poses[:, :, :3] = compose(exp_so3(rng.normal(0, 0.25, (PARTICLES, 3))), poses[:, :, :3])
    poses[:, :, 3] += rng.normal(0, 0.03, (PARTICLES, 3))
    return poses


@dataclass(frozen=True)
class Rival:
    """A way to weigh particles; slow ones weigh few and are scaled up."""

    name: str
    make: Callable[..., Callable[[Floats], Floats]]
    particles: int = PARTICLES
    repeats: int = 3


def _rivals() -> list[Rival]:
    from benchmarks.common.rasterisers import pyrender_loop, ray_casting, torch_edges

    return [
        Rival("torch edge functions", torch_edges, particles=128),
        Rival("Open3D ray casting", ray_casting, particles=64),
        Rival("pyrender + NumPy", pyrender_loop, particles=25),
    ]


@dataclass(frozen=True)
class Time:
    """Milliseconds per iteration of 625 particles."""

    median: float
    least: float

    @staticmethod
    def of(costs: Callable[[Floats], Floats], poses: Floats, repeats: int) -> Time:
        """Times evaluations after a first one."""
        costs(poses)
        seconds: list[float] = []
        for _ in range(repeats):
            start = time.process_time()
            costs(poses)
            seconds.append(time.process_time() - start)
        scale = 1000 * PARTICLES / len(poses)
        return Time(scale * float(np.median(seconds)), scale * min(seconds))

    def __str__(self) -> str:
        return f"{self.median:.1f} ({self.least:.1f})" if self.median < 100 else f"{self.median:.0f} ({self.least:.0f})"


def _compare(catalogue: Catalogue, width: int, triangles: int) -> None:
    """Prints a row for our kernel and for each of the others."""
    from benchmarks.common.rasterisers import Task

    problems = [problem(catalogue[shape], width, triangles) for shape in SHAPES]
    tasks = [
        Task(catalogue[s].simplified(triangles), p.window, _FORM) for s, (p, _) in zip(SHAPES, problems, strict=True)
    ]
    ours = [Time.of(likelihood.costs, poses, 25) for likelihood, poses in problems]
    print(f"\n{width}x{width * 3 // 4}, {triangles} triangles")
    _row("Numba (ours)", ours, ours)
    for rival in _rivals():
        try:
            weighers = [rival.make(task) for task in tasks]
        except ImportError as error:
            absent = "not installed: pip install '.[benchmarks]'"
            print(f"  {rival.name:26s}{absent if isinstance(error, ModuleNotFoundError) else error}")
            continue
        times: list[Time] = []
        for costs, (likelihood, poses) in zip(weighers, problems, strict=True):
            _check(rival.name, costs(poses[:10]) - likelihood.costs(poses[:10]) + likelihood.base, likelihood.base)
            times.append(Time.of(costs, poses[: rival.particles], rival.repeats))
        _row(f"{rival.name}{' *' * (rival.particles < PARTICLES)}", times, ours)


def _check(name: str, off: Floats, base: float) -> None:
    """Who computes something else is not worth timing."""
    share = float(np.abs(off).max()) / base
    if share > _AGREE:
        raise SystemExit(f"{name} computes other costs: {100 * share:.1f} % off")


def _row(name: str, times: list[Time], ours: list[Time]) -> None:
    ratio = np.mean([t.median for t in times]) / np.mean([t.median for t in ours])
    print(f"  {name:26s}" + "".join(f"{t!s:>16s}" for t in times) + f"{ratio:10.1f}")


class _Quiet:
    """The context of a stage that nobody watches."""

    time_ns = 0
    rng = np.random.default_rng(0)
    directory = Path()

    def log(self, text: str, *, level: str = "info") -> None:
        """Says nothing."""


def _budget() -> None:
    """Acts as one replica: constructs the particle filter's stage and estimates four objects in the paper's form."""
    from runner.contract import Context
    from stages.messages import Candidate, Hypothesis, Observation
    from stages.particle_filter import ParticleFilter

    width = 640
    catalogue = Catalogue.load(CATALOGUE)
    K, T_camera_table = _camera(width)
    items = [catalogue[label] for label in SCENE]
    poses = [T_camera_table @ _upright(catalogue[label], *place) for label, place in SCENE.items()]
    scene, boxes = _observed(items, poses, K, T_camera_table, width)
    rgb = np.zeros((*scene.depth.shape, 3), np.uint8)
    observation = Observation(depth=scene.depth, rgb=rgb, foreground=scene.foreground, K=K,
                              T_camera_table=T_camera_table, T_base_camera=None)  # fmt: skip
    candidates = tuple(Candidate(box=box, label=label, confidence=0.9) for label, box in zip(SCENE, boxes, strict=True))
    stage = ParticleFilter(ParticleFilter.Config(catalogue=CATALOGUE, form="paper"))
    start = time.process_time()
    stage.on_hypothesis(Hypothesis(index=0, count=1, candidates=candidates), observation, cast(Context, _Quiet()))
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"paper's full budget, four objects, 400 iterations of {PARTICLES}: {seconds:.1f} CPU s on one core")
    print(f"peak memory of that process: {peak:.0f} MB\n")


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    wide = "avx512f" in "".join(line for line in lines if line.startswith("flags"))
    return f"{names[0] if names else 'unknown processor'}{' with AVX-512' * wide}"


def _one_core() -> None:
    """Keeps this process, and whatever threads its libraries start, on one core."""
    os.environ |= {"OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def main() -> None:
    """Prints what a replica takes for the whole budget, then the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--budget", action="store_true", help="only the whole budget, in this process")
    _one_core()
    if parser.parse_args().budget:
        _budget()
        return
    print(f"{_processor()}, one core\n", flush=True)
    # First, because a child's peak memory is no less than what its parent holds when it starts.
    subprocess.run([sys.executable, "-m", "benchmarks.perception.kernel", "--budget"], check=True)
    catalogue = Catalogue.load(CATALOGUE)
    print(f"CPU ms per iteration of {PARTICLES} particles: median (least); last column: mean of medians over ours")
    print("* timed on fewer particles and scaled up")
    print(" " * 28 + "".join(f"{shape:>16s}" for shape in SHAPES) + f"{'x ours':>10s}")
    for width, triangles in SIZES:
        _compare(catalogue, width, triangles)


if __name__ == "__main__":
    main()
