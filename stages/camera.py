"""Looks, from where there are any: the simulated world, data sets, recordings, ROS 2 bags, cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import msgspec
import numpy as np

from runner.contract import Context, Refused, Stage
from stages.devices.ros2.settings import Distribution, Link, Patience, Source
from stages.geometry.arrays import Floats
from stages.geometry.camera import checked_camera_pose
from stages.geometry.lens import INVERSE, PLUMB_BOB, Lens
from stages.hand_eye.board import Board
from stages.messages import Frame, LookRequest, Snapshot
from stages.perception.rendering.depth_noise import color_noise, structured_light
from stages.robots import BUILT_IN, read_robot
from stages.scene.catalogue import Catalogue


class SimulatedCamera(Stage):
    """The simulated robot's camera: renders each snapshot as a structured-light camera would see it that nobody
    calibrated today."""

    device: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """The catalogue and the robot whose meshes are rendered; ``noise: false`` gives perfect images."""

        catalogue: Path
        robot: Path = BUILT_IN
        noise: bool = True
        lens: tuple[float, ...] = ()
        """k1 k2 p1 p2 k3 of a lens that bends the image ..."""
        straighten: bool = True
        """... which is straightened again, as a real camera's is whose lens somebody has measured."""
        board: Board | None = None
        """How the board looks that the world may have."""

    def __init__(self, config: Config) -> None:
        # OpenGL is for this camera only.
        from stages.devices.simulated_camera import SimulatedCamera

        self._noise = config.noise
        self._robot = read_robot(config.robot)
        self._K = self._robot.camera.K
        width, height = self._robot.camera.size
        self._bend = Lens(self._K, (height, width), config.lens, INVERSE)
        self._lens = Lens(self._K, (height, width), config.lens if config.straighten else (), PLUMB_BOB)
        self._camera = SimulatedCamera(Catalogue.shared(config.catalogue), self._robot, config.board)
        self._camera.warm_up()
        self._looks = 0

    @classmethod
    def examine(cls) -> str:
        """Pictures are rendered without a display."""
        from stages.devices.egl import examine_egl

        return examine_egl()

    def on_snapshot(self, snapshot: Snapshot, ctx: Context) -> Frame:
        """The image, which is said to be from where the encoders have the camera."""
        T_base_camera = self._robot.camera_pose(snapshot.joint_names, snapshot.joint_positions)
        shown = snapshot if self._noise else msgspec.structs.replace(snapshot, errors=None)
        rgb, depth = self._bend.straighten(*self._camera.image(shown, T_base_camera))
        if self._noise:
            rgb, depth = color_noise(rgb, ctx.rng), structured_light(depth, self._K, ctx.rng)
        rgb, depth = self._lens.straighten(rgb, depth)
        self._looks += 1
        return Frame(
            rgb=rgb,
            depth=depth,
            K=self._K,
            T_base_camera=T_base_camera,
            robot_mask=self._camera.robot_mask(snapshot, T_base_camera, depth),
            name=snapshot.purpose,
            index=self._looks - 1,
            total=0,
        )

    def close(self) -> None:
        """Frees the renderer."""
        self._camera.close()


class DatasetCamera(Stage):
    """Every image that a BOP data set's targets list, one look each."""

    device: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """A BOP data set folder; at most ``limit`` images (0: all), of which every ``stride``-th row and column."""

        dataset: Path
        limit: int = 0
        stride: int = 1

        def __post_init__(self) -> None:
            if self.limit < 0:
                raise Refused(f"camera.limit = {self.limit}: must be 0 (all images) or more")
            if self.stride < 1:
                raise Refused(f"camera.stride = {self.stride}: must be 1 (all pixels) or more")

    def __init__(self, config: Config) -> None:
        from stages.devices.bop import read_dataset

        images = read_dataset(config.dataset)
        self._images = images[: config.limit or len(images)]
        self._stride = config.stride

    def source(self, ctx: Context) -> Iterator[Frame]:
        """The images in the order of the targets file."""
        kept = slice(None, None, self._stride)
        for index, image in enumerate(self._images):
            rgb, depth = image.read()
            yield Frame(
                rgb=rgb[kept, kept],
                depth=depth[kept, kept],
                K=np.diag([1 / self._stride, 1 / self._stride, 1.0]) @ image.K,
                T_base_camera=None,
                robot_mask=None,
                name=f"{image.scene_id:06d}/{image.image_id:06d}",
                index=index,
                total=len(self._images),
                scene_id=image.scene_id,
                image_id=image.image_id,
                n_objects=image.n_objects,
            )


class RecordedCamera(Stage):
    """The frames of a recording once more, for another graph's perception."""

    device: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """An MCAP file that a runner has written."""

        recording: Path

    def __init__(self, config: Config) -> None:
        from stages.devices.recorded import RecordedFrames

        self._frames = RecordedFrames(config.recording)

    def source(self, ctx: Context) -> Iterator[Frame]:
        """The frames in the order in which they were recorded, counted anew."""
        for index, frame in enumerate(self._frames):
            yield msgspec.structs.replace(frame, index=index, total=len(self._frames))


class BagCamera(Stage):
    """Looks out of a ROS 2 bag, MCAP or sqlite3: chosen times, or everything."""

    device: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """A bag, a folder or a file of it, and its topics."""

        bag: Path
        topics: Source = field(default_factory=Source)
        times: tuple[float, ...] = ()
        """Seconds since the first look of the bag; of each the first look then or later. Empty: all looks."""
        period: float = 0.0
        """Where no times are chosen: at least so many seconds from one look to the next."""
        distribution: Distribution = "jazzy"

        def __post_init__(self) -> None:
            for time in (*self.times, self.period):
                if not time >= 0:
                    raise Refused(f"camera: {time:g} s: times and period must be 0 or more")

    def __init__(self, config: Config) -> None:
        from stages.devices.ros2.bag import Bag

        self._bag = Bag(config.bag, config.topics, config.distribution, times=config.times, period=config.period)

    def source(self, ctx: Context) -> Iterator[Frame]:
        """The looks, by time."""
        if self._bag.left_out:
            ctx.log(f"{len(self._bag.left_out)} looks are left out: {self._bag.left_out[0]}", level="warning")
        yield from (self._bag.look(index) for index in range(len(self._bag)))

    def close(self) -> None:
        """Closes the file."""
        self._bag.close()


class Ros2Camera(Stage):
    """A camera that ROS 2 nodes publish: answers each request with the next image of a camera that stands still."""

    device: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Where the camera is, its topics, and how long to wait for it."""

        link: Link = field(default_factory=lambda: Link(node="scene_camera"))
        topics: Source = field(default_factory=Source)
        patience: Patience = field(default_factory=Patience)

    def __init__(self, config: Config) -> None:
        from stages.devices.ros2.live import LiveCamera

        self._camera = LiveCamera(config.link, config.topics, config.patience)
        self._looks = 0

    def on_look_request(self, look_request: LookRequest, ctx: Context) -> Frame:
        """The image, from where the transforms at its stamp say that the camera is."""
        frame = self._camera.look(
            name=look_request.purpose, index=self._looks, say=lambda text: ctx.log(text, level="warning")
        )
        self._looks += 1
        return frame

    def close(self) -> None:
        """Leaves the ROS graph."""
        self._camera.close()


class RealSenseCamera(Stage):
    """An Intel RealSense camera that answers each request with its next image."""

    device: ClassVar[bool] = True

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Config:
        """Image size, rate and, where several cameras are connected, the serial number."""

        width: int = 640
        height: int = 480
        fps: int = 30
        serial: str = ""
        T_base_camera: tuple[float, ...] = ()
        """Where the colour camera (x right, y down, z forward) stands in the robot's base frame: 4 x 4 row by row,
        metres. Without it scenes have their poses in the table's frame, and nothing is planned in them."""

        def __post_init__(self) -> None:
            for name in ("width", "height", "fps"):
                if getattr(self, name) < 1:
                    raise Refused(f"camera.{name} = {getattr(self, name)}: must be at least 1")
            _camera_pose(self.T_base_camera)

    def __init__(self, config: Config) -> None:
        from stages.devices.realsense import RealSense

        self._T_base_camera = _camera_pose(config.T_base_camera)
        self._camera = RealSense(width=config.width, height=config.height, fps=config.fps, serial=config.serial)
        self._looks = 0

    def on_look_request(self, look_request: LookRequest, ctx: Context) -> Frame:
        """The image, from where the settings say that the camera is."""
        rgb, depth = self._camera.read()
        self._looks += 1
        return Frame(
            rgb=rgb,
            depth=depth,
            K=self._camera.K,
            T_base_camera=self._T_base_camera,
            robot_mask=None,
            name=look_request.purpose,
            index=self._looks - 1,
            total=0,
        )

    def close(self) -> None:
        """Stops streaming."""
        self._camera.close()


def _camera_pose(numbers: tuple[float, ...]) -> Floats | None:
    """The setting as a 4 x 4 matrix; None where there is none.

    Raises:
        Refused: it is no pose, or not in metres.
    """
    if not numbers:
        return None
    if len(numbers) != 16:
        raise Refused(f"camera.T_base_camera has {len(numbers)} numbers; a pose is 16, row by row")
    try:
        return checked_camera_pose(np.reshape(numbers, (4, 4)))
    except ValueError as error:
        raise Refused(f"camera.T_base_camera: {error}") from None
