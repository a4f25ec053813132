"""Estimates the images of a BOP data set: `python -m benchmarks.estimate DATASET DETECTIONS OUT.csv`."""

from __future__ import annotations

import argparse
import multiprocessing
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks.common.command import command
from benchmarks.common.datasets import Image, ImageId, detections_file, images, parse_wanted
from benchmarks.common.pipeline import Done, Estimate, Part, Pipeline, answered, constructed_filter
from benchmarks.comparison.accuracy import failures, right_sets, score, table
from runner.contract import Refused
from runner.graph.graph import Graph, graph_to_json
from runner.graph.reading import graph_from_json, load_graph
from runner.process.children import ENVIRONMENT
from stages.devices.bop_results import HEADER, Result
from stages.particle_filter import ParticleFilter
from stages.scene.catalogue import Catalogue

_GRAPH = Path(__file__).parents[2] / "graphs" / "bop.yaml"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What to estimate with. ``dof``, ``form`` and ``without`` go to every stage that has a setting of that name."""

    dof: Literal[3, 6] = 6
    form: Literal["default", "paper"] = "default"
    without: tuple[str, ...] = ()
    """Improvements over the paper's plain form that are switched off."""
    n_objects: int | Literal["auto"] | None = None
    """None takes what the data set's targets say."""
    set: tuple[str, ...] = ()
    """Further settings as for a graph: ``stage.key=value``."""
    processes: int = 1
    """1 computes in this process; with more, ``share`` says what they divide."""
    share: Literal["images", "hypotheses"] = "images"
    """``hypotheses`` is how a graph runs with replicas: right for timing one image after the other."""

    def __post_init__(self) -> None:
        if self.processes < 1:
            raise Refused(f"processes = {self.processes}: must be at least 1")


def estimate(
    dataset: Path, detections: Path | str, settings: Settings, wanted: Iterable[ImageId] | int | None = None
) -> list[Estimate]:
    """The scenes of the images, in the order of the targets file; ``wanted`` as in :func:`images`.

    ``detections`` is a file, or ``exact`` or ``noisy`` for the data set's own.
    """
    return list(estimates(dataset, images(dataset, detections_file(dataset, str(detections)), wanted), settings))


def estimates(dataset: Path, chosen: Iterable[Image], settings: Settings) -> Iterator[Estimate]:
    """The same for images at hand, one after the other as they are done; ``dataset`` has the models."""
    graph = bop_graph(dataset, settings)
    if settings.processes == 1:
        pipeline = Pipeline(graph)
        yield from map(pipeline.estimate, chosen)
        return
    with _Workers(graph, settings.processes, whole=settings.share == "images") as workers:
        if settings.share == "images":
            yield from workers.estimates(chosen)
        else:
            yield from map(Pipeline(graph, workers).estimate, chosen)


def bop_graph(dataset: Path, settings: Settings) -> Graph:
    """The graph of ``graphs/bop.yaml`` with the settings.

    Raises:
        Refused: a setting is wrong or no stage has it.
    """
    # The harness replaces the stages these three belong to, but a graph is checked as a whole.
    paths = (f"camera.dataset={dataset.resolve()}", "detector.detections=unused.json", "results.path=unused.csv")
    plain = load_graph(_GRAPH, paths)
    chosen: dict[str, Any] = {"dof": settings.dof, "form": settings.form, "n_objects": settings.n_objects}
    if settings.without:
        chosen["without"] = f"[{', '.join(settings.without)}]"
    assignments = [f"{stage}.{key}={value}" for key, value in chosen.items() if value is not None
                   for stage in _stages_with(plain, key)]  # fmt: skip
    return load_graph(_GRAPH, (*paths, *assignments, *settings.set))


def _stages_with(graph: Graph, key: str) -> list[str]:
    stages = [node.name for node in graph.nodes.values() if hasattr(node.config, key)]
    if not stages:
        raise Refused(f"no stage of {graph.name} has a setting '{key}'")
    return stages


class _Workers:
    """Processes that compute on one thread each."""

    def __init__(self, graph: Graph, count: int, *, whole: bool) -> None:
        # Numba reads its number of threads when it is imported, so a process must be born with it.
        os.environ |= dict(ENVIRONMENT)
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(count, context, initializer=_begin, initargs=(graph_to_json(graph), whole))
        # Every process sets up before the first image, so that none pays for another's compilation.
        for future in [self._pool.submit(_ready) for _ in range(count)]:
            future.result()

    def __enter__(self) -> _Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def submit(self, part: Part) -> Future[Done[Any]]:
        """Has the particle filter of the next free process answer."""
        return self._pool.submit(_run_part, part)

    def estimates(self, chosen: Iterable[Image]) -> Iterator[Estimate]:
        """Whole images, in order."""
        for future in [self._pool.submit(_run_image, image) for image in chosen]:
            yield future.result()


class _Mine:
    """What a worker process has constructed."""

    pipeline: Pipeline
    particle_filter: ParticleFilter


def _begin(graph_json: str, whole: bool) -> None:
    graph = graph_from_json(graph_json)
    if whole:
        _Mine.pipeline = Pipeline(graph)
    else:
        _Mine.particle_filter = constructed_filter(graph)


def _ready() -> None:
    """Runs once a process has begun."""


def _run_image(image: Image) -> Estimate:
    return _Mine.pipeline.estimate(image)


def _run_part(part: Part) -> Done[Any]:
    return answered(_Mine.particle_filter, part)


def results(estimate: Estimate, catalogue: Catalogue) -> list[Result]:
    """The objects of an estimate as lines of a BOP result file."""
    scene = estimate.scene
    return [Result.of(scene, item, catalogue[item.label].label, estimate.seconds) for item in scene.objects]


@command
def main() -> int:
    """Estimates, writes, prints the table."""
    return _run(_options())


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="BOP data set folder")
    parser.add_argument("detections", help="exact, noisy or a file of detections")
    parser.add_argument("out", type=Path, help="BOP results, CSV")
    parser.add_argument("--dof", type=int, default=6)
    parser.add_argument("--form", default="default")
    parser.add_argument("--without", action="append", default=[], metavar="NAME", help="switch one improvement off")
    parser.add_argument("--n-objects", default=None, help="a number or auto; by default what the targets say")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE")
    parser.add_argument("--images", default=None, help="the first N, or ids such as 1/0,2/0")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--share", choices=("images", "hypotheses"), default="images", help="what processes divide")
    return parser.parse_args()


def _settings(options: argparse.Namespace) -> Settings:
    return Settings(
        dof=options.dof,
        form=options.form,
        without=tuple(options.without),
        n_objects=options.n_objects,
        set=tuple(options.set),
        processes=options.processes,
        share=options.share,
    )


def _run(options: argparse.Namespace) -> int:
    wanted = parse_wanted(options.images)
    chosen = list(images(options.dataset, detections_file(options.dataset, options.detections), wanted))
    catalogue = Catalogue.load(options.dataset / "models")
    found: list[Result] = []
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("w") as file:
        file.write(HEADER + "\n")
        for image, one in zip(chosen, estimates(options.dataset, chosen, _settings(options)), strict=True):
            lines = results(one, catalogue)
            found += lines
            file.writelines(f"{line.line()}\n" for line in lines)
            print(f"{image.frame.name}: {one.seconds:.2f} s, {one.cpu_seconds:.2f} s of CPU", flush=True)
    truths = [truth for image in chosen for truth in image.truths]
    scores = score(truths, found, catalogue, {image.id: (image.depth, image.K) for image in chosen})
    print(table(scores, right_sets(truths, found)))
    print(failures(scores, catalogue))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
