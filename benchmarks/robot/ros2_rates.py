"""What a live ROS 2 camera costs: `python -m benchmarks.ros2_rates [--seconds 60] [--rate 30] [--waits]`.

A process publishes RGB-D at a rate through a router on loopback; the product's camera puts the halves together. Prints
how many pairs were sent and received, and what that cost of a processor. The publisher leaves out what the network does
not take at once, as those of rmw_zenoh do, so pairs may be lost before anybody could receive them; with ``--waits`` it
does not.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.robot.ros2_lab.camera import image_of
from benchmarks.robot.ros2_lab.wire import Interfaces, Speaker, free_port, open_router, stamp
from stages.devices.ros2.live import LiveCamera
from stages.devices.ros2.settings import Link, Patience, Source

_SIZE = (480, 640)
_SOURCE = Source(base_frame=None)
_AFTER_SECONDS = 1.0
"""Until the last image has come."""


def publish(port: int, options: argparse.Namespace, started: Any, said: Any) -> None:
    """A process with the router, and a camera that begins once somebody listens."""
    router = open_router(port)
    node = Speaker(f"tcp/127.0.0.1:{port}", "camera", Interfaces())
    rng = np.random.default_rng(0)
    rgb, depth = rng.integers(0, 255, (*_SIZE, 3), np.uint8), rng.integers(300, 3000, _SIZE, np.uint16)
    color, registered = (
        node.publisher(one, "sensor_msgs/msg/Image", reliable=False, waits=options.waits) for one in _SOURCE.images
    )
    said.put("ready")
    started.wait()
    time.sleep(1.0)
    began, used = time.monotonic(), time.process_time()
    for number in range(round(options.rate * options.seconds)):
        time.sleep(max(began + number / options.rate - time.monotonic(), 0))
        header = {"stamp": stamp(time.time_ns()), "frame_id": "camera"}
        color(image_of(node.new, header, rgb, "rgb8"))
        registered(image_of(node.new, header, depth, "16UC1"))
    took, used = time.monotonic() - began, time.process_time() - used
    time.sleep(_AFTER_SECONDS)
    said.put((took, used))
    node.close()
    router.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--waits", action="store_true", help="publish all of it, however long it takes")
    options = parser.parse_args(arguments)
    context = multiprocessing.get_context("spawn")
    port, started, said = free_port(), context.Event(), context.Queue()
    count = round(options.rate * options.seconds)
    driver = context.Process(target=publish, args=(port, options, started, said))
    driver.start()
    said.get()
    camera = LiveCamera(Link(router=f"tcp/127.0.0.1:{port}", node="scene_camera"), _SOURCE, Patience())
    used = time.process_time()
    started.set()
    took, theirs = said.get()
    used = time.process_time() - used
    pairs = camera.pairs
    camera.close()
    driver.join()
    print("| pairs sent | in | received | camera's CPU | driver's and router's CPU |\n|---|---|---|---|---|")
    print(f"| {count} | {took:.1f} s | {pairs} | {used:.2f} s, {used / took:.1%} of a core | {theirs:.2f} s |")


if __name__ == "__main__":
    main()
