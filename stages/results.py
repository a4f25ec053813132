"""Scene estimates out to disk: a scene graph per look, BOP results."""

from __future__ import annotations

import time
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

    def on_scene_graph(
        self, frame: Frame, scene_estimate: SceneEstimate, scene_graph: SceneGraph, ctx: Context
    ) -> Finished | None:
        """One look: what stands on what, and how sure that is."""
        write_scene_graph(ctx.directory / f"look-{frame.index:04d}.json", scene_graph)
        ctx.log("\n".join([f"{frame.name}{_said(scene_estimate)}", *tree(scene_graph)]))
        self._written += 1
        if self._written == frame.total:
            return Finished(code=0, reason=f"looks: {self._written}, scene graphs in {ctx.directory}")
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
        names = ", ".join(item.name for item in scene_estimate.objects) or "no objects"
        ctx.log(
            f"{frame.name or frame.image_id}: {names} (hypothesis {scene_estimate.winner + 1} of "
            f"{len(scene_estimate.log_weights)}{f', {seconds:.1f} s' if seconds > 0 else ''}{_said(scene_estimate)})"
        )
        if self._written == frame.total:
            return Finished(code=0, reason=f"{self._written} images, results in {self._path}")
        return None

    def _seconds(self) -> float:
        """Wall time since the image before, -1 for the first: images overlap, so this is the time each one adds."""
        before, self._newest = self._newest, time.monotonic()
        return -1.0 if before is None else self._newest - before


def _said(estimate: SceneEstimate) -> str:
    text = certainty(estimate)
    return f", {text}" if text else ""
