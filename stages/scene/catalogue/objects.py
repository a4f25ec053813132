"""An object of a catalogue: mesh, symmetries, resting poses, grasps and collision geometry."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeVar

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from stages.geometry.arrays import Floats, distinct_rows

Faces = NDArray[np.int32]
GraspKind = Literal["top", "side"]
T = TypeVar("T")

_AGGRESSIVENESS = (3.0, 5.0, 7.0)
"""Of mesh simplification: how fast its tolerance grows."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with a colour per vertex, in the object frame."""

    vertices: Floats
    """V x 3, metres."""
    faces: Faces
    """F x 3, counter-clockwise seen from outside."""
    colors: NDArray[np.uint8]
    """V x 3, sRGB."""


@dataclass(frozen=True)
class Grasp:
    """A way to hold the object, in the order the user prefers."""

    name: str
    kind: GraspKind
    T_object_grasp: Floats
    """4 x 4. Fingertip frame at the grasp: x is the approach direction, y the closing direction, the origin lies
    between the fingertips. The gripper's own link lies further back along x, by its ``reach``."""
    T_object_pregrasp: Floats
    width: float
    """Metres between the fingertips when they touch the object."""


@dataclass(frozen=True)
class Primitive:
    """A convex piece of the collision geometry."""

    kind: Literal["box", "cylinder"]
    size: tuple[float, ...]
    """Full extents of a box (x, y, z), or radius and height of a cylinder along z; metres."""
    T_object_primitive: Floats


@dataclass(frozen=True)
class Symmetries:
    """Symmetries in BOP form, in the object frame."""

    discrete: Floats
    """S x 4 x 4, without the identity."""
    continuous: tuple[tuple[Floats, Floats], ...]
    """(axis, offset) pairs, unit vector and metres."""
    near: Floats
    """N x 4 x 4: poses that look alike in depth but are not the same; they count as errors."""

    def transforms(self, step: float = np.deg2rad(5)) -> Floats:
        """All symmetry transforms, identity first, continuous ones sampled every ``step`` radians; S x 4 x 4.

        Every discrete symmetry is combined with every rotation about a continuous axis, as
        ``get_symmetry_transformations`` of bop_toolkit does.
        """
        discrete = np.concatenate([np.eye(4)[None], self.discrete.reshape(-1, 4, 4)])
        turns = np.concatenate([np.eye(4)[None], *(_turns(axis, offset, step) for axis, offset in self.continuous)])
        return np.einsum("sij,tjk->stik", discrete, turns).reshape(-1, 4, 4)

    def lookalikes(self, step: float = np.deg2rad(5)) -> Floats:
        """The same, then those combined with near symmetries: all turns that depth hardly tells apart, N x 4 x 4."""
        near = np.concatenate([np.eye(4)[None], self.near.reshape(-1, 4, 4)])
        return (near[:, None] @ self.transforms(step)[None]).reshape(-1, 4, 4)


ASYMMETRIC = Symmetries(np.empty((0, 4, 4)), (), np.empty((0, 4, 4)))
"""Of what looks like itself in one pose alone."""


@dataclass(frozen=True)
class CatalogueObject:
    """One kind of object. The frame is the paper's: z points up when the object stands, x when it lies."""

    name: str
    label: int
    """Number in BOP files."""
    mesh: Mesh
    concave: bool
    symmetries: Symmetries
    mass: float
    friction: float
    resting: tuple[Floats, ...]
    """3 x 3 rotations R_table_object in which the object rests on a plane, the upright one first."""
    grasps: tuple[Grasp, ...]
    collision: tuple[Primitive, ...]

    @cached_property
    def bounds(self) -> Floats:
        """2 x 3: lowest and highest corner of the enclosing box in the object frame, metres."""
        return np.stack([self.mesh.vertices.min(0), self.mesh.vertices.max(0)])

    @cached_property
    def dimensions(self) -> Floats:
        """h_x, h_y, h_z of the enclosing box, metres."""
        return self.bounds[1] - self.bounds[0]

    def without_symmetries(self) -> CatalogueObject:
        """The same as one sees it whose label matters."""
        return replace(self, symmetries=ASYMMETRIC)

    def simplified(self, triangles: int) -> Mesh:
        """The mesh with at most about ``triangles`` triangles; deterministic and cached.

        Quadric decimation (Garland and Heckbert 1997); each vertex takes the colour of the nearest original one.
        """
        return self.once(("simplified", triangles), lambda: _decimated(self.mesh, triangles))

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """What ``make`` makes of this object, made once for all that use the object; nobody may change it."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    @cached_property
    def _made(self) -> dict[Hashable, Any]:
        return {}


def _turns(axis: Floats, offset: Floats, step: float) -> Floats:
    """Rotations about a line every ``step`` radians, without the identity; N x 4 x 4."""
    count = int(np.ceil(2 * np.pi / step))
    angles = 2 * np.pi * np.arange(1, count) / count
    turns = np.tile(np.eye(4), (count - 1, 1, 1))
    turns[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
    turns[:, :3, 3] = offset - turns[:, :3, :3] @ offset
    return turns


def _decimated(mesh: Mesh, triangles: int) -> Mesh:
    """Fewer triangles; vertices that a texture seam split are joined first, or the surface would tear there."""
    first, which = distinct_rows(np.round(mesh.vertices * 1e7))
    points, faces = mesh.vertices[first], which[mesh.faces].astype(np.int32)
    if len(faces) <= triangles:
        return mesh
    vertices, faces = _collapsed(points, faces, triangles)
    _, nearest = KDTree(mesh.vertices).query(vertices)
    return Mesh(vertices=vertices, faces=faces, colors=mesh.colors[nearest])


def _collapsed(points: Floats, faces: Faces, triangles: int) -> tuple[Floats, Faces]:
    """Collapses edges as gently as the target allows.

    A can of 500 triangles lies 0.02 mm from the original at aggressiveness 3 and 1.3 mm at the library's default, 7.
    """
    reduced: Any = points, faces
    for aggressiveness in _AGGRESSIVENESS:
        reduced = fast_simplification.simplify(points, faces, target_count=triangles, agg=aggressiveness)
        if len(reduced[1]) <= triangles:
            break
    return np.asarray(reduced[0], np.float64), np.asarray(reduced[1], np.int32)
