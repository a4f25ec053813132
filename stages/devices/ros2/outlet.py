"""What a stage publishes as a ROS 2 node, and the services by which others ask it."""

from __future__ import annotations

import queue
from collections.abc import Iterable
from typing import Any

import numpy as np

from runner.contract import Context
from stages.devices.ros2.node import Node, Publisher
from stages.devices.ros2.outgoing import DETECTIONS, MARKERS, STRING, Scenes
from stages.devices.ros2.rgbd import TF
from stages.devices.ros2.services import Request, serve
from stages.devices.ros2.settings import Frames, Link
from stages.devices.ros2.wire import LATCHED, Qos
from stages.messages import Frame, Ros2Message, SceneEstimate, SceneGraph
from stages.scene.catalogue import Catalogue

TRIGGER = "std_srvs/srv/Trigger"
MOMENT = 0.02
"""Seconds to wait for a request before other work has its turn."""
_TOPICS = {
    "~/detections": (DETECTIONS, Qos()),
    "~/markers": (MARKERS, LATCHED),
    "~/scene_graph": (STRING, LATCHED),
    "/tf": (TF, Qos(depth=100)),
}


class Outlet:
    """A node that publishes scenes and takes requests, until it is closed."""

    def __init__(self, link: Link, frames: Frames, catalogue: Catalogue, services: Iterable[str]) -> None:
        """``services`` are names of Trigger services. Raises Refused where there is no router."""
        self._said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._requests: queue.SimpleQueue[tuple[str, Request]] = queue.SimpleQueue()
        self._node = Node(link, self._said.put)
        self._types = self._node.types
        self._scenes = Scenes(self._types, catalogue, frames)
        self._publishers: dict[str, Publisher] = {
            topic: self._node.publisher(topic, type, qos) for topic, (type, qos) in _TOPICS.items()
        }
        for name in services:
            serve(self._node, name, TRIGGER, lambda request, name=name: self._requests.put((name, request)))

    def publish(self, frame: Frame, estimate: SceneEstimate, graph: SceneGraph, ctx: Context) -> list[Ros2Message]:
        """Sends a scene, stamped as its frame is; returns what was sent. Logs what could not be read meanwhile."""
        while not self._said.empty():
            ctx.log(self._said.get(), level="warning")
        sent: list[Ros2Message] = []
        for one in self._scenes.scene(estimate, graph, frame.stamp_ns or ctx.time_ns):
            publisher = self._publishers[one.topic]
            publisher.put(one.message)
            sent.append(self._kept(publisher.endpoint.topic, one.message))
        return sent

    def request(self) -> tuple[str, Request] | None:
        """The next request and its service; None where none comes in a moment."""
        try:
            return self._requests.get(timeout=MOMENT)
        except queue.Empty:
            return None

    def answer(self, request: Request, *, success: bool, message: str) -> Ros2Message:
        """Answers a request; returns what was sent."""
        response = self._types.new(f"{TRIGGER}_Response", success=success, message=message)
        request.answer(response)
        return self._kept(request.service, response)

    def close(self) -> None:
        """Leaves the ROS graph."""
        self._node.close()

    def _kept(self, topic: str, message: Any) -> Ros2Message:
        data = np.frombuffer(self._types.encode(message), np.uint8)
        return Ros2Message(topic=topic, type=message.__msgtype__, data=data)
