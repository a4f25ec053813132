"""Puts neutral drawings and layouts onto a Rerun recording stream."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from runner.graph.reading import graph_from_json
from runner.message.codec import Envelope
from runner.view import drawing as d
from runner.view.views import drawn, leaving_out, load_views

STEP = "step"
TIME = "time"


class Canvas:
    """One Rerun stream that shows the messages of one graph, with the views that the graph names.

    Its timelines are ``step`` (one step per message or animation frame) and the logical ``time``.
    """

    def __init__(self, graph_json: str, path: Path, stream: rr.RecordingStream) -> None:
        """Sends the arrangement of the panels and what never changes.

        ``path`` is the recording's. Raises Refused where the graph has no views.
        """
        self._graph = graph_from_json(graph_json, str(path))
        self._views = load_views(self._graph)
        self._stream = stream
        self._step = -1
        stream.send_blueprint(_blueprint(self._views.layout()), make_active=True, make_default=True)
        for drawing in self._views.static():
            self._put(drawing, static=True)

    def draw(self, sealed: Envelope) -> None:
        """Draws one message on a new step; one without a drawing takes none.

        What cannot be drawn is named on stderr and left out.
        """
        for drawings in filter(None, drawn(self._graph, self._views, sealed)):
            self._step += 1
            self._stream.set_time(STEP, sequence=self._step)
            self._stream.set_time(TIME, duration=np.timedelta64(sealed.time_ns, "ns"))
            for drawing in drawings:
                self._put(drawing)

    def _put(self, drawing: d.Drawing, *, static: bool = False) -> None:
        with leaving_out(drawing.path):
            found = _ARCHETYPES[type(drawing)](drawing)
            for archetype in found if isinstance(found, list) else [found]:
                self._stream.log(drawing.path, archetype, static=static)


def _depth(depth: d.DepthImage) -> rr.DepthImage:
    seen = depth.depth[depth.depth > 0]
    lowest = depth.nearest if depth.nearest is not None else float(seen.min(initial=np.inf))
    highest = depth.farthest if depth.farthest is not None else float(seen.max(initial=0.0))
    extent = (lowest, highest) if lowest < highest else (0.0, 1.0)
    return rr.DepthImage(depth.depth, meter=1.0, colormap="turbo", depth_range=extent)


def _image(image: d.Image) -> rr.Image:
    overlay = image.opacity < 1 or image.rgb.shape[2] == 4
    return rr.Image(image.rgb, opacity=image.opacity, draw_order=-5 if overlay else -10)


def _boxes(boxes: d.Boxes2D) -> rr.Boxes2D:
    corners = np.asarray(boxes.boxes, dtype=np.float64).reshape(-1, 4)
    labels, colors = boxes.labels or None, boxes.colors or None
    return rr.Boxes2D(array=corners, array_format=rr.Box2DFormat.XYXY, labels=labels, colors=colors)


def _pinhole(camera: d.Pinhole) -> rr.Pinhole:
    return rr.Pinhole(
        image_from_camera=camera.K,
        resolution=(camera.width, camera.height),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.3,
    )


def _mesh(mesh: d.Mesh3D) -> rr.Mesh3D:
    one = isinstance(mesh.colors, tuple)
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=_normals(np.asarray(mesh.vertices, np.float64), mesh.faces),
        vertex_colors=None if one else mesh.colors,
        albedo_factor=mesh.colors if one else None,
    )


def _normals(vertices: d.Floats, faces: NDArray[np.integer[Any]]) -> d.Floats:
    """Area-weighted vertex normals, V x 3; without them the viewer draws a mesh unlit."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.zeros_like(vertices)
    for corner in faces.T:
        np.add.at(normals, corner, np.cross(b - a, c - a))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1)


def _graph(graph: d.Graph) -> list[Any]:
    nodes = rr.GraphNodes(graph.nodes, labels=graph.labels, colors=graph.colors or None, positions=graph.positions)
    return [nodes, rr.GraphEdges(graph.edges, graph_type="directed")]


def _scalar(scalar: d.Scalar) -> list[Any]:
    name = scalar.name or scalar.path.rpartition("/")[2]
    return [rr.SeriesLines(names=name), rr.Scalars(scalar.value)]


_ARCHETYPES: dict[type, Callable[[Any], Any]] = {
    d.Image: _image,
    d.DepthImage: _depth,
    d.Boxes2D: _boxes,
    d.Pinhole: _pinhole,
    d.Transform: lambda place: rr.Transform3D(translation=place.T[:3, 3], mat3x3=place.T[:3, :3]),
    d.Mesh3D: _mesh,
    d.Points3D: lambda points: rr.Points3D(points.positions, colors=points.colors, radii=points.radius),
    d.Lines3D: lambda lines: rr.LineStrips3D(list(lines.strips), colors=lines.color, radii=lines.radius),
    d.Text: lambda text: rr.TextDocument(text.markdown, media_type=rr.MediaType.MARKDOWN),
    d.Graph: _graph,
    d.Scalar: _scalar,
    d.BarChart: lambda bars: rr.BarChart(bars.values, color=bars.color),
    d.Clear: lambda _: rr.Clear(recursive=True),
}
"""What Rerun shows each drawing as: one archetype, or several."""

_PANELS: dict[d.PanelKind, Callable[..., Any]] = {
    "image": rrb.Spatial2DView,
    "space": rrb.Spatial3DView,
    "graph": rrb.GraphView,
    "text": rrb.TextDocumentView,
    "bars": rrb.BarChartView,
    "series": rrb.TimeSeriesView,
}


def _blueprint(layout: d.Layout) -> rrb.Blueprint:
    """Follows the ``step`` timeline, with the side panels folded away."""
    return rrb.Blueprint(
        _part(layout),
        rrb.TimePanel(state="collapsed", timeline=STEP, play_state="following"),
        auto_views=False,
        auto_layout=False,
        collapse_panels=True,
    )


def _part(layout: d.Layout) -> Any:
    match layout:
        case d.Panel():
            return _panel(layout)
        case d.Row(parts, shares):
            return rrb.Horizontal(*map(_part, parts), column_shares=shares or None)
        case d.Column(parts, shares):
            return rrb.Vertical(*map(_part, parts), row_shares=shares or None)
        case d.Tabs(parts):
            return rrb.Tabs(*map(_part, parts))


def _panel(panel: d.Panel) -> Any:
    options: dict[str, Any] = {}
    if panel.contents:
        options["contents"] = list(panel.contents)
    if panel.eye is not None:
        options["eye_controls"] = rrb.EyeControls3D(position=panel.eye, look_target=panel.target, eye_up=(0, 0, 1))
    return _PANELS[panel.kind](origin=f"/{panel.origin.strip('/')}", name=panel.name, **options)
