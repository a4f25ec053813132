"""A camera of ROS 2 nodes: a driver publishes, a stage looks; what can go wrong, and how it shows."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from runner.contract import Refused
from runner.testing import run_stage
from stages.camera import Ros2Camera
from stages.devices.ros2.node import Node
from stages.devices.ros2.settings import Link, Patience, Source
from stages.devices.ros2.wire import SENSOR, Qos
from stages.messages import Frame, LookRequest
from tests.stages.devices.ros2.bags import CAMERA, SOURCE, compressed, image, info, png, transform
from tests.stages.devices.ros2.lab import free_port, node, open_router, router

K = np.array([[50.0, 0, 15.5], [0, 50.0, 11.5], [0, 0, 1]])
RGB = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
MILLIMETRES = np.random.default_rng(1).integers(400, 2000, (24, 32)).astype(np.uint16)
SHORT = Patience(warn=0.3, give_up=2.0, settle=0.1)
LONG = Patience(warn=0.3, give_up=30.0, settle=0.1)
COMPRESSED = Source(color=f"{SOURCE.color}/compressed", depth=f"{SOURCE.depth}/compressedDepth")


class Driver:
    """A camera driver at 30 Hz; its parts can be taken away and changed while it runs."""

    def __init__(self, node: Node, source: Source = SOURCE) -> None:
        self.source = source
        self.color: Callable[[int], Any] = lambda stamp: image(RGB, "rgb8", stamp)
        self.depth: Callable[[int], Any] | None = lambda stamp: image(MILLIMETRES, "16UC1", stamp)
        self.x: Callable[[float], float] | None = lambda now: 0.5
        self.behind = 0.0
        """Seconds by which the stamps are."""
        self.late = 0.0
        """Seconds by which the newest transform is older than the newest image."""
        kind = "sensor_msgs/msg/CompressedImage" if source is COMPRESSED else "sensor_msgs/msg/Image"
        self._publishers = {
            "color": node.publisher(source.color, kind, SENSOR),
            "depth": node.publisher(source.depth, kind, SENSOR),
            "info": node.publisher(source.info, "sensor_msgs/msg/CameraInfo", SENSOR),
            "tf": node.publisher("/tf", "tf2_msgs/msg/TFMessage", Qos(depth=100)),
        }
        mount = node.publisher("/tf_static", "tf2_msgs/msg/TFMessage", Qos(latched=True, depth=1))
        mount.put(transform("arm", CAMERA, np.eye(4)))
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.wait(1 / 30):
            stamp = time.time_ns() - int(self.behind * 1e9)
            if self.x is not None:
                T = np.eye(4)
                T[0, 3] = self.x(time.monotonic())
                self._publishers["tf"].put(transform("base_link", "arm", T, stamp - int(self.late * 1e9)))
            self._publishers["info"].put(info(K, (24, 32)))
            self._publishers["color"].put(self.color(stamp))
            if self.depth is not None:
                self._publishers["depth"].put(self.depth(stamp))


@contextlib.contextmanager
def driver(endpoint: str, source: Source = SOURCE) -> Iterator[Driver]:
    with node(endpoint, "driver") as one:
        running = Driver(one, source)
        try:
            yield running
        finally:
            running.stop()


def look(
    endpoint: str, patience: Patience = LONG, source: Source = SOURCE, then: Callable[[], object] = lambda: None
) -> tuple[Frame, list[str]]:
    """A look, and what the stage says until it has one; ``then`` happens each time that it says something."""
    said: list[str] = []

    def log(text: str, level: str) -> None:
        said.append(text)
        then()

    camera = Ros2Camera(Ros2Camera.Config(link=Link(router=endpoint), topics=source, patience=patience))
    try:
        (frame,) = run_stage(camera, [LookRequest(purpose="goal")], log=log)
    finally:
        camera.close()
    return frame, said


def test_a_look_is_the_next_image() -> None:
    with router() as endpoint, driver(endpoint):
        asked = time.time_ns()
        frame, said = look(endpoint, Patience(warn=30.0, give_up=30.0, settle=0.1))
    assert frame.stamp_ns > asked and said == []
    assert np.array_equal(frame.rgb, RGB)
    assert np.array_equal(np.round(frame.depth * 1000), MILLIMETRES)
    assert np.array_equal(frame.K, K)
    assert frame.T_base_camera is not None and frame.T_base_camera[:3, 3].tolist() == [0.5, 0, 0]
    assert (frame.name, frame.index, frame.total) == ("goal", 0, 0)


def test_compressed_topics() -> None:
    with router() as endpoint, driver(endpoint, COMPRESSED) as camera:
        camera.color = lambda stamp: compressed(png(RGB[:, :, ::-1]), "rgb8; png compressed bgr8", stamp)
        camera.depth = lambda stamp: compressed(bytes(12) + png(MILLIMETRES), "16UC1; compressedDepth png", stamp)
        frame, _ = look(endpoint, source=COMPRESSED)
    assert np.array_equal(frame.rgb, RGB) and np.array_equal(np.round(frame.depth * 1000), MILLIMETRES)


def test_a_packet_that_is_broken_costs_one_look_and_the_next_is_taken() -> None:
    said: list[str] = []
    with router() as endpoint, driver(endpoint, COMPRESSED) as one:
        whole = bytes(12) + png(MILLIMETRES)
        one.color = lambda stamp: compressed(png(RGB[:, :, ::-1]), "rgb8; png compressed bgr8", stamp)
        one.depth = lambda stamp: compressed(whole if said else whole[:40], "16UC1; compressedDepth png", stamp)
        config = Ros2Camera.Config(link=Link(router=endpoint), topics=COMPRESSED, patience=LONG)
        camera = Ros2Camera(config)
        (frame,) = run_stage(camera, [LookRequest(purpose="goal")], log=lambda text, level: said.append(text))
        camera.close()
    assert np.array_equal(np.round(frame.depth * 1000), MILLIMETRES)
    assert f"no look yet: {COMPRESSED.depth}: 28 bytes of format '16UC1; compressedDepth png' are no image" in said


def test_a_camera_that_moves_is_waited_for() -> None:
    with router() as endpoint, driver(endpoint) as camera:
        stops = time.monotonic() + 1.5
        camera.x = lambda now: 0.2 * min(now - stops, 0)
        frame, said = look(endpoint)
    assert frame.T_base_camera is not None and abs(frame.T_base_camera[0, 3]) < 1e-3
    assert f"no look yet: the camera, frame '{CAMERA}', moves" in said


def test_transforms_that_come_late_are_waited_for_never_guessed() -> None:
    with router() as endpoint, driver(endpoint) as camera:
        camera.late = 0.5
        frame, said = look(endpoint)
    assert time.time_ns() - frame.stamp_ns > 0.4e9, "the image of which the transform has come"
    assert all("base_link to arm is not known at" in line for line in said)


def stop_transforms(camera: Driver) -> None:
    camera.x = None


@pytest.mark.parametrize(
    ("stop", "says"),
    [
        (Driver.stop, f"{SOURCE.color}: is published, but no message has come for [0-9.]+ s"),
        (stop_transforms, "base_link to arm is not known at .*: it is from .* to "),
    ],
)
def test_what_stops_between_two_looks_is_named(stop: Callable[[Driver], None], says: str) -> None:
    with router() as endpoint, driver(endpoint) as running:
        camera = Ros2Camera(Ros2Camera.Config(link=Link(router=endpoint), patience=Patience(give_up=2.0, warn=0.5)))
        assert len(run_stage(camera, [LookRequest(purpose="first")])) == 1
        stop(running)
        with pytest.raises(Refused, match=says):
            run_stage(camera, [LookRequest(purpose="second")], log=lambda text, level: None)
        camera.close()


def test_who_comes_later_is_waited_for() -> None:
    with router() as endpoint, node(endpoint, "driver") as one:
        started: list[Driver] = []
        frame, said = look(endpoint, then=lambda: started or started.append(Driver(one)))
        started[0].stop()
    assert frame.index == 0
    assert said[0] == (f"no look yet: {SOURCE.color}: nobody publishes it; domain 0 at {endpoint} has none")


def test_a_router_that_goes_and_comes_back_costs_no_look() -> None:
    port = free_port()
    first = open_router(port)
    endpoint = f"tcp/127.0.0.1:{port}"
    again: list[Any] = []
    with driver(endpoint):
        camera = Ros2Camera(Ros2Camera.Config(link=Link(router=endpoint), patience=LONG))
        first.close()
        later = threading.Timer(1.0, lambda: again.append(open_router(port)))
        later.start()
        (frame,) = run_stage(camera, [LookRequest(purpose="goal")], log=lambda text, level: None)
        camera.close()
        later.join()
    again[0].close()
    assert frame.name == "goal"


def wrong(camera: Driver, what: str) -> None:
    """Changes one thing about a driver."""
    if what == "no depth":
        camera.depth = None
    elif what == "stale":
        camera.behind = 35.0
    elif what == "no transform":
        camera.x = None
    elif what == "encoding":
        camera.color = lambda stamp: image(MILLIMETRES, "16UC1", stamp)
    elif what == "late depth":
        camera.depth = lambda stamp: image(MILLIMETRES, "16UC1", stamp - 12_000_000)


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("no depth", f"{SOURCE.depth}: is published, but no message has come"),
        (
            "stale",
            f"{SOURCE.color}: the newest stamp is 35.[0-9] s before its arrival; the image is old, or the clocks",
        ),
        ("no transform", f"camera frame '{CAMERA}' of {SOURCE.color}: no transform names frame 'base_link'"),
        ("encoding", f"{SOURCE.color}: encoding '16UC1' is no colour that is read; valid: rgb8"),
        ("late depth", f"no image of {SOURCE.depth} within 0.005 s of one of {SOURCE.color}; the newest stamps are"),
    ],
)
def test_what_is_wrong_is_named(what: str, says: str) -> None:
    with router() as endpoint, driver(endpoint) as camera:
        wrong(camera, what)
        with pytest.raises(Refused, match=says):
            look(endpoint, SHORT)


def test_two_publishers_of_one_topic_are_named() -> None:
    with router() as endpoint, driver(endpoint), node(endpoint, "other") as other:
        other.publisher(SOURCE.depth, "sensor_msgs/msg/Image", SENSOR)
        with pytest.raises(Refused, match=f"{SOURCE.depth}: is published by /driver and /other; a camera is one"):
            look(endpoint, SHORT)


def test_another_type_is_named() -> None:
    with router() as endpoint, driver(endpoint):
        odd = Source(info=SOURCE.color)
        with pytest.raises(Refused, match=f"{SOURCE.color}: /driver publishes sensor_msgs/msg/Image there; wanted is"):
            look(endpoint, SHORT, odd)
