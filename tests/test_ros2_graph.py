"""A live camera of ROS 2 nodes in, scenes out, asked for by a service: graphs/ros2.yaml from end to end."""

import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runner.testing import finish, read_until, start_graph
from stages.devices.recorded import RecordedFrames
from stages.devices.ros2.node import Node
from stages.devices.ros2.services import Client
from stages.devices.ros2.wire import SENSOR, Qos
from stages.messages import Frame, Ros2Sent, SceneGraph
from tests.stages.devices.ros2.bags import CAMERA, SOURCE, image, info, transform
from tests.stages.devices.ros2.lab import node, router

ROOT = Path(__file__).parents[1]
T_BASE_CAMERA = np.array([[0, -0.6, 0.8, 0.1], [-1, 0, 0, 0], [0, -0.8, -0.6, 1.1], [0, 0, 0, 1.0]])


def drive(camera: Node, frame: Frame, stopping: threading.Event) -> None:
    """Publishes one image again and again, as a camera does that stands before a table."""
    millimetres = np.round(frame.depth * 1000).astype(np.uint16)
    color, depth = (camera.publisher(topic, "sensor_msgs/msg/Image", SENSOR) for topic in SOURCE.images)
    calibration = camera.publisher(SOURCE.info, "sensor_msgs/msg/CameraInfo", SENSOR)
    camera.publisher("/tf_static", "tf2_msgs/msg/TFMessage", Qos(latched=True, depth=1)).put(
        transform("base_link", CAMERA, T_BASE_CAMERA)
    )
    while not stopping.wait(0.2):
        stamp = time.time_ns()
        calibration.put(info(frame.K, frame.depth.shape))
        color.put(image(frame.rgb, "rgb8", stamp))
        depth.put(image(millimetres, "16UC1", stamp))


@pytest.mark.slow
def test_a_service_call_gives_the_scene_before_the_camera(tmp_path: Path) -> None:
    (frame,) = RecordedFrames(ROOT / "recordings" / "reference.mcap")
    stopping = threading.Event()
    detections: list[Any] = []
    with router() as endpoint, node(endpoint, "camera") as camera, node(endpoint, "lab") as lab:
        driver = threading.Thread(target=drive, args=(camera, frame, stopping))
        driver.start()
        lab.subscribe("/scene_programming/detections", "vision_msgs/msg/Detection3DArray", detections.append)
        settings = (f"camera.link.router={endpoint}", f"ros2.link.router={endpoint}")
        graph = start_graph(ROOT / "graphs" / "ros2.yaml", *settings, folder=tmp_path)
        try:
            printed = read_until(graph, "processes are ready")
            response = Client(lab, "/scene_programming/look", "std_srvs/srv/Trigger").call(seconds=60.0)
        finally:
            graph.terminate()
            stopping.set()
            driver.join()
        run = finish(graph, tmp_path, before=printed)
    assert f"recording {run.recording}: COMPLETE" in run.output, run.output
    (scene,), (seen,), (sent,) = run.messages(SceneGraph), run.messages(Frame), run.messages(Ros2Sent)
    assert response.success and all(item.name in response.message for item in scene.objects)
    assert {"sugar_box", "cup", "soup_can"} <= {item.label for item in scene.objects}
    assert seen.T_base_camera == pytest.approx(T_BASE_CAMERA) and scene.frame == "base"
    assert {one.id for one in detections[0].message.detections} == {item.name for item in scene.objects}
    assert {one.topic for one in sent.messages} >= {"/scene_programming/detections", "/scene_programming/look", "/tf"}
    command = [sys.executable, "-m", "runner.cli", "replay", str(run.recording), "--verify"]
    replay = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert replay.returncode == 0 and "IDENTICAL" in replay.stdout, replay.stdout + replay.stderr
