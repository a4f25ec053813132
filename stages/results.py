"""Scene estimates out to disk: a scene graph per look, BOP results."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from runner.contract import Context, Finished, Refused, Stage
from stages.devices.bop_results import HEADER, Result, write_scene_graph
from stages.messages import Frame, SceneEstimate, SceneGraph
from stages.scene.catalogue import Catalogue
from stages.scene.text import certainty, tree


class SceneGraphs(Stage):
    """Says the scene graph of every look, and writes it beside the recording; ends the graph after the last look."""

    device = True

    def __init__(self) -> None:
        self._written = 0
        self._unusable: list[str] = []
        """Of looks at which nothing was to be seen: why."""

    def on_scene_graph(
        self, frame: Frame, scene_estimate: SceneEstimate, scene_graph: SceneGraph, ctx: Context
    ) -> Finished | None:
        """One look: what stands on what, and how sure that is."""
        write_scene_graph(ctx.directory / f"look-{frame.index:04d}.json", scene_graph)
        said = f"{frame.name}{_said(scene_estimate)}"
        if scene_graph.unusable:
            self._unusable.append(scene_graph.unusable)
            ctx.log(said, level="warning")
        else:
            ctx.log("\n".join([said, *tree(scene_graph)]))
        self._written += 1
        if self._written == frame.total:
            return _finished(f"looks: {self._written}, scene graphs in {ctx.directory}", self._unusable)
        return None


class BopResults(Stage):
    """Writes one CSV for a data set and, beside it, a scene graph per image; ends the graph after the last image."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Settings."""

        path: str
        """The CSV to write; scene graphs go to the folder of the same name without the ending."""
        catalogue: Path
        """Tells the object numbers of BOP from names."""

        def __post_init__(self) -> None:
            if Path(self.path).suffix != ".csv":
                raise Refused(f"results.path is '{self.path}'; it must end in .csv")

    def __init__(self, config: Config) -> None:
        self._catalogue = Catalogue.shared(config.catalogue)
        self._path = Path(config.path)
        self._graphs = self._path.with_suffix("")
        try:
            self._graphs.mkdir(parents=True, exist_ok=True)
            self._path.write_text(HEADER + "\n")
        except OSError as error:
            raise Refused(f"results.path: cannot write '{self._path}' ({error.strerror})") from error
        self._written = 0
        self._unusable: list[str] = []
        """Of images in which nothing was to be seen: why."""
        self._newest: float | None = None

    def on_scene_graph(
        self, frame: Frame, scene_estimate: SceneEstimate, scene_graph: SceneGraph, ctx: Context
    ) -> Finished | None:
        """Appends the objects of one image; says what was found."""
        seconds = self._seconds()
        results = [
            Result.of(scene_estimate, item, self._catalogue[item.label].label, seconds)
            for item in scene_estimate.objects
        ]
        with self._path.open("a") as file:
            file.writelines(f"{result.line()}\n" for result in results)
        write_scene_graph(self._graphs / f"{frame.scene_id:06d}_{frame.image_id:06d}.json", scene_graph)
        self._written += 1
        self._unusable += [scene_graph.unusable] if scene_graph.unusable else []
        names = ", ".join(item.name for item in scene_estimate.objects) or "no objects"
        ctx.log(
            f"{frame.name or frame.image_id}: {names} (hypothesis {scene_estimate.winner + 1} of "
            f"{len(scene_estimate.log_weights)}{f', {seconds:.1f} s' if seconds > 0 else ''}{_said(scene_estimate)})",
            level="warning" if scene_graph.unusable else "info",
        )
        if self._written == frame.total:
            return _finished(f"{self._written} images, results in {self._path}", self._unusable)
        return None

    def _seconds(self) -> float:
        """Wall time since the image before, -1 for the first: images overlap, so this is the time each one adds."""
        before, self._newest = self._newest, time.monotonic()
        return -1.0 if before is None else self._newest - before


def _finished(done: str, unusable: Sequence[str]) -> Finished:
    """Failed where nothing was to be seen in an image: that it has no objects says nothing of its scene."""
    if not unusable:
        return Finished(code=0, reason=done)
    return Finished(code=1, reason=f"{done}; nothing is known of {len(unusable)} of them: {'; '.join(unusable[:2])}")


def _said(estimate: SceneEstimate) -> str:
    text = certainty(estimate)
    return f", {text}" if text else ""
