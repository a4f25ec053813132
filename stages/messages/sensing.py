"""Looking: a request, the simulator's answer and the RGB-D frame."""

from typing import ClassVar

from runner.contract import Message, Struct
from stages.messages.arrays import Depth, Intrinsics, Mask, Pose, Poses, Rgb, Vector


class LookRequest(Message, frozen=True, kw_only=True):
    """Asks the camera for one frame. Everything perceived from that frame hangs on this request."""

    starts_lineage: ClassVar[bool] = True
    purpose: str
    """Shown to people, for example ``goal``, ``start`` or ``after transfer 2``."""
    view: int = 0
    """Where the camera is wanted: 0 while the arm is at home, else the number of a view of the robot's description."""


class SensorErrors(Struct, frozen=True, kw_only=True):
    """What is wrong with the simulated camera and the encoders, and what the robot does not know."""

    depth: float
    """Factor on all depths."""
    T_believed_true: Pose
    """Where the camera is, in the frame in which it is said to be."""
    T_color_depth: Pose
    """Where the depth camera is, in the colour camera's frame, though depth is said to be registered to colour."""
    joints: Vector
    """How far each joint is beyond what its encoder says, in the order of ``joint_names``."""
    gains: Vector
    """Factors on red, green and blue: exposure and white balance."""


class Snapshot(Message, frozen=True, kw_only=True):
    """The simulated world at one instant, for the simulated camera to render and the report to score.

    Holds the simulator's truth: no stage that perceives, plans or acts may consume it.
    """

    names: tuple[str, ...]
    T_base_objects: Poses
    joint_names: tuple[str, ...]
    joint_positions: Vector
    """What the encoders say."""
    time: float
    """Simulated seconds."""
    purpose: str = ""
    T_base_table: Pose | None = None
    """The table's surface: z up, the origin in its middle; None in recordings that are older."""
    table_size: Vector | None = None
    """Its extent along x and y, metres; None in recordings that are older."""
    errors: SensorErrors | None = None
    T_base_board: Pose | None = None
    """The middle of a board to calibrate the camera with, where there is one."""


class Frame(Message, frozen=True, kw_only=True):
    """One RGB-D image, rectified, depth registered to colour."""

    rgb: Rgb
    depth: Depth
    K: Intrinsics
    T_base_camera: Pose | None
    """Where the camera is; None where the source does not know (data sets of images)."""
    robot_mask: Mask | None
    """True where the robot's own body is in the image, from its encoders and meshes."""
    name: str
    index: int
    total: int
    """How many frames the source will send in all; 0 where it does not end."""
    scene_id: int = 0
    image_id: int = 0
    n_objects: int | None = None
    """Number of objects where the source knows it (a data set's targets)."""
    stamp_ns: int = 0
    """When the image was taken, nanoseconds by the camera's clock; 0 where the source does not say."""
