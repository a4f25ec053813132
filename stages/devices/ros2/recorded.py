"""What a recording's looks and scenes are in ROS 2, on the topics on which they would have been published."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from runner.contract import Message
from runner.view.ros2_bag import BagMessage
from stages.devices.ros2.outgoing import Outgoing, Scenes
from stages.devices.ros2.settings import Frames, Link
from stages.devices.ros2.types import Types
from stages.devices.ros2.wire import full_name
from stages.messages import Frame, SceneEstimate, SceneGraph
from stages.scene.catalogue import Catalogue

_Look = tuple[int, int, str]
"""What frame, estimate and scene graph of one look have in common."""


class RecordedScenes:
    """Remembers looks and estimates until their scene graph comes."""

    def __init__(self, catalogue: Catalogue, configs: Mapping[str, Mapping[str, Any]]) -> None:
        """``configs``: the settings of the graph's stages, which may name frames."""
        self._link = Link()
        self._types = Types.of(self._link.distribution)
        self._scenes = Scenes(self._types, catalogue, _frames(configs))
        self._stamps: dict[_Look, int] = {}
        self._estimates: dict[_Look, SceneEstimate] = {}

    def told(self, message: Message, time_ns: int) -> Iterator[BagMessage]:
        """What one message is; a look without a stamp was taken when it was recorded."""
        match message:
            case Frame():
                stamp = self._stamps[_look(message)] = message.stamp_ns or time_ns
                yield from map(self._packed, self._scenes.camera(message, stamp))
            case SceneEstimate():
                self._estimates[_look(message)] = message
            case SceneGraph() if (look := _look(message)) in self._stamps and look in self._estimates:
                yield from map(self._packed, self._scenes.scene(self._estimates[look], message, self._stamps[look]))
            case _:
                pass

    def _packed(self, outgoing: Outgoing) -> BagMessage:
        name = outgoing.message.__msgtype__
        topic = full_name(outgoing.topic, self._link.namespace, self._link.node, {})
        types = self._types
        return BagMessage(topic, name, types.definition(name), types.hash(name), types.encode(outgoing.message))


def _frames(configs: Mapping[str, Mapping[str, Any]]) -> Frames:
    """Those under which a graph publishes; where it does not, the base among its camera's transforms."""
    groups = [group for config in configs.values() for group in config.values() if isinstance(group, Mapping)]
    for group in groups:
        if set(group) == {"base", "camera"}:
            return Frames(**group)
    bases = [group["base_frame"] for group in groups if "base_frame" in group]
    return Frames(base=bases[0]) if bases else Frames()


def _look(message: Frame | SceneEstimate | SceneGraph) -> _Look:
    return message.scene_id, message.image_id, message.name
