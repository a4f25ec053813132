"""Settings of stages that speak with ROS 2; whoever reads a graph loads no more of it than this."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from runner.contract import Refused

Distribution = Literal["jazzy", "kilted", "lyrical"]
DISTRIBUTIONS: tuple[Distribution, ...] = get_args(Distribution)
LAST_DOMAIN = 232
LONGEST = 1e9
"""Seconds: as good as for ever."""
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


@dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """Where the nodes of a lab meet, and who this one is among them."""

    router: str = "tcp/localhost:7447"
    """Endpoint of the Zenoh router: ``tcp/HOST:PORT``, or ``tls/HOST:PORT`` with ``keys``."""
    keys: Path | None = None
    """Folder with ca.pem, cert.pem and key.pem of this machine, as ``runner keys`` writes them."""
    domain: int = 0
    """ROS_DOMAIN_ID."""
    namespace: str = "/"
    node: str = "scene_programming"
    remap: dict[str, str] = field(default_factory=dict[str, str])
    """Other names for topics and services."""
    distribution: Distribution = "jazzy"
    """Of the other nodes: jazzy, kilted or lyrical."""

    def __post_init__(self) -> None:
        """Refuses what is no name and no number of a domain in ROS 2."""
        if not 0 <= self.domain <= LAST_DOMAIN:
            raise Refused(f"link.domain = {self.domain}: must lie between 0 and {LAST_DOMAIN}")
        refuse_odd_name("link.node", f"/{self.node}")
        if self.namespace.strip("/"):
            refuse_odd_name("link.namespace", f"/{self.namespace.strip('/')}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Topics of a camera whose depth is registered to its colour."""

    color: str = "/camera/camera/color/image_raw"
    """Image, or CompressedImage where the name ends in /compressed."""
    depth: str = "/camera/camera/aligned_depth_to_color/image_raw"
    """Image, or CompressedImage where the name ends in /compressedDepth."""
    info: str = "/camera/camera/color/camera_info"
    registered: bool = False
    """Depth is registered to colour though its messages name another frame than those of colour."""
    rectified: bool = False
    """The images are rectified already: their lens is not taken out, and K is that of the projection matrix."""
    slop: float = 0.005
    """Seconds by which the stamps of colour and depth may differ."""
    base_frame: str | None = "base_link"
    """The robot's base among the transforms. None where nobody knows how the camera stands to it: poses are in the
    table's frame, and nothing is planned in them."""

    def __post_init__(self) -> None:
        """Refuses a slop that is no time."""
        _refuse_odd_numbers("topics", self, "slop", zero=True)

    @property
    def images(self) -> tuple[str, str]:
        """The topics of colour and depth."""
        return self.color, self.depth


@dataclass(frozen=True, slots=True, kw_only=True)
class Patience:
    """How long to wait, and for what, seconds."""

    warn: float = 5.0
    """Until it is said why there is no look, and again each time."""
    give_up: float = 60.0
    max_age: float = 1.0
    """Between an image's stamp and its arrival by this machine's clock: more is an image of another time."""
    settle: float = 0.2
    """For so long the camera must have stood where it stands in the image."""

    def __post_init__(self) -> None:
        """Refuses what is no time."""
        _refuse_odd_numbers("patience", self, "warn", "max_age")
        _refuse_odd_numbers("patience", self, "give_up", "settle", zero=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Controllers:
    """Where an arm and its gripper are heard and commanded, and what their joints are called there."""

    joint_states: str = "/joint_states"
    trajectory: str = "/joint_trajectory_controller/follow_joint_trajectory"
    """Action of type control_msgs/action/FollowJointTrajectory."""
    gripper: str = "/gripper_controller/gripper_cmd"
    gripper_type: Literal["GripperCommand", "ParallelGripperCommand"] = "GripperCommand"
    gripper_unit: Literal["joint", "opening"] = "joint"
    """What the gripper is told: a position of the description's first finger joint, or metres between the fingers.
    Joint states always have a position of the joint."""
    gripper_effort: float = 40.0
    """Newtons (newton metres) with which it closes at most."""
    gripper_joint: str = ""
    """Whose position says how far the gripper is open; empty: the first finger joint of the description."""
    joints: dict[str, str] = field(default_factory=dict[str, str])
    """Names in joint states and trajectories of joints that the robot's description calls otherwise."""
    efforts: bool = True
    """Efforts in the joint states are torques with the arm's own weight in them, newton metres; false where they are
    currents or nothing: then no force is felt."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Care:
    """How motions are carried out and when they are given up; seconds, radians (metres)."""

    speed: float = 1.0
    """Share of the planned speed."""
    path_tolerance: float = 0.1
    goal_tolerance: float = 0.03
    """What the controller is told: how far a joint may be from where it should be, on the way and at the end."""
    goal_time: float = 2.0
    """How much longer than planned the controller may take at the end."""
    stale: float = 0.3
    """After so long without a joint state nothing is known of the arm."""
    max_age: float = 1.0
    """Between a joint state's stamp and its arrival."""
    stuck: float = 5.0
    """For how long a motion may make no progress."""
    answer: float = 2.0
    """For how long a controller may owe an answer."""

    def __post_init__(self) -> None:
        """Refuses what would not move, or at once be given up."""
        if not 0 < self.speed <= 1:
            raise Refused(f"care.speed = {self.speed:g}: must be above 0 and at most 1")
        _refuse_odd_numbers(
            "care", self, "path_tolerance", "goal_tolerance", "goal_time", "stale", "max_age", "stuck", "answer"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """Names of frames among the lab's transforms."""

    base: str | None = "base_link"
    """What poses are given in, where it is known how the camera stands to the robot; None where it never is."""
    camera: str = "camera_color_optical_frame"
    """Of the colour camera; else poses are in the table's frame, which hangs on this one."""


def _refuse_odd_numbers(part: str, settings: object, *names: str, zero: bool = False) -> None:
    """Raises Refused where one of a part's settings is no number above 0, or 0 where that is valid."""
    for name in names:
        value = getattr(settings, name)
        if not 0 <= value < LONGEST or (value == 0 and not zero):
            raise Refused(f"{part}.{name} = {value:g}: must be {'0 or more' if zero else 'above 0'}, below {LONGEST:g}")


def refuse_odd_name(place: str, name: str) -> None:
    """Raises Refused where a whole name is none of ROS 2 (https://design.ros2.org/articles/topic_and_service_names.html)."""
    if not _NAME.fullmatch(name):
        raise Refused(f"{place}: {name} is no name in ROS 2; parts have letters, digits and _, and begin with no digit")
