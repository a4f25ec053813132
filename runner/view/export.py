"""Writes what a recording shows as Foxglove messages in an MCAP file, which Foxglove, Lichtblick and Rerun open.

The drawings are those of ``runner view``. Images become RawImage, cameras CameraCalibration, points PointCloud, places
FrameTransform, meshes and lines SceneUpdate, boxes ImageAnnotations, pages and log lines Log. What Foxglove has no
message for (curves, bars, graphs) becomes JSON. Schemas and encoders are the Foxglove SDK's.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from foxglove import messages as fox
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from runner.graph.graph import Graph
from runner.graph.reading import graph_from_json
from runner.message.codec import LogLine
from runner.recording.container import new_file
from runner.recording.recording import Recording
from runner.view import drawing as d
from runner.view.views import drawn, leaving_out, load_views

STEP_NS = 33_000_000
"""Between the steps of an animation."""
LOGS, SCENE = "/log", "/scene"
LABEL_PIXELS = 12.0
_GREY: d.Color = (180, 180, 180)

Written = tuple[str, Any]
"""A topic, and a Foxglove message or a dict that becomes JSON."""
Head = dict[str, Any]
"""With which most messages begin: ``timestamp`` and ``frame_id``."""


def export(path: Path, target: Path) -> list[str]:
    """Writes a recording's drawings and log; returns lines that say what was written.

    Raises Refused where the file is no recording, its graph has no views or the target exists.
    """
    recording = Recording(path)
    graph = graph_from_json(recording.run["graph"], str(path))
    views = load_views(graph)
    with new_file(target) as output:
        writer = Writer(output, compression=CompressionType.ZSTD)
        sink = _Sink(writer)
        for line in recording.log:
            sink.put([(LOGS, _log_line(line))], line.time_ns)
        _write_drawings(recording, graph, views, sink)
        writer.finish()
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(sink.counts.items()))
    return [f"{path}: {recording.verdict}", f"{target}: {kinds or 'nothing to show'}"]


def _write_drawings(recording: Recording, graph: Graph, views: d.Views, sink: _Sink) -> None:
    """In the order of recording. Animations take time: what follows is never shown before they have ended."""
    scribe = _Scribe()
    now = min((message.log_time_ns for message in recording.messages.values()), default=0)
    sink.put(scribe.written(list(views.static()), now), now)
    for id, message in recording.messages.items():
        now = max(now, message.log_time_ns)
        for number, step in enumerate(drawn(graph, views, recording.envelope(id))):
            now += STEP_NS if number else 0
            sink.put(scribe.written(step, now), now)


class _Sink:
    """An MCAP file of Foxglove messages."""

    def __init__(self, writer: Writer) -> None:
        self.counts: Counter[str] = Counter()
        self._writer = writer
        self._channels: dict[tuple[str, str], int] = {}
        """By topic and kind of message."""
        writer.start(profile="", library="scene-programming")

    def put(self, written: Iterable[Written], time_ns: int) -> None:
        for topic, message in written:
            plain = isinstance(message, dict)
            kind = "JSON" if plain else type(message).__name__
            if (topic, kind) not in self._channels:
                taken = any(other == topic for other, _ in self._channels)
                self._channels[topic, kind] = self._register(f"{topic}.{kind}" if taken else topic, message)
            data = json.dumps(message).encode() if plain else message.encode()
            self._writer.add_message(self._channels[topic, kind], time_ns, data, time_ns)
            self.counts[kind] += 1

    def _register(self, topic: str, message: Any) -> int:
        if isinstance(message, dict):
            schema = self._writer.register_schema("drawing", "jsonschema", b'{"type": "object"}')
            return self._writer.register_channel(topic, "json", schema)
        described = type(message).get_schema()
        schema = self._writer.register_schema(described.name, described.encoding, described.data)
        return self._writer.register_channel(topic, described.encoding, schema)


class _Scribe:
    """Turns drawings into Foxglove messages; remembers what stands where, for frames and for clearing."""

    def __init__(self) -> None:
        self._frames: set[str] = set()
        """Paths that have been placed."""
        self._standing: dict[str, d.Drawing] = {}

    def written(self, drawings: Sequence[d.Drawing], now: int) -> Iterator[Written]:
        """Places come first: what is drawn below them in the same step is in their frame."""
        self._frames.update(_clean(drawing) for drawing in drawings if isinstance(drawing, d.Transform))
        for drawing in drawings:
            if isinstance(drawing, d.Clear):
                yield from self._cleared(_clean(drawing), now)
            else:
                with leaving_out(drawing.path):
                    written = self._one(drawing, now)
                    self._standing[_clean(drawing)] = drawing
                    yield written

    def _one(self, drawing: d.Drawing, now: int) -> Written:
        path = _clean(drawing)
        places = isinstance(drawing, d.Transform)
        frame = self._frame(path.rpartition("/")[0]) or "root" if places else self._frame(path)
        message = _MESSAGES[type(drawing)](drawing, path, {"timestamp": _stamp(now), "frame_id": frame})
        return _TOPICS.get(type(drawing), f"/{path}"), message

    def _frame(self, path: str) -> str:
        """The nearest place at or above a path; its first part where there is none."""
        parts = path.split("/")
        above = ("/".join(parts[:length]) for length in range(len(parts), 0, -1))
        return next((place for place in above if place in self._frames), parts[0])

    def _cleared(self, path: str, now: int) -> Iterator[Written]:
        gone = [place for place in self._standing if place == path or place.startswith(f"{path}/")]
        for place in gone:
            match self._standing.pop(place):
                case d.Mesh3D() | d.Lines3D():
                    kind = fox.SceneEntityDeletionType.MatchingId
                    deletion = fox.SceneEntityDeletion(timestamp=_stamp(now), type=kind, id=place)
                    yield SCENE, fox.SceneUpdate(deletions=[deletion])
                case d.Points3D():
                    yield self._one(d.Points3D(place, np.zeros((0, 3))), now)
                case d.Boxes2D():
                    yield self._one(d.Boxes2D(place, np.zeros((0, 4))), now)
                case _:
                    pass


def _stamp(time_ns: int) -> fox.Timestamp:
    return fox.Timestamp(*divmod(time_ns, 10**9))


def _clean(drawing: d.Drawing) -> str:
    return drawing.path.strip("/")


def _image(image: d.Image, _: str, head: Head) -> fox.RawImage:
    return _raw_image(image.rgb, "rgba8" if image.rgb.shape[2] == 4 else "rgb8", head)


def _depth(depth: d.DepthImage, _: str, head: Head) -> fox.RawImage:
    """Metres as they are, in 32-bit floats."""
    return _raw_image(np.asarray(depth.depth, np.float32), "32FC1", head)


def _raw_image(pixels: NDArray[Any], encoding: str, head: Head) -> fox.RawImage:
    pixels = np.ascontiguousarray(pixels)
    height, width = pixels.shape[:2]
    step, data = pixels.strides[0], pixels.tobytes()
    return fox.RawImage(**head, width=width, height=height, encoding=encoding, step=step, data=data)


def _boxes(boxes: d.Boxes2D, _: str, head: Head) -> fox.ImageAnnotations:
    stamp = head["timestamp"]
    colors = [_color(color) for color in boxes.colors or (_GREY,) * len(boxes.boxes)]
    corners = boxes.boxes.tolist()
    outlines = [_outline(box, color, stamp) for box, color in zip(corners, colors, strict=True)]
    labels = [
        fox.TextAnnotation(
            timestamp=stamp, position=fox.Point2(x=x, y=y), text=label, font_size=LABEL_PIXELS, text_color=color
        )
        for (x, y, *_), color, label in zip(corners, colors, boxes.labels, strict=False)
    ]
    return fox.ImageAnnotations(timestamp=stamp, points=outlines, texts=labels)


def _outline(box: Sequence[float], color: fox.Color, stamp: fox.Timestamp) -> fox.PointsAnnotation:
    x0, y0, x1, y1 = box
    corners = [fox.Point2(x=x, y=y) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    kind = fox.PointsAnnotationType.LineLoop
    return fox.PointsAnnotation(timestamp=stamp, type=kind, points=corners, outline_color=color, thickness=2)


def _pinhole(camera: d.Pinhole, _: str, head: Head) -> fox.CameraCalibration:
    K = np.asarray(camera.K, np.float64)
    return fox.CameraCalibration(
        **head,
        width=camera.width,
        height=camera.height,
        K=K.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
    )


def _points(points: d.Points3D, _: str, head: Head) -> fox.PointCloud:
    """Each point as three 32-bit floats and four bytes of colour."""
    packed = np.zeros(len(points.positions), np.dtype([("position", "<f4", 3), ("color", "u1", 4)]))
    packed["position"] = points.positions
    packed["color"] = (*_GREY, 255)
    if points.colors is not None:
        packed["color"][:, :3] = points.colors
    number, byte = fox.PackedElementFieldNumericType.Float32, fox.PackedElementFieldNumericType.Uint8
    fields = [fox.PackedElementField(name=name, offset=4 * k, type=number) for k, name in enumerate("xyz")]
    channels = enumerate(("red", "green", "blue", "alpha"))
    fields += [fox.PackedElementField(name=name, offset=12 + k, type=byte) for k, name in channels]
    return fox.PointCloud(
        **head,
        pose=_still(),
        point_stride=packed.itemsize,
        fields=fields,
        data=packed.tobytes(),
    )


def _transform(place: d.Transform, path: str, head: Head) -> fox.FrameTransform:
    x, y, z = place.T[:3, 3].tolist()
    i, j, k, w = Rotation.from_matrix(place.T[:3, :3]).as_quat().tolist()
    return fox.FrameTransform(
        timestamp=head["timestamp"],
        parent_frame_id=head["frame_id"],
        child_frame_id=path,
        translation=fox.Vector3(x=x, y=y, z=z),
        rotation=fox.Quaternion(x=i, y=j, z=k, w=w),
    )


def _mesh(mesh: d.Mesh3D, path: str, head: Head) -> fox.SceneUpdate:
    several = None if mesh.colors is None or isinstance(mesh.colors, tuple) else mesh.colors
    triangles = fox.TriangleListPrimitive(
        pose=_still(),
        points=_points3(mesh.vertices),
        color=_color(mesh.colors if isinstance(mesh.colors, tuple) else _GREY),
        colors=None if several is None else [_color(color) for color in several.tolist()],
        indices=mesh.faces.ravel().tolist(),
    )
    return _entity(path, head, triangles=[triangles])


def _lines(lines: d.Lines3D, path: str, head: Head) -> fox.SceneUpdate:
    strips = [
        fox.LinePrimitive(
            type=fox.LinePrimitiveLineType.LineStrip,
            pose=_still(),
            thickness=2 * lines.radius,
            points=_points3(strip),
            color=_color(lines.color or _GREY),
        )
        for strip in lines.strips
    ]
    return _entity(path, head, lines=strips)


def _entity(path: str, head: Head, **shapes: Any) -> fox.SceneUpdate:
    return fox.SceneUpdate(entities=[fox.SceneEntity(**head, id=path, frame_locked=True, **shapes)])


def _text(text: d.Text, path: str, head: Head) -> fox.Log:
    return fox.Log(timestamp=head["timestamp"], level=fox.LogLevel.Info, name=path, message=text.markdown)


def _log_line(line: LogLine) -> fox.Log:
    level = getattr(fox.LogLevel, line.level.capitalize())
    name = f"{line.stage}.{line.replica}" if line.replica else line.stage
    return fox.Log(timestamp=_stamp(line.time_ns), level=level, name=name, message=line.text)


def _graph(graph: d.Graph, _: str, __: Head) -> dict[str, Any]:
    nodes = [{"name": name, "label": label} for name, label in zip(graph.nodes, graph.labels, strict=True)]
    return {"nodes": nodes, "edges": [list(edge) for edge in graph.edges]}


def _scalar(scalar: d.Scalar, path: str, _: Head) -> dict[str, Any]:
    return {"name": scalar.name or path.rpartition("/")[2], "value": _number(scalar.value)}


def _number(value: float) -> float | None:
    """As JSON has it, which knows no others than finite ones."""
    return float(value) if np.isfinite(value) else None


def _color(color: Sequence[int]) -> fox.Color:
    red, green, blue = (channel / 255 for channel in color[:3])
    return fox.Color(r=red, g=green, b=blue, a=1.0)


def _still() -> fox.Pose:
    """The identity."""
    return fox.Pose(position=fox.Vector3(), orientation=fox.Quaternion(w=1.0))


def _points3(points: d.Floats) -> list[fox.Point3]:
    return [fox.Point3(x=x, y=y, z=z) for x, y, z in np.asarray(points, np.float64).tolist()]


_TOPICS: dict[type, str] = {d.Transform: "/tf", d.Mesh3D: SCENE, d.Lines3D: SCENE}
"""Of drawings whose messages say themselves where they belong; others have the topic of their path."""
_MESSAGES: dict[type, Callable[[Any, str, Head], Any]] = {
    d.Image: _image,
    d.DepthImage: _depth,
    d.Boxes2D: _boxes,
    d.Pinhole: _pinhole,
    d.Points3D: _points,
    d.Transform: _transform,
    d.Mesh3D: _mesh,
    d.Lines3D: _lines,
    d.Text: _text,
    d.Graph: _graph,
    d.Scalar: _scalar,
    d.BarChart: lambda bars, *_: {"values": [_number(value) for value in bars.values]},
}
"""By drawing: makes a Foxglove message, or a dict, of it, its path and its head."""
