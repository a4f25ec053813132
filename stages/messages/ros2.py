"""What is said to ROS 2 nodes, and asked by them."""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from runner.contract import Message, Spec, Struct

Bytes = Annotated[NDArray[np.uint8], Spec("uint8", ("N",))]


class Ros2Message(Struct, frozen=True, kw_only=True):
    """A message of a topic, or the answer of a service."""

    topic: str
    """Whole name of the topic or the service."""
    type: str
    """``package/msg/Name``, or with ``srv``."""
    data: Bytes
    """XCDR1, as it was sent."""
    time_ns: int = 0
    """When it was sent or had come, by this machine's clock; 0 in recordings that are older."""


class Ros2Sent(Message, frozen=True, kw_only=True):
    """What a stage has published and answered in one step."""

    messages: tuple[Ros2Message, ...]


class Ros2Heard(Message, frozen=True, kw_only=True):
    """What a stage has heard from nodes and acted on."""

    messages: tuple[Ros2Message, ...]


class Asked(Message, frozen=True, kw_only=True):
    """A ROS 2 node has called a service: what the demonstrator shall do."""

    kind: Literal["teach", "restore"]
    name: str
    """Of the goal."""
