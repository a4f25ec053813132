"""The scene graph: objects, virtual objects and axiomatic assertions (paper, section IV-B)."""

from typing import Literal

from runner.contract import Message, Struct
from stages.messages.arrays import Box, Intrinsics, Pose

Predicate = Literal["exist", "clear", "on", "in", "has"]


class ObjectPose(Struct, frozen=True, kw_only=True):
    """w^j(q^j, v^j): an object of the catalogue at an estimated pose."""

    name: str
    """Unique within its scene: the label, or label_2, label_3, ... for further instances."""
    label: str
    """Name in the catalogue."""
    T_camera_object: Pose
    confidence: float
    """The detector's."""
    cost: float
    """Likelihood cost of this object's best particle (lower is better)."""
    box: Box
    visible: float = 1.0
    """Share of the object's silhouette that nothing else hides, 0 to 1."""


class VirtualObject(Struct, frozen=True, kw_only=True):
    """w^gamma: a region attached to the frame of ``parent`` in which ``child`` belongs."""

    name: str
    parent: str
    child: str
    T_parent_virtual: Pose
    radius: float
    """Metres, horizontally: the region is a disc (a ring where the parent is round)."""


class Assertion(Struct, frozen=True, kw_only=True):
    """One axiom of the scene, for example ``on(clorox, lipton)``. The support plane is ``table``."""

    predicate: Predicate
    arguments: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.predicate}({', '.join(self.arguments)})"


class SceneObject(Struct, frozen=True, kw_only=True):
    """An object of a scene graph and its pose in the robot's base frame (the table's where there is no robot)."""

    name: str
    label: str
    T_base_object: Pose


class SceneGraph(Message, frozen=True, kw_only=True):
    """s_t: everything asserted of one scene."""

    objects: tuple[SceneObject, ...]
    virtual_objects: tuple[VirtualObject, ...]
    assertions: tuple[Assertion, ...]
    T_base_table: Pose
    """The support plane: its z axis is up and its origin lies on the surface."""
    T_base_camera: Pose | None
    K: Intrinsics
    name: str = ""
    scene_id: int = 0
    image_id: int = 0
