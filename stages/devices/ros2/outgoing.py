"""Scenes as messages that ROS 2 tools know: detections, transforms, markers, JSON, and the camera's images."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from runner.contract import Refused
from stages.devices.bop_results import scene_graph_content
from stages.devices.ros2.images import IMAGE
from stages.devices.ros2.rgbd import INFO, TF
from stages.devices.ros2.settings import Frames
from stages.devices.ros2.types import Types
from stages.geometry.poses import inverse
from stages.messages import Frame, ObjectPose, Pose, SceneEstimate, SceneGraph
from stages.scene.catalogue import Catalogue, CatalogueObject
from stages.scene.doubts import SURE

DETECTIONS, MARKERS = "vision_msgs/msg/Detection3DArray", "visualization_msgs/msg/MarkerArray"
STRING = "std_msgs/msg/String"
TABLE = "scene/table"
"""Frame of the support plane."""
TRIANGLES = 200
"""Of an object's marker, about."""
_DELETE_ALL, _TRIANGLES, _TEXT = 3, 11, 9
_LETTERS = 0.025
"""Metres."""


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A message on its way to a topic; names that begin with ``~`` are the node's own."""

    topic: str
    message: Any


class Scenes:
    """Turns looks and scenes into messages."""

    def __init__(self, types: Types, catalogue: Catalogue, frames: Frames) -> None:
        self._types = types
        self._catalogue = catalogue
        self._frames = frames

    def camera(self, frame: Frame, stamp_ns: int) -> Iterator[Outgoing]:
        """A look, as a driver publishes it: colour, depth in metres, intrinsics, and where the camera stands."""
        header = _header(stamp_ns, self._frames.camera)
        yield Outgoing("~/camera/color/image_raw", self._image(frame.rgb, "rgb8", header))
        yield Outgoing("~/camera/depth/image_raw", self._image(frame.depth, "32FC1", header))
        height, width = frame.depth.shape
        fields = {"k": frame.K.ravel(), "r": np.eye(3).ravel(), "p": np.column_stack([frame.K, np.zeros(3)]).ravel()}
        yield Outgoing(
            "~/camera/color/camera_info",
            self._types.new(
                INFO,
                header=header,
                height=height,
                width=width,
                distortion_model="plumb_bob",
                d=np.zeros(5),
                **fields,
            ),
        )
        if frame.T_base_camera is not None:
            placed = _placed(self._base(), self._frames.camera, frame.T_base_camera, stamp_ns)
            yield Outgoing("/tf", self._types.new(TF, transforms=[placed]))

    def scene(self, estimate: SceneEstimate, graph: SceneGraph, stamp_ns: int) -> Iterator[Outgoing]:
        """A scene graph and the estimate that it is of; of a look at which nothing was to be seen only the JSON, which
        says why: what was published before still is what is known."""
        where = self._base() if graph.frame == "base" else TABLE
        estimates = {item.name: item for item in estimate.objects}
        if not graph.unusable:
            yield from self._seen(estimates, estimate.T_camera_table, graph, where, stamp_ns)
        content = {"stamp_ns": stamp_ns, "frame_id": where, **scene_graph_content(graph)}
        content["labels"] = {item.name: item.label for item in graph.objects}
        content["probabilities"] = {item.name: estimates[item.name].probability for item in graph.objects}
        yield Outgoing("~/scene_graph", self._types.new(STRING, data=json.dumps(content)))

    def _seen(
        self, estimates: Mapping[str, ObjectPose], T_camera_table: Pose, graph: SceneGraph, where: str, stamp_ns: int
    ) -> Iterator[Outgoing]:
        """The objects in the frame ``where``."""
        header = _header(stamp_ns, where)
        T_where_camera = graph.T_base_table @ inverse(T_camera_table)
        detections = [self._detection(estimates[item.name], T_where_camera, header) for item in graph.objects]
        yield Outgoing("~/detections", self._types.new(DETECTIONS, header=header, detections=detections))
        placed = [_placed(where, f"scene/{item.name}", item.T_base_object, stamp_ns) for item in graph.objects]
        if where == TABLE:
            placed.append(_placed(self._frames.camera, TABLE, T_camera_table, stamp_ns))
        yield Outgoing("/tf", self._types.new(TF, transforms=placed))
        yield Outgoing("~/markers", self._markers(estimates, graph, header))

    def _base(self) -> str:
        if self._frames.base is None:
            raise Refused("frames.base is null, but it is known how the camera stands to the robot: name that frame")
        return self._frames.base

    def _image(self, pixels: Any, encoding: str, header: dict[str, Any]) -> Any:
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
        given = {"header": header, "height": height, "width": width, "encoding": encoding, "data": data}
        return self._types.new(IMAGE, step=len(data) // height, **given)

    def _detection(self, item: ObjectPose, T_where_camera: Pose, header: dict[str, Any]) -> dict[str, Any]:
        """The estimated pose first, then other poses that explain the image, each with its probability."""
        entry = self._catalogue[item.label]
        T_where_object = T_where_camera @ item.T_camera_object
        score = item.confidence if item.probability is None else item.probability
        poses = [(T_where_object, score)]
        poses += [(T_where_camera @ other.T_camera_object, other.probability) for other in item.alternatives]
        middle = np.eye(4)
        middle[:3, 3] = entry.bounds.mean(0)
        x, y, z = entry.dimensions.tolist()
        return {
            "header": header,
            "id": item.name,
            "results": [
                {
                    "hypothesis": {"class_id": item.label, "score": float(probability)},
                    "pose": {"pose": _pose(T), "covariance": _covariance(item)},
                }
                for T, probability in poses
            ],
            "bbox": {"center": _pose(T_where_object @ middle), "size": {"x": x, "y": y, "z": z}},
        }

    def _markers(self, estimates: Mapping[str, ObjectPose], graph: SceneGraph, header: dict[str, Any]) -> Any:
        """Every object's mesh in its colours and its name above it, red where its pose is not sure."""
        markers: list[dict[str, Any]] = [{"header": header, "action": _DELETE_ALL}]
        for item in graph.objects:
            entry, probability = self._catalogue[item.label], estimates[item.name].probability
            common = {"header": header, "ns": item.name, "frame_locked": True}
            shape = {"type": _TRIANGLES, "scale": {"x": 1.0, "y": 1.0, "z": 1.0}, **_triangles(entry)}
            markers.append({**common, "pose": _pose(item.T_base_object), "color": _color(255, 255, 255), **shape})
            above = np.eye(4)
            top = (item.T_base_object[:3, :3] @ _corners(entry).T)[2].max() + _LETTERS
            above[:3, 3] = item.T_base_object[:3, 3] + [0, 0, top]
            unsure = probability is not None and probability < SURE
            text = item.name if probability is None else f"{item.name} {probability:.2f}"
            lettering = {"id": 1, "type": _TEXT, "text": text, "scale": {"x": 0.0, "y": 0.0, "z": _LETTERS}}
            color = _color(226, 82, 74) if unsure else _color(255, 255, 255)
            markers.append({**common, "pose": _pose(above), "color": color, **lettering})
        return self._types.new(MARKERS, markers=markers)


def _triangles(entry: CatalogueObject) -> dict[str, Any]:
    """Corners of all triangles, with their colours."""
    mesh = entry.simplified(TRIANGLES)
    corners = mesh.faces.ravel()
    points, colors = mesh.vertices[corners].tolist(), mesh.colors[corners].tolist()
    return {
        "points": [{"x": x, "y": y, "z": z} for x, y, z in points],
        "colors": [_color(*color) for color in colors],
    }


def _header(stamp_ns: int, frame: str) -> dict[str, Any]:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def _placed(parent: str, child: str, T: Pose, stamp_ns: int) -> dict[str, Any]:
    pose = _pose(T)
    place = {"translation": pose["position"], "rotation": pose["orientation"]}
    return {"header": _header(stamp_ns, parent), "child_frame_id": child, "transform": place}


def _pose(T: Pose) -> dict[str, Any]:
    x, y, z = T[:3, 3].tolist()
    i, j, k, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": i, "y": j, "z": k, "w": w}}


def _covariance(item: ObjectPose) -> Any:
    """6 x 6, row by row: x, y, z, then turns about them; the spread of all directions, a third for each."""
    variances = [item.spread_metres**2 / 3] * 3 + [item.spread_radians**2 / 3] * 3
    return np.diag(variances).ravel()


def _color(red: int, green: int, blue: int) -> dict[str, float]:
    return {"r": red / 255, "g": green / 255, "b": blue / 255, "a": 1.0}


def _corners(entry: CatalogueObject) -> Any:
    """8 x 3: corners of the enclosing box in the object frame."""
    low, high = entry.bounds
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
