"""BOP result files: scene_id,im_id,obj_id,score,R,t,time with R row by row and t in millimetres."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.messages.digest import SceneEstimate
from stages.messages.scene import ObjectPose, SceneGraph

HEADER = "scene_id,im_id,obj_id,score,R,t,time"


@dataclass(frozen=True)
class Result:
    """One estimated object."""

    scene_id: int
    image_id: int
    label: int
    """BOP's obj_id."""
    score: float
    T_camera_object: Floats
    """4 x 4, metres."""
    seconds: float
    """For the whole image; -1 where it is not known."""

    @staticmethod
    def of(estimate: SceneEstimate, item: ObjectPose, label: int, seconds: float) -> Result:
        """The result of one object of a scene; its score is the probability that the pose is right, where it was
        judged, and the detector's confidence otherwise."""
        score = item.confidence if item.probability is None else item.probability
        return Result(estimate.scene_id, estimate.image_id, label, score, item.T_camera_object, seconds)

    def line(self) -> str:
        """The line of the CSV, without its end."""
        R = " ".join(f"{value:.9g}" for value in self.T_camera_object[:3, :3].ravel())
        t = " ".join(f"{1000 * value:.9g}" for value in self.T_camera_object[:3, 3])
        return f"{self.scene_id},{self.image_id},{self.label},{self.score:.6g},{R},{t},{self.seconds:.6g}"


def read_results(path: Path) -> list[Result]:
    """Reads a BOP result file.

    Raises:
        Refused: the file is missing or a line is not of the format; names file and line.
    """
    if not path.is_file():
        raise Refused(f"{path}: no such result file")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [_parsed(path, number, row) for number, row in enumerate(rows, 2)]


def _parsed(path: Path, number: int, row: dict[str, str]) -> Result:
    try:
        R = np.array(row["R"].split(), float).reshape(3, 3)
        t = np.array(row["t"].split(), float).reshape(3) / 1000
        return Result(int(row["scene_id"]), int(row["im_id"]), int(row["obj_id"]), float(row["score"]), pose(R, t),
                      float(row["time"]))  # fmt: skip
    except (KeyError, ValueError, AttributeError, TypeError) as error:
        raise Refused(f"{path}:{number}: not a line of {HEADER} ({error})") from error


def write_scene_graph(path: Path, graph: SceneGraph) -> None:
    """Writes a scene graph as JSON."""
    path.write_text(json.dumps(scene_graph_content(graph), indent=1) + "\n")


def scene_graph_content(graph: SceneGraph) -> dict[str, Any]:
    """Assertions as text and poses as numbers; ``frame`` says what the poses are relative to, and ``unusable``, where
    it is there, why nothing was to be seen."""
    return {
        **({"unusable": graph.unusable} if graph.unusable else {}),
        "scene_id": graph.scene_id,
        "im_id": graph.image_id,
        "frame": graph.frame,
        "assertions": [str(assertion) for assertion in graph.assertions],
        "objects": {item.name: item.T_base_object.tolist() for item in graph.objects},
        "virtual_objects": {
            item.name: {"parent": item.parent, "child": item.child, "T_parent_virtual": item.T_parent_virtual.tolist()}
            for item in graph.virtual_objects
        },
    }
