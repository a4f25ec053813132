"""What a view shows, in neutral terms: drawings and a layout, mapped to a viewer by :mod:`runner.view.rerun_view`.

A graph file names a class (``view: stages.views:Views``) that turns messages into drawings; it is the
:class:`Views` protocol below. Drawings are values and know nothing of the viewer.

Paths are entity paths with slashes (``"camera/rgb"``). A drawing replaces what stood at its path before,
from the current step on. Three-dimensional drawings live in the frame of the nearest :class:`Transform`
above them: ``Transform("world/cup", T)`` moves ``Mesh3D("world/cup/mesh", ...)``. Lengths are metres,
pixels are OpenCV's (pixel centres at integer coordinates), colours are sRGB bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from runner.contract import Message

Floats = NDArray[np.floating[Any]]
Bytes = NDArray[np.uint8]
Color = tuple[int, int, int]


class Drawing(msgspec.Struct, frozen=True):
    """What stands at a path."""

    path: str


class Image(Drawing, frozen=True):
    """A colour image. Images below one path are laid over each other; a lower ``opacity`` lets the other show."""

    rgb: Bytes
    """H x W x 3, or H x W x 4 with an alpha channel (0 is transparent)."""
    opacity: float = 1.0


class DepthImage(Drawing, frozen=True):
    """A depth image, coloured by distance. Below a :class:`Pinhole` it also becomes a point cloud in space."""

    depth: Floats
    """H x W, metres along the optical axis, 0 where there is no reading."""
    nearest: float | None = None
    """Metres of the colour map's ends; the image's own extremes by default."""
    farthest: float | None = None


class Boxes2D(Drawing, frozen=True):
    """Axis-aligned boxes over an image, each with a label."""

    boxes: Floats
    """N x 4: x0, y0, x1, y1 in pixels, x1 and y1 exclusive."""
    labels: tuple[str, ...] = ()
    colors: tuple[Color, ...] = ()
    """One per box, or none for the viewer's choice."""


class Pinhole(Drawing, frozen=True):
    """Makes ``path`` a camera: what lies below it is its image; z forward, x right, y down."""

    K: Floats
    """3 x 3, pixels."""
    width: int
    height: int


class Transform(Drawing, frozen=True):
    """Places ``path`` and everything below it in the frame above."""

    T: Floats
    """4 x 4, ``T_parent_path``."""


class Mesh3D(Drawing, frozen=True):
    """Triangles in the frame of ``path``."""

    vertices: Floats
    """V x 3, metres."""
    faces: NDArray[np.integer[Any]]
    """F x 3, counter-clockwise seen from outside."""
    colors: Bytes | Color | None = None
    """V x 3, or one colour for all."""


class Points3D(Drawing, frozen=True):
    """Points in the frame of ``path``."""

    positions: Floats
    """N x 3, metres."""
    colors: Bytes | Color | None = None
    """N x 3, or one colour for all."""
    radius: float = 0.003
    """Metres."""


class Lines3D(Drawing, frozen=True):
    """Polylines in the frame of ``path``."""

    strips: tuple[Floats, ...]
    """Each N x 3, metres."""
    color: Color | None = None
    radius: float = 0.002
    """Metres."""


class Text(Drawing, frozen=True):
    """A page of Markdown."""

    markdown: str


class Graph(Drawing, frozen=True):
    """A graph of labelled nodes."""

    nodes: tuple[str, ...]
    """Unique names."""
    labels: tuple[str, ...]
    """One per node."""
    edges: tuple[tuple[str, str], ...]
    """Directed, by node name."""
    colors: tuple[Color, ...] = ()
    """One per node, or none for the viewer's choice."""
    positions: Floats | None = None
    """N x 2, x right and y down in pixels; laid out by the viewer by default."""


class Scalar(Drawing, frozen=True):
    """One value of a curve over steps."""

    value: float
    name: str = ""
    """In the legend; the path's last part by default."""


class BarChart(Drawing, frozen=True):
    """One bar per value."""

    values: Floats
    """Length N."""
    color: Color | None = None


class Clear(Drawing, frozen=True):
    """Removes what stands at ``path`` and below it."""


class NextStep(Drawing, frozen=True):
    """What follows is shown one step later: yielded between the frames of an animation, as a filter's iterations."""

    path: str = ""


PanelKind = Literal["image", "space", "graph", "text", "bars", "series"]


class Panel(msgspec.Struct, frozen=True):
    """One view on the drawings at and below ``origin``; ``contents`` adds or restricts what it shows.

    ``contents`` are path expressions relative to the root: ``"/world/**"`` includes a subtree and
    ``"- /world/particles/**"`` excludes one. Empty shows everything below ``origin``.
    """

    name: str
    kind: PanelKind
    origin: str
    contents: tuple[str, ...] = ()
    eye: tuple[float, float, float] | None = None
    """Where a space is looked at from, in the frame of ``origin``, metres; the viewer's choice by default."""
    target: tuple[float, float, float] | None = None
    """The point in its middle."""


class Row(msgspec.Struct, frozen=True):
    """Layouts side by side; ``shares`` are relative widths, equal by default."""

    parts: tuple[Layout, ...]
    shares: tuple[float, ...] = ()


class Column(msgspec.Struct, frozen=True):
    """Layouts above each other; ``shares`` are relative heights, equal by default."""

    parts: tuple[Layout, ...]
    shares: tuple[float, ...] = ()


class Tabs(msgspec.Struct, frozen=True):
    """Layouts behind tabs, the first one open."""

    parts: tuple[Layout, ...]


Layout = Panel | Row | Column | Tabs


class Views(Protocol):
    """Turns the messages of a graph into drawings. Lives in its own process and may remember what it saw."""

    def __init__(self, configs: Mapping[str, Mapping[str, Any]]) -> None:
        """``configs`` holds every stage's settings by stage name, as the graph ran with them."""
        ...

    def layout(self) -> Layout:
        """How the panels are arranged."""
        ...

    def static(self) -> Iterable[Drawing]:
        """What is there from the start and never changes, for example a robot's meshes."""
        ...

    def draw(self, message: Message) -> Iterable[Drawing]:
        """What one message shows, in recorded order. Nothing for messages that are not worth a picture."""
        ...
