"""Calibrations in, the robot's description on disk out: the only stage that writes one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import stages
from runner.contract import Context, Finished, Stage
from stages.geometry.arrays import Floats
from stages.messages import CameraCalibration, Mounting
from stages.robots import BUILT_IN, read_robot
from stages.robots.writing import with_camera

_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_PACKAGE = Path(stages.__file__).parent


class Descriptions(Stage):
    """Writes where the camera is into the file that the graph names, or beside the recording where that file comes with
    the package: nobody's robot is that one."""

    device = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """The robot's description; ``scripted`` ends the graph with the first calibration."""

        robot: Path = BUILT_IN
        scripted: bool = True

    def __init__(self, config: Config) -> None:
        self._file, self._scripted = config.robot.resolve(), config.scripted

    def on_start(self) -> Mounting:
        """Says where the camera is by the file as it was: it will be another when the recording is told again."""
        camera = read_robot(self._file).camera
        mounted = np.eye(4) if camera.T_link_camera is None else camera.T_link_camera
        return Mounting(link=camera.link, T_link_camera=mounted)

    def on_camera_calibration(
        self, camera_calibration: CameraCalibration, ctx: Context
    ) -> Iterator[Mounting | Finished]:
        """Writes where the camera was found to be."""
        found = camera_calibration
        if found.success and found.T_link_camera is not None:
            ctx.log(found.reason)
            ctx.log(f"written to {self._write(found, ctx)}")
            ctx.log(f"in ROS 2: static_transform_publisher {_transform(found.camera_link, found.T_link_camera)}")
            yield Mounting(link=found.camera_link, T_link_camera=found.T_link_camera)
        else:
            ctx.log(f"no calibration: {found.reason}", level="warning")
        if self._scripted:
            result = "calibrated" if found.success else "not calibrated"
            yield Finished(code=int(not found.success), reason=f"{result}: {found.reason}")

    def _write(self, found: CameraCalibration, ctx: Context) -> Path:
        assert found.T_link_camera is not None
        day = datetime.fromtimestamp(ctx.time_ns / 1e9).astimezone().strftime("%Y-%m-%d")
        apart, turned = np.median(found.left_out_metres), np.rad2deg(np.median(found.left_out_radians))
        note = (
            f"{day}, {len(found.residuals)} boards, residual {found.residual:.2f} px, "
            f"left out {1e3 * apart:.1f} mm and {turned:.2f} degrees"
        )
        own = not self._file.is_relative_to(_PACKAGE)
        target = self._file if own else ctx.directory / self._file.name
        with_camera(self._file, target, found.camera_link, found.T_link_camera, note)
        return target


def _transform(link: str, T: Floats) -> str:
    """What ROS 2 is told of the camera's optical frame."""
    numbers = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
    told = (f"--{key} {number:.6f}" for key, number in zip(_KEYS, numbers, strict=True))
    return f"{' '.join(told)} --frame-id {link or 'BASE'} --child-frame-id CAMERA_OPTICAL_FRAME"
