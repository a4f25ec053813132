"""An Intel RealSense camera through pyrealsense2, an optional extra."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from runner.contract import Refused
from stages.geometry.lens import FISHEYE, INVERSE, PLUMB_BOB, Lens
from stages.messages.arrays import Depth, Intrinsics, Rgb

_WARM_UP_FRAMES = 15
"""Frames until exposure and white balance have settled."""
_LENSES = {
    "none": PLUMB_BOB, "brown_conrady": PLUMB_BOB, "modified_brown_conrady": PLUMB_BOB,
    "inverse_brown_conrady": INVERSE, "kannala_brandt4": FISHEYE,
}  # fmt: skip
"""By librealsense's names."""


class RealSense:
    """Colour and depth registered to it, at one size and rate."""

    def __init__(self, *, width: int, height: int, fps: int, serial: str = "") -> None:
        """Starts streaming.

        Raises:
            Refused: pyrealsense2 is not installed, or no such camera answers.
        """
        rs = _library()
        config: Any = rs.config()
        if serial:
            config.enable_device(serial)
        config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, fps)
        config.enable_stream(rs.stream.depth, width, height, rs.format.z16, fps)
        self._pipeline: Any = rs.pipeline()
        profile = _started(self._pipeline, config, rs, serial)
        self._align: Any = rs.align(rs.stream.color)
        self._depth_scale = float(profile.get_device().first_depth_sensor().get_depth_scale())
        stream: Any = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        self.K = _intrinsics(stream)
        self._lens = _lens(stream, self.K)
        for _ in range(_WARM_UP_FRAMES):
            self._pipeline.wait_for_frames()

    def read(self) -> tuple[Rgb, Depth]:
        """The next image: colour (H x W x 3) and depth (H x W, metres, 0 = no reading), the lens taken out."""
        frames = self._align.process(self._pipeline.wait_for_frames())
        rgb = np.array(frames.get_color_frame().get_data(), np.uint8)
        depth = np.array(frames.get_depth_frame().get_data(), np.float64) * self._depth_scale
        return self._lens.straighten(rgb, depth.astype(np.float32))

    def close(self) -> None:
        """Stops streaming."""
        self._pipeline.stop()


def _library() -> Any:
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError:
        raise Refused("the RealSense camera needs pyrealsense2: pip install 'scene-programming[realsense]'") from None


def _started(pipeline: Any, config: Any, rs: Any, serial: str) -> Any:
    try:
        return pipeline.start(config)
    except RuntimeError as error:
        found = [device.get_info(rs.camera_info.serial_number) for device in rs.context().query_devices()]
        wanted = f"serial {serial}" if serial else "any"
        raise Refused(
            f"RealSense camera ({wanted}): {error}; cameras connected: {', '.join(found) or 'none'}"
        ) from None


def _intrinsics(stream: Any) -> Intrinsics:
    return np.array([[stream.fx, 0.0, stream.ppx], [0.0, stream.fy, stream.ppy], [0.0, 0.0, 1.0]])


def _lens(stream: Any, K: Intrinsics) -> Lens:
    name = str(stream.model).rpartition(".")[2]
    if name not in _LENSES:
        raise Refused(f"RealSense camera: its lens is of model {name}; known are {', '.join(_LENSES)}")
    coefficients = stream.coeffs[:4] if _LENSES[name] == FISHEYE else stream.coeffs
    return Lens(K, (stream.height, stream.width), coefficients, _LENSES[name])
