"""What the joint states say of a robot, and why they cannot be relied on."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.devices.ros2.node import Node, Received
from stages.devices.ros2.settings import Care
from stages.devices.ros2.transforms import stamp_ns
from stages.geometry.arrays import Floats

JOINTS = "sensor_msgs/msg/JointState"
_KEPT = 1000
"""Messages that nobody has taken yet."""
_RIVAL_SECONDS = 1.0
"""Within so long two publishers of one joint are two; later the second has taken the first one's place."""
_SHOWN = 8


@dataclass(frozen=True, slots=True)
class Known:
    """The newest of one joint."""

    position: float
    effort: float
    """NaN where none is given."""
    publisher: bytes
    came: float
    """Monotonic clock, seconds."""
    stamp_ns: int
    behind: float
    """Seconds between stamp and arrival."""


@dataclass(frozen=True, slots=True)
class News:
    """A message, and what was known once it had come."""

    time_ns: int
    message: Any
    joints: tuple[Known, ...]
    """Of the needed joints, in their order; empty where some are not known yet, or the message tells of none."""


class JointStates:
    """Listens to joint states from the moment it is made; several publishers may each tell of some joints."""

    def __init__(self, node: Node, topic: str, needed: Sequence[str], care: Care) -> None:
        """``needed`` are the joints without which nothing may move."""
        self._node, self._needed, self._care = node, tuple(needed), care
        self._known: dict[str, Known] = {}
        self._rivals: dict[str, tuple[float, tuple[bytes, bytes]]] = {}
        """Joints of two publishers: when that was seen, and which they are."""
        self._news: deque[News] = deque(maxlen=_KEPT)
        self._changed = threading.Condition()
        self._endpoint = node.subscribe(topic, JOINTS, self._take)

    def take(self, seconds: float) -> list[News]:
        """What came since the last time; waits for a message for so long."""
        with self._changed:
            self._changed.wait_for(lambda: self._news, seconds)
            news = list(self._news)
            self._news.clear()
        return news

    def trouble(self) -> str:
        """Why the joints are not known now, in a line that names topic and joint; empty where they are."""
        with self._changed:
            known, rivals = dict(self._known), dict(self._rivals)
        topic, now = self._endpoint.topic, time.monotonic()
        missing = [name for name in self._needed if name not in known]
        if missing and (obstacle := self._node.obstacle(self._endpoint)):
            return obstacle
        if missing:
            there = sorted(known)
            names = ", ".join(there[:_SHOWN]) + (f" and {len(there) - _SHOWN} more" if there[_SHOWN:] else "")
            return f"{topic}: says nothing of joint {missing[0]!r}; there are: {names or 'none yet'}"
        for name, (seen, publishers) in rivals.items():
            if now - seen < _RIVAL_SECONDS:
                return f"{topic}: joint {name!r} is published by {self._names(publishers)}; one of them must go"
        for name in self._needed:
            one = known[name]
            if now - one.came > self._care.stale:
                return f"{topic}: nothing of joint {name!r} for {now - one.came:.1f} s"
            if one.behind > self._care.max_age:
                apart = f"the newest stamp is {one.behind:.1f} s before its arrival"
                return f"{topic}: {apart}; it is old, or the clocks of the machines differ"
        return ""

    def positions(self, names: Sequence[str]) -> Floats:
        """Of joints that were heard of, radians (metres)."""
        with self._changed:
            return np.array([self._known[name].position for name in names])

    def efforts(self, names: Sequence[str]) -> Floats:
        """Newton metres (newtons); NaN where they are not given."""
        with self._changed:
            return np.array([self._known[name].effort for name in names])

    def stamp_ns(self, name: str) -> int:
        """When a joint was where it is, by the robot's clock."""
        with self._changed:
            return self._known[name].stamp_ns

    def _names(self, publishers: Sequence[bytes]) -> str:
        by_gid = {one.gid: one.owner.full_name for one in self._node.others("MP", self._endpoint.topic)}
        return " and ".join(sorted(by_gid.get(one, "somebody who has gone") for one in publishers))

    def _take(self, received: Received) -> None:
        message, now, now_ns = received.message, time.monotonic(), time.time_ns()
        stamp = stamp_ns(message.header)
        efforts = message.effort if len(message.effort) == len(message.name) else [math.nan] * len(message.name)
        with self._changed:
            for name, position, effort in zip(message.name, message.position, efforts, strict=False):
                if not math.isfinite(position):
                    continue  # as if it said nothing of the joint, which is named once that is long ago
                before = self._known.get(name)
                if before and before.publisher != received.publisher and now - before.came < _RIVAL_SECONDS:
                    self._rivals[name] = now, (before.publisher, received.publisher)
                self._known[name] = Known(
                    float(position), float(effort), received.publisher, now, stamp, abs(now_ns - stamp) / 1e9
                )
            told = not set(self._needed).isdisjoint(message.name) and self._known.keys() >= set(self._needed)
            joints = tuple(self._known[name] for name in self._needed) if told else ()
            self._news.append(News(now_ns, message, joints))
            self._changed.notify_all()
