"""RGB-D looks of ROS 2 topics: which topics, what belongs together, and the frame that perception takes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.devices.ros2.images import COMPRESSED, IMAGE, color, depth, lens, pinhole
from stages.devices.ros2.settings import Source
from stages.devices.ros2.transforms import NoTransform, Transforms
from stages.messages import Frame

INFO, TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
_WAITING = 60
"""Images without their other half that are kept."""
_MOVED_METRES, _MOVED_TURN = 1e-3, 2e-3
"""Less is standing still; the turn is the greatest change of an entry of the rotation, about radians."""


class Unusable(Exception):
    """A look that cannot be had; one line that names topic or frame and what is wrong."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Colour and depth of one instant: messages, or whatever stands for them."""

    stamp_ns: int
    """Of colour."""
    color: Any
    depth: Any


class Pairs:
    """Puts colour and depth together by their stamps, whichever comes first."""

    def __init__(self, slop: float) -> None:
        self._slop_ns = int(slop * 1e9)
        self._waiting: tuple[OrderedDict[int, Any], OrderedDict[int, Any]] = OrderedDict(), OrderedDict()

    def add(self, stamp: int, image: Any, *, is_depth: bool) -> Pair | None:
        """Takes one half; returns the pair that it completes."""
        own, other = self._waiting[is_depth], self._waiting[not is_depth]
        nearest = min(other, key=lambda one: abs(one - stamp), default=None)
        if nearest is None or abs(nearest - stamp) > self._slop_ns:
            own[stamp] = image
            if len(own) > _WAITING:
                own.popitem(last=False)
            return None
        half = other.pop(nearest)
        return Pair(nearest, half, image) if is_depth else Pair(stamp, image, half)


def image_type(topic: str) -> str:
    """The type of a live image topic, by the name that image transports give it."""
    return COMPRESSED if topic.rpartition("/")[2] in ("compressed", "compressedDepth") else IMAGE


def frame_of(
    source: Source, pair: Pair, info: Any, transforms: Transforms, *, name: str, index: int, total: int
) -> Frame:
    """One look; raises :class:`Unusable` naming what is wrong."""
    K = _read(source.info, lambda: pinhole(info, rectified=source.rectified))
    bent = _read(source.info, lambda: lens(info, K, rectified=source.rectified))
    rgb = _read(source.color, lambda: color(pair.color))
    metres = _read(source.depth, lambda: depth(pair.depth))
    if rgb.shape[:2] != metres.shape:
        raise Unusable(
            f"{source.depth}: {_size(metres)} pixels, but {source.color} has {_size(rgb)}; depth must be registered to "
            "colour"
        )
    own, wanted = pair.depth.header.frame_id, pair.color.header.frame_id
    if own.lstrip("/") != wanted.lstrip("/") and not source.registered:
        raise Unusable(
            f"{source.depth}: is of frame {own!r}, but {source.color} of {wanted!r}; depth must be registered to "
            "colour: choose the aligned topic (align_depth.enable:=true), or set topics.registered=true where it is"
        )
    if (info.height, info.width) != metres.shape:
        raise Unusable(f"{source.info}: speaks of {info.width} x {info.height} pixels, the image has {_size(rgb)}")
    rgb, metres = bent.straighten(rgb, metres)
    return Frame(
        rgb=rgb,
        depth=metres,
        K=K,
        T_base_camera=camera_pose(source, wanted, pair.stamp_ns, transforms),
        robot_mask=None,
        name=name,
        index=index,
        total=total,
        image_id=index,
        stamp_ns=pair.stamp_ns,
    )


def camera_pose(source: Source, camera: str, at_ns: int, transforms: Transforms) -> Any:
    """``T_base_camera`` of a camera's frame at a time; None where there is no base frame."""
    if source.base_frame is None:
        return None
    try:
        return transforms.lookup(source.base_frame, camera, at_ns)
    except NoTransform as error:
        raise Unusable(f"camera frame {camera!r} of {source.color}: {error}") from None


def stood_still(source: Source, camera: str, at_ns: int, transforms: Transforms, settle: float) -> bool:
    """Whether the camera stood for so many seconds where it stands at a time."""
    now, earlier = (camera_pose(source, camera, time, transforms) for time in (at_ns, at_ns - int(settle * 1e9)))
    if now is None:
        return True
    moved = np.abs(now - earlier)
    return bool(moved[:3, 3].max() < _MOVED_METRES and moved[:3, :3].max() < _MOVED_TURN)


def header_stamp(data: bytes) -> int:
    """The stamp in the bytes of a message that begins with a header, without reading the rest."""
    order = "little" if data[1] else "big"
    sec, nanosec = (int.from_bytes(data[start : start + 4], order) for start in (4, 8))
    return sec * 10**9 + nanosec


def _read(topic: str, read: Callable[[], Any]) -> Any:
    try:
        return read()
    except ValueError as error:
        raise Unusable(f"{topic}: {error}") from None


def _size(image: Any) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
