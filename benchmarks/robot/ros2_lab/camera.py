"""The lab's camera: a process of its own that renders what stands there and publishes it 15 times a second.

What moves is rendered as fast as this machine can, which without a graphics card is about once a second.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import cv2
import numpy as np

from benchmarks.robot.ros2_lab.bench import ROBOT
from benchmarks.robot.ros2_lab.wire import Interfaces, Speaker, stamp, transforms
from stages.devices.simulated_camera import room
from stages.geometry.arrays import Floats
from stages.geometry.poses import exp_so3, pose, random_direction
from stages.perception.rendering.renderer import Camera, Item, Light, Lighting, Renderer
from stages.robots import read_robot
from stages.scene.catalogue import BUILT_IN, Catalogue
from stages.scene.scoring import label_of

FRAME = "camera_color_optical_frame"
_RATE = 15.0
_TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])
"""The robot's own base frame in base_link, which the driver of a UR5e has turned by half a turn."""
_LIGHT = Lighting(
    lights=(Light("directional", (0.3, 0.3, -1.0), 2.0), Light("directional", (0.5, -0.5, -0.6), 1.3)),
    ambient=(0.38, 0.38, 0.38),
)
_CALIBRATED = 0.001, np.deg2rad(0.1)
"""Metres and radians by which a calibration leaves a camera beside where it is said to be."""
_REGISTERED = 0.001, np.deg2rad(0.1)
"""The same for depth that is registered to colour: about a pixel."""
_COLOR_NOISE, _DEPTH_NOISE = 2.0, 0.0008
"""Grey values; metres at one metre, growing with the square of the distance."""
_EDGE, _LOST = 0.02, 0.003
"""Metres between neighbours from which on there is no reading, and the share that is lost anywhere."""


@dataclass(frozen=True)
class Errors:
    """What is wrong with a calibrated camera; drawn by the seed, always the same."""

    T_said_true: Floats
    T_color_depth: Floats

    @staticmethod
    def draw(seed: int) -> Errors:
        rng = np.random.default_rng([seed, 77])
        return Errors(
            *(
                pose(exp_so3(turn * random_direction(rng)), metres * random_direction(rng))
                for metres, turn in (_CALIBRATED, _REGISTERED)
            )
        )


def serve(seed: int, endpoint: str, pipe: Connection) -> None:
    """Publishes until it is ended; asks the pipe for what is to be seen."""
    node = Speaker(endpoint, "camera", Interfaces())
    robot = read_robot(ROBOT)
    topics = "/camera/camera/color/image_raw", "/camera/camera/aligned_depth_to_color/image_raw"
    color, depth = (node.publisher(topic, "sensor_msgs/msg/Image", reliable=False) for topic in topics)
    info = node.publisher("/camera/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", reliable=False)
    fixed = node.publisher("/tf_static", "tf2_msgs/msg/TFMessage", latched=True)
    T_said = robot.camera.T_link_camera
    assert T_said is not None
    fixed(transforms(node.new, "base_link", {"base": _TURNED, FRAME: _TURNED @ T_said}))
    eye, shown, due = Eye(seed), -1, time.monotonic()
    while True:
        pipe.send("picture")
        version, at_ns, joints, objects = pipe.recv()
        if version != shown:
            eye.look(joints, objects)
            shown = version
        rgb, millimetres = eye.image()
        header = {"stamp": stamp(at_ns), "frame_id": FRAME}
        info(_info(node.new, header, robot.camera.K, robot.camera.size))
        color(image_of(node.new, header, rgb, "rgb8"))
        depth(image_of(node.new, header, millimetres, "16UC1"))
        now = time.monotonic()
        due = max(due + 1 / _RATE, now)
        time.sleep(due - now)


class Eye:
    """Renders the scene where it has changed, and gives it new noise each time."""

    def __init__(self, seed: int) -> None:
        self._robot, self._catalogue = read_robot(ROBOT), Catalogue.load(BUILT_IN)
        self._errors, self._rng = Errors.draw(seed), np.random.default_rng([seed, 78])
        self._renderer = Renderer(*self._robot.camera.size)
        width, height = self._robot.camera.size
        self._grain = self._rng.normal(0, _COLOR_NOISE, (height, width, 3)).round().astype(np.int16)
        self._waver = self._rng.normal(0, _DEPTH_NOISE, (height, width)).astype(np.float32)
        self._dark = self._rng.random((height, width)) < _LOST
        self._rgb, self._depth = np.zeros((height, width, 3), np.int16), np.zeros((height, width), np.float32)

    def look(self, joints: Floats, objects: dict[str, Floats]) -> None:
        robot = self._robot
        T_said = robot.camera.T_link_camera
        assert T_said is not None
        T_color = T_said @ self._errors.T_said_true
        meshes = [Item(self._catalogue[label_of(name, self._catalogue)].mesh, T) for name, T in objects.items()]
        links = [Item(mesh, T) for mesh, T in robot.links(robot.joint_names, joints)]
        items = [*room(robot.table, robot.floor), *meshes, *links]
        K = robot.camera.K
        self._rgb = self._renderer.color(items, Camera(K, T_color), lighting=_LIGHT, background=(214, 218, 222)).astype(
            np.int16
        )
        depth = self._renderer.depth(items, Camera(K, T_color @ self._errors.T_color_depth)).astype(np.float32)
        near, far = (apply(depth, np.ones((3, 3), np.uint8)) for apply in (cv2.erode, cv2.dilate))
        self._depth = np.where(far - near > _EDGE * np.maximum(depth, 1), 0, depth)

    def image(self) -> tuple[Any, Any]:
        """Colour (H x W x 3) and depth in millimetres (H x W)."""
        shift = self._rng.integers(0, self._depth.shape)
        grain, waver, dark = (np.roll(one, shift, (0, 1)) for one in (self._grain, self._waver, self._dark))
        rgb = np.clip(self._rgb + grain, 0, 255).astype(np.uint8)
        depth = np.where(dark | (self._depth == 0), 0, self._depth + waver * self._depth**2)
        return rgb, np.round(1000 * depth).astype(np.uint16)


def image_of(new: Interfaces, header: Any, pixels: Any, encoding: str) -> Any:
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
    return new(
        "sensor_msgs/msg/Image", header=header, height=height, width=width, encoding=encoding,
        step=len(data) // height, data=data,
    )  # fmt: skip


def _info(new: Interfaces, header: Any, K: Floats, size: tuple[int, int]) -> Any:
    given = {"k": K.ravel(), "r": np.eye(3).ravel(), "p": np.column_stack([K, np.zeros(3)]).ravel(), "d": np.zeros(5)}
    return new(
        "sensor_msgs/msg/CameraInfo",
        header=header,
        width=size[0],
        height=size[1],
        distortion_model="plumb_bob",
        **given,
    )
