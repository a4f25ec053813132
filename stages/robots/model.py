"""How a robot's model is described: its files, what is changed in them, and its servos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Part:
    """A model that is put together with others: an MJCF or URDF file, or MJCF text."""

    file: Path
    """The file, or the folder in which the text's files are."""
    text: str = ""
    """MJCF that may include files; empty where the file is the model."""
    without: str = ""
    """Left out of all names."""
    on: str = ""
    """Site or link of an earlier part that this one is mounted on; empty where it stands in the base frame."""
    prefix: str = ""
    """Put before all names of this part."""
    packages: Path = Path()
    """Where the packages lie whose meshes a URDF names (``package://NAME/...``)."""


@dataclass(frozen=True)
class Servo:
    """A position servo of a joint; N m (N), N m s/rad (N s/m), kg m^2 (kg) with the gear train."""

    kp: float
    kv: float
    effort: float
    armature: float
    damping: float = 0.0


@dataclass(frozen=True)
class Model:
    """How the robot's model comes about."""

    parts: tuple[Part, ...]
    removed: tuple[str, ...]
    """Bodies and joints that are taken out."""
    changed: Mapping[str, Mapping[str, Mapping[str, Any]]]
    """Attributes by kind (body, joint, geom) and name, as MJCF calls them."""
    touching: tuple[tuple[str, str], ...]
    """Pairs of links whose shapes overlap in every posture."""
    servos: Mapping[str, Servo]
    """Of joints that the files give no actuator."""
    fingers: tuple[str, str]
    """Joints that each move one finger."""
    finger_servo: Servo | None
    """The same for each finger, which are then coupled as well."""
    pads: tuple[str, ...]
    """Geoms that touch what is grasped: of rubber."""
