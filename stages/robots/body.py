"""The links of a robot: forward kinematics, and how they look."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.geometry.poses import pose
from stages.scene.catalogue import Mesh

_SHOWN = 3
"""Shapes of groups below this are drawn, as MuJoCo's own viewer does; the others are for collisions alone."""
_NO_COLOR = (0.5, 0.5, 0.5, 1.0)
"""What MuJoCo gives a shape of which only the material has a colour."""


class Body:
    """Forward kinematics and shapes of the links of a specification."""

    def __init__(self, specification: mujoco.MjSpec) -> None:
        try:
            self._model: Any = specification.compile()
        except ValueError as error:
            raise Refused(f"robot: MuJoCo cannot build the model with what is only seen: {error}") from error
        self._data: Any = mujoco.MjData(self._model)

    def link_poses(self, joint_names: Sequence[str], positions: Floats) -> dict[str, Floats]:
        """T_base_link (4 x 4) of every link; joints that are not named stay at zero."""
        model, data = self._model, self._data
        data.qpos[:] = model.qpos0
        for name, position in zip(joint_names, positions, strict=True):
            data.joint(name).qpos[0] = position
        mujoco.mj_kinematics(model, data)
        return {model.body(i).name: pose(data.xmat[i].reshape(3, 3), data.xpos[i]) for i in range(1, model.nbody)}

    def turns(self, joint: str) -> bool:
        """Whether a joint is a hinge, not one that slides."""
        return bool(self._model.jnt_type[self._model.joint(joint).id] == mujoco.mjtJoint.mjJNT_HINGE)

    @cached_property
    def meshes(self) -> tuple[tuple[str, Mesh], ...]:
        """(link, mesh in the link's frame) of every shape that is drawn."""
        model = self._model
        shown = [i for i in range(model.ngeom) if model.geom_group[i] < _SHOWN]
        return tuple((model.body(model.geom_bodyid[i]).name, _geom_mesh(model, i)) for i in shown)


def _geom_mesh(model: Any, geom: int) -> Mesh:
    """Triangles of a geom in its body's frame."""
    vertices, faces = _triangles(model, geom)
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.geom_quat[geom])
    vertices = vertices @ R.reshape(3, 3).T + model.geom_pos[geom]
    color = np.round(255 * _color(model, geom)).astype(np.uint8)
    return Mesh(vertices=vertices, faces=faces, colors=np.tile(color, (len(vertices), 1)))


def _color(model: Any, geom: int) -> Floats:
    """Red, green and blue, 0 to 1; of the material where the shape has none of its own."""
    material = model.geom_matid[geom]
    own = material < 0 or not np.allclose(model.geom_rgba[geom], _NO_COLOR)
    return (model.geom_rgba[geom] if own else model.mat_rgba[material])[:3]


def _triangles(model: Any, geom: int) -> tuple[Floats, Any]:
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(model.geom_dataid[geom])
        v, f = mesh.vertadr[0], mesh.faceadr[0]
        vertices = model.mesh_vert[v : v + mesh.vertnum[0]].astype(np.float64)
        return vertices, model.mesh_face[f : f + mesh.facenum[0]].astype(np.int32)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        return _box(model.geom_size[geom])
    return _round(model.geom_type[geom], model.geom_size[geom])


def _box(half: Floats) -> tuple[Floats, Any]:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return corners, np.array(triangles, np.int32)


def _round(kind: int, size: Floats) -> tuple[Floats, Any]:
    """A sphere, capsule or cylinder about z."""
    # Loading it takes 0.4 s, which robots of meshes need not wait for.
    import trimesh.creation

    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        shape: Any = trimesh.creation.uv_sphere(size[0])
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        shape = trimesh.creation.capsule(2 * size[1], size[0])
        shape.apply_translation(-shape.bounds.mean(0))
    else:
        shape = trimesh.creation.cylinder(size[0], 2 * size[1])
    return np.asarray(shape.vertices, np.float64), np.asarray(shape.faces, np.int32)
