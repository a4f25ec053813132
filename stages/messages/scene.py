"""The scene graph: objects, virtual objects and axiomatic assertions (paper, section IV-B)."""

from typing import Literal

from runner.contract import Message, Struct
from stages.messages.arrays import Box, Intrinsics, Matrix, Pose, Vector

Predicate = Literal["exist", "clear", "on", "in", "has", "faces"]
Side = Literal["shown", "left", "back", "right"]
"""As an object was shown, or turned from that: a quarter to the left, half, a quarter to the right; seen from above."""
Stance = Literal["upright", "upside down", "lying"]


class Alternative(Struct, frozen=True, kw_only=True):
    """Another pose of an object that explains the image about as well."""

    T_camera_object: Pose
    probability: float
    """Of this pose; what the estimate and all its alternatives leave to 1 is for poses that are not listed."""


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
    probability: float | None = None
    """That the pose is right within 2 cm and 15 degrees, modulo symmetries; None where it was not judged."""
    spread_metres: float = 0.0
    """Standard deviation of the position, all directions together; alternatives far away apart."""
    spread_radians: float = 0.0
    """Standard deviation of the orientation, all axes together, modulo the object's symmetries; alternatives far away
    apart."""
    alternatives: tuple[Alternative, ...] = ()
    """The most probable first."""
    looked_through: float = 0.0
    """Share of the visible silhouette where the reading lies clearly behind the surface, 0 to 1."""
    contradicted: bool = False
    """True where the image shows that the object cannot be there as estimated."""
    facing: float | None = None
    """How likely an object with symmetries also faces as the pose says, its label to that side, if the pose is right
    but for them; small where the image does not show it. None where it has no symmetry, or nobody looked."""


class UnknownRegion(Struct, frozen=True, kw_only=True):
    """Readings above the support plane that no object of the scene explains."""

    box: Box
    points: int
    """Readings in it."""
    centre_table: Vector
    """Centre of the enclosing box of its readings in the table's frame, x, y, z in metres."""
    extent_table: Vector
    """Edges of that box along the table's axes, metres."""


class VirtualObject(Struct, frozen=True, kw_only=True):
    """w^gamma: a region attached to the frame of ``parent`` in which ``child`` belongs."""

    name: str
    parent: str
    child: str
    T_parent_virtual: Pose
    radius: float
    """Metres, horizontally: the region is a disc (a ring where the parent is round)."""


class Assertion(Struct, frozen=True, kw_only=True):
    """One axiom of the scene, for example ``on(clorox, lipton)``. The support plane is ``table``.

    ``faces(clorox, shown)`` is said in goals alone, where somebody chose a :data:`Side`.
    """

    predicate: Predicate
    arguments: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.predicate}({', '.join(self.arguments)})"


class SceneObject(Struct, frozen=True, kw_only=True):
    """An object of a scene graph and its pose."""

    name: str
    label: str
    T_base_object: Pose
    """In the scene's :attr:`SceneGraph.frame`."""
    facing: float | None = None
    """How likely the object also shows the side that the pose says, as :attr:`ObjectPose.facing`, and 1 where its shape
    has no symmetry; None where nobody looked."""
    visible: float = 1.0
    """Share of its silhouette that nothing hid when it was seen last."""
    probability: float | None = None
    """That the pose is right, as :attr:`ObjectPose.probability`."""
    anywhere: bool = False
    """In a goal that was not shown: which side is up is all that the pose says; where the relations hold the object may
    be anywhere."""


class Doubt(Struct, frozen=True, kw_only=True):
    """What a look leaves open, and a person who sees the scene may know."""

    kind: Literal["stance", "unknown", "which"]
    """``stance``: how an object stands. ``unknown``: something is there that no object explains. ``which``: several
    objects may be the one that a goal means."""
    object: str
    """Its name in the scene, or in the goal; empty for what is unknown."""
    stance: Stance = "upright"
    """How the object is taken to stand."""
    T_base_other: Pose | None = None
    """Where the object is if it stands otherwise."""
    choices: tuple[str, ...] = ("yes", "no", "again")
    """What can be answered. ``again`` is one more look; of ``which`` the others are names of the scene."""

    @property
    def key(self) -> str:
        """Equal for doubts that one answer settles."""
        return " ".join(filter(None, (self.kind, self.object, self.stance if self.kind == "stance" else "")))


class SceneGraph(Message, frozen=True, kw_only=True):
    """s_t: everything asserted of one scene.

    Poses are in the robot's base frame. Where nobody knows how the camera stands to it they are in the table's frame,
    whose x and y axes are arbitrary: good for relations, not for a robot.
    """

    objects: tuple[SceneObject, ...]
    virtual_objects: tuple[VirtualObject, ...]
    assertions: tuple[Assertion, ...]
    T_base_table: Pose
    """The support plane: its z axis is up and its origin lies on the surface."""
    T_base_camera: Pose | None
    """None where it is not known."""
    K: Intrinsics
    name: str = ""
    scene_id: int = 0
    image_id: int = 0
    support: Matrix | None = None
    """K x 2, metres: corners of the support surface as far as it was seen, in the table's frame, counter-clockwise."""
    doubts: tuple[Doubt, ...] = ()
    """Where somebody is there to be asked."""
    unknown: tuple[UnknownRegion, ...] = ()
    """What stands there and is no object of the scene, as far as it was seen."""
    contested: tuple[str, ...] = ()
    """Labels, as :attr:`SceneEstimate.contested`."""
    unusable: str = ""
    """Why nothing was to be seen, as :attr:`Observation.unusable`: then no object here is no empty table."""

    @property
    def frame(self) -> Literal["base", "table"]:
        """What the poses are relative to."""
        return "table" if self.T_base_camera is None else "base"
