"""Views of the toy messages that use every kind of drawing."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from runner.contract import Message
from runner.view import drawing as d
from tests.runner.common.toys import Answer, Number, Total

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
IMAGE = np.zeros((48, 64, 3), np.uint8)
DEPTH = np.linspace(0, 2, 48 * 64, dtype=np.float32).reshape(48, 64)
BOXES = np.array([[2, 3, 20, 30.0]])


class ToyViews:
    def __init__(self, configs: Mapping[str, Mapping[str, Any]]) -> None:
        self._parts = configs["splitter"]["parts"]

    def layout(self) -> d.Layout:
        images = d.Tabs((d.Panel("Image", "image", "camera"), d.Panel("Depth", "image", "depth")))
        world = d.Panel("World", "space", "world", ("/world/**",), eye=(2, 2, 2), target=(0, 0, 0))
        charts = d.Column((d.Panel("Sum", "series", "sum"), d.Panel("Samples", "bars", "samples")), (2, 1))
        words = d.Column((d.Panel("Graph", "graph", "graph"), d.Panel("Text", "text", "text")))
        return d.Row((images, world, charts, words), (1, 2, 1, 1))

    def static(self) -> Iterable[d.Drawing]:
        yield d.Mesh3D("world/body", TETRAHEDRON, FACES, (200, 60, 60))

    def draw(self, message: Message) -> Iterator[d.Drawing]:
        match message:
            case Number(value=value):
                yield from self._number(value)
            case Answer(index=index):
                if index == self._parts:
                    raise ValueError("an index that cannot be")
            case Total(samples=samples):
                yield d.BarChart("samples", samples)
                for sample in samples:
                    yield d.NextStep()
                    yield d.Scalar("sum", float(sample))
            case _:
                pass

    def _number(self, value: int) -> Iterator[d.Drawing]:
        pose = np.eye(4)
        pose[0, 3] = value
        yield d.Image("camera", IMAGE)
        yield d.Image("camera/overlay", IMAGE, opacity=0.5)
        yield d.DepthImage("depth", DEPTH)
        yield d.Boxes2D("camera/boxes", BOXES, (f"number {value}",), ((255, 0, 0),))
        yield d.Transform("world/moving", pose)
        yield d.Pinhole("world/moving/camera", np.diag([60.0, 60, 1]), 64, 48)
        yield d.Points3D("world/points", TETRAHEDRON, (255, 255, 0))
        yield d.Lines3D("world/line", (TETRAHEDRON,), (0, 255, 0))
        yield d.Clear("world/line")
        yield d.Graph("graph", ("a", "b"), ("A", "B"), (("a", "b"),), ((255, 0, 0), (0, 255, 0)))
        yield d.Text("text", f"# {value}")
