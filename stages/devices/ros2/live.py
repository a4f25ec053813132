"""A camera that ROS 2 nodes publish: its newest looks, and why there is none."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from runner.contract import Refused
from stages.devices.ros2.node import Node, Received
from stages.devices.ros2.rgbd import INFO, TF, Pair, Pairs, Unusable, frame_of, image_type, stood_still
from stages.devices.ros2.settings import Link, Patience, Source
from stages.devices.ros2.transforms import Transforms, seconds, stamp_ns
from stages.devices.ros2.wire import SENSOR, Endpoint, Qos
from stages.messages import Frame

_KEPT_SECONDS = 10.0
"""Of motion, and of looks that wait for it to be known."""
_KEPT_LOOKS, _APART_NS = 30, 10**8
"""Looks that wait for their transforms, and nanoseconds between them at least: 3 s of memory."""
_MOVING, _STATIC = Qos(depth=100), Qos(latched=True, depth=100)
"""Of transforms, as tf2 asks for them."""


class LiveCamera:
    """Listens to a camera's topics from the moment it is made until it is closed."""

    def __init__(self, link: Link, source: Source, patience: Patience) -> None:
        """Raises Refused where there is no router."""
        self._source = source
        self._patience = patience
        self._transforms = Transforms(_KEPT_SECONDS)
        self._pairs = Pairs(source.slop)
        self._looks: deque[Pair] = deque(maxlen=_KEPT_LOOKS)
        """Taken and received since a look was asked for."""
        self.pairs = 0
        """Of colour and depth, put together so far."""
        self._info: Any = None
        self._newest: dict[str, tuple[int, int]] = {}
        """By image topic: when its newest message came and what its stamp says, nanoseconds."""
        self._asked_ns = 0
        self._changed = threading.Condition()
        self._said: deque[str] = deque(maxlen=_KEPT_LOOKS)
        self._node = Node(link, self._said.append)
        self._endpoints = [
            self._listen(source.color, image_type(source.color), partial(self._take_image, is_depth=False), SENSOR),
            self._listen(source.depth, image_type(source.depth), partial(self._take_image, is_depth=True), SENSOR),
            self._listen(source.info, INFO, self._take_info, SENSOR),
        ]
        if source.base_frame is not None:
            for topic, qos in (("/tf", _MOVING), ("/tf_static", _STATIC)):
                self._listen(topic, TF, partial(self._take_transforms, static=qos.latched), qos)

    def look(self, *, name: str, index: int, say: Callable[[str], None]) -> Frame:
        """The next image, taken and received from now on, of a camera that stands still; ``say`` takes warnings.

        Raises:
            Refused: for so long there was none that can be read; names topic or frame and what is wrong.
        """
        with self._changed:
            self._looks.clear()
            self._asked_ns = time.time_ns()
        give_up = time.monotonic() + self._patience.give_up
        told, again = "", 0.0
        while True:
            pair = self._wait()
            self._report(say)
            if pair is None:
                why = self._why_none()
            else:
                try:
                    return frame_of(self._source, pair, self._info, self._transforms, name=name, index=index, total=0)
                except Unusable as error:
                    why = str(error)
                    self._drop(pair)
            now = time.monotonic()
            if why and now > give_up:
                raise Refused(why)
            if why and (why != told or now >= again):  # else it has just come, or is as bad as the one before
                say(f"no look yet: {why}")
                told, again = why, now + self._patience.warn

    def close(self) -> None:
        """Leaves the ROS graph."""
        self._node.close()

    def _listen(self, topic: str, type: str, take: Callable[[Received], None], qos: Qos) -> Endpoint:
        def taken(received: Received) -> None:
            with self._changed:
                take(received)
                self._changed.notify_all()

        return self._node.subscribe(topic, type, taken, qos)

    def _take_info(self, received: Received) -> None:
        self._info = received.message

    def _take_transforms(self, received: Received, *, static: bool) -> None:
        self._transforms.add(received.message, static=static)

    def _take_image(self, received: Received, *, is_depth: bool) -> None:
        stamp, now = stamp_ns(received.message.header), time.time_ns()
        self._newest[self._source.images[is_depth]] = now, stamp
        pair = self._pairs.add(stamp, received.message, is_depth=is_depth)
        self.pairs += pair is not None
        if pair is None or pair.stamp_ns < self._asked_ns or _age(now, stamp) > self._patience.max_age:
            return
        if not self._looks or pair.stamp_ns - self._looks[-1].stamp_ns >= _APART_NS:
            self._looks.append(pair)

    def _wait(self) -> Pair | None:
        """The first look that can be used; None where there is none for as long as people wait for a word."""
        with self._changed:
            self._changed.wait_for(self._usable, self._patience.warn)
            return self._usable()

    def _usable(self) -> Pair | None:
        return next((pair for pair in self._looks if not self._trouble(pair)), None)

    def _drop(self, pair: Pair) -> None:
        """Leaves out a look that cannot be read, and those before it: the next one may be whole."""
        with self._changed:
            while self._looks and self._looks[0].stamp_ns <= pair.stamp_ns:
                self._looks.popleft()

    def _trouble(self, pair: Pair) -> str:
        """Why a look is not used, or not yet; empty where it is."""
        if self._info is None:
            return f"{self._source.info}: no message has come"
        frame = pair.color.header.frame_id
        try:
            still = stood_still(self._source, frame, pair.stamp_ns, self._transforms, self._patience.settle)
        except Unusable as error:
            return str(error)
        return self._rivals() or ("" if still else f"the camera, frame {frame!r}, moves")

    def _rivals(self) -> str:
        """A topic that several nodes publish: nobody knows whose image is meant."""
        for endpoint in self._endpoints:
            names = [one.owner.full_name for one in self._node.others("MP", endpoint.topic)]
            if len(names) > 1:
                return f"{endpoint.topic}: is published by {' and '.join(sorted(names))}; a camera is one"
        return ""

    def _why_none(self) -> str:
        """The first thing that is missing."""
        for endpoint in self._endpoints:
            if obstacle := self._node.obstacle(endpoint):
                return obstacle
        with self._changed:
            return self._rivals() or self._silent() or self._unpaired() or self._trouble(self._looks[-1])

    def _silent(self) -> str:
        for topic in self._source.images:
            came, stamp = self._newest.get(topic, (0, 0))
            if came >= self._asked_ns and _age(came, stamp) > self._patience.max_age:
                apart = f"the newest stamp is {(came - stamp) / 1e9:.1f} s before its arrival"
                return f"{topic}: {apart}; the image is old, or the clocks of the machines differ"
            if min(came, stamp) < self._asked_ns:
                quiet = f"for {_age(time.time_ns(), came):.1f} s" if came else "yet"
                return f"{topic}: is published, but no message has come {quiet}"
        return ""

    def _unpaired(self) -> str:
        if self._looks:
            return ""
        color, depth = (seconds(self._newest[topic][1]) for topic in self._source.images)
        return (
            f"no image of {self._source.depth} within {self._source.slop:g} s of one of {self._source.color}; the "
            + (f"newest stamps are {depth} and {color}")
        )

    def _report(self, say: Callable[[str], None]) -> None:
        """What could not be read meanwhile."""
        while self._said:
            say(self._said.popleft())


def _age(now_ns: int, stamp: int) -> float:
    """Seconds between two times, whichever is first."""
    return abs(now_ns - stamp) / 1e9
