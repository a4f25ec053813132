"""ROS 2 messages of a camera, and bags of them, as rosbag2 would record a driver."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from stages.devices.ros2.rgbd import INFO, TF
from stages.devices.ros2.settings import Source
from stages.devices.ros2.types import Types
from stages.messages import Pose, Rgb

TYPES = Types.of("jazzy")
SOURCE = Source()
CAMERA = "camera_color_optical_frame"
START = 1_700_000_000 * 10**9
Stamped = tuple[str, int, Any]
"""Topic, when it was recorded, message."""


def header(stamp_ns: int, frame: str = CAMERA) -> dict[str, Any]:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return {"stamp": TYPES.new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec), "frame_id": frame}


def image(pixels: np.ndarray, encoding: str, stamp_ns: int = START, *, padding: int = 0, frame: str = CAMERA) -> Any:
    """An Image, its lines longer by some bytes of padding."""
    lines = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
    padded = np.pad(lines, ((0, 0), (0, padding)), constant_values=255)
    height, width = pixels.shape[:2]
    return TYPES.new(
        "sensor_msgs/msg/Image",
        header=header(stamp_ns, frame),
        height=height,
        width=width,
        encoding=encoding,
        step=padded.shape[1],
        data=padded.ravel(),
    )


def compressed(data: bytes, format: str, stamp_ns: int = START) -> Any:
    content = np.frombuffer(data, np.uint8)
    return TYPES.new("sensor_msgs/msg/CompressedImage", header=header(stamp_ns), format=format, data=content)


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def info(K: np.ndarray, size: tuple[int, int], **fields: Any) -> Any:
    """CameraInfo of a pinhole camera, height and width first."""
    p = np.column_stack([K, np.zeros(3)])
    given = {"k": K.ravel(), "r": np.eye(3).ravel(), "p": p.ravel(), "distortion_model": "plumb_bob", **fields}
    return TYPES.new(INFO, header=header(START), height=size[0], width=size[1], **given)


def transform(parent: str, child: str, T: Pose, stamp_ns: int = START) -> Any:
    x, y, z = T[:3, 3].tolist()
    i, j, k, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    place = {"translation": {"x": x, "y": y, "z": z}, "rotation": {"x": i, "y": j, "z": k, "w": w}}
    one = TYPES.new(
        "geometry_msgs/msg/TransformStamped", header=header(stamp_ns, parent), child_frame_id=child, transform=place
    )
    return TYPES.new(TF, transforms=[one])


def looks(
    rgb: Rgb, depth: np.ndarray, K: np.ndarray, T_base_camera: Pose | None, stamps: Iterable[int]
) -> list[Stamped]:
    """What a driver publishes: colour, depth in millimetres, intrinsics and where the camera stands."""
    messages: list[Stamped] = [(SOURCE.info, START, info(K, depth.shape))]
    if T_base_camera is not None:
        messages.append(("/tf_static", START, transform("base_link", CAMERA, T_base_camera)))
    millimetres = np.round(depth * 1000).astype(np.uint16)
    for stamp in stamps:
        messages.append((SOURCE.depth, stamp + 2_000_000, image(millimetres, "16UC1", stamp)))
        messages.append((SOURCE.color, stamp + 3_000_000, image(rgb, "rgb8", stamp)))
    return messages


def write_bag(path: Path, messages: Iterable[Stamped], *, storage: Literal["mcap", "sqlite3"] = "mcap") -> Path:
    connections: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        for topic, time_ns, message in messages:
            name = message.__msgtype__
            if topic not in connections:
                definition, hash = TYPES.definition(name), TYPES.hash(name)
                connections[topic] = writer.add_connection(topic, name, msgdef=definition, rihs01=hash)
            writer.write(connections[topic], time_ns, TYPES.encode(message))
    return path


def without(messages: Iterable[Stamped], topic: str) -> list[Stamped]:
    return [one for one in messages if one[0] != topic]


def replaced(messages: Iterable[Stamped], changes: Mapping[str, Any]) -> list[Stamped]:
    return [(topic, time, changes.get(topic, message)) for topic, time, message in messages]
