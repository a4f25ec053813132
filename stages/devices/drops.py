"""Random layouts at rest: objects dropped onto a table in simulation, on, in and against each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from stages.geometry.arrays import Floats
from stages.perception.detection.trained.training_images import DISTRACTOR, Body, Layout
from stages.scene.catalogue import Catalogue, CatalogueObject, Mesh, Primitive

_TIMESTEP = 0.004
_SETTLE_STEPS = 350
_REACH = 0.27  # Metres from the table's middle within which objects are dropped.
_STACKED = 0.45
"""Share of the objects that are put down on another one."""
_COPIES = 1 / 3
"""Share of the layouts in which there are equal objects."""
_BOTH_WAYS = tuple(Rotation.from_rotvec([(0, 0, 0), (np.pi / 2, 0, 0)]).as_matrix())  # Standing and lying.


@dataclass(frozen=True)
class Thing:
    """What can be dropped."""

    mesh: Mesh
    label: int
    collision: tuple[Primitive, ...]
    mass: float
    friction: float
    resting: tuple[Floats, ...]


def things(catalogue: Catalogue) -> list[Thing]:
    """Every object of the catalogue; its label is its position."""
    return [_thing(item, label) for label, item in enumerate(catalogue.objects.values())]


def _thing(item: CatalogueObject, label: int) -> Thing:
    return Thing(item.mesh, label, item.collision, item.mass, item.friction, item.resting)


def distractors(known: Sequence[Thing], rng: np.random.Generator, *, count: int) -> list[Thing]:
    """Boxes, cylinders and look-alikes of known objects in colours that no known object of that shape has."""
    shapes = [_random_shape(rng) for _ in range(count // 2)]
    lookalikes = (_recoloured(known[int(rng.integers(len(known)))], rng) for _ in range(count - count // 2))
    return [*shapes, *(thing for thing in lookalikes if thing is not None)]


def _random_shape(rng: np.random.Generator) -> Thing:
    """A box or cylinder, 2 to 22 cm, striped in two random colours."""
    if rng.random() < 0.6:
        size = tuple(rng.uniform(0.02, 0.2, 3))
        shape = trimesh.creation.box(size)
        piece = Primitive("box", size, np.eye(4))
    else:
        size = float(rng.uniform(0.01, 0.06)), float(rng.uniform(0.03, 0.22))
        shape = trimesh.creation.cylinder(radius=size[0], height=size[1], sections=32)
        piece = Primitive("cylinder", size, np.eye(4))
    vertices, faces = trimesh.remesh.subdivide_to_size(shape.vertices, shape.faces, 0.02)[:2]
    stripes = np.sin(vertices @ rng.normal(0, 60, 3)) > rng.uniform(-1, 1)
    colors = rng.uniform(0, 255, (2, 3))[stripes.astype(int)].astype(np.uint8)
    mesh = Mesh(vertices, faces.astype(np.int32), colors)
    return Thing(mesh, DISTRACTOR, (piece,), 0.2, 0.8, _BOTH_WAYS)


def _recoloured(thing: Thing, rng: np.random.Generator) -> Thing | None:
    """The thing with its colours turned, unless that is hardly another colour."""
    colors = thing.mesh.colors[:, rng.permutation(3)]
    if rng.random() < 0.5:
        colors = 255 - colors
    if np.abs(colors.astype(float) - thing.mesh.colors).mean() < 50:
        return None
    return replace(thing, mesh=replace(thing.mesh, colors=colors), label=DISTRACTOR)


def random_layout(known: Sequence[Thing], other: Sequence[Thing], rng: np.random.Generator) -> Layout:
    """Up to nine known objects and three others, tidy or heaped, stacked in any order, often on the widest known object
    (the tray); of some there are two or three."""
    chosen = _choose(known, other, rng)
    tidy = bool(rng.random() < 0.6)
    starts: list[Floats] = []
    occupied: list[tuple[Floats, float, float]] = []
    for thing in chosen:
        starts.append(_start(thing, occupied, rng, tidy=tidy))
    rested = settle(chosen, starts)
    bodies = (Body(thing.mesh, thing.label, pose) for thing, pose in zip(chosen, rested, strict=True))
    return Layout(tuple(body for body in bodies if np.linalg.norm(body.T_table_object[:2, 3]) < 0.6))


def _choose(known: Sequence[Thing], other: Sequence[Thing], rng: np.random.Generator) -> list[Thing]:
    """Nothing known in 4 % of the layouts, else one to nine objects, rather more; others in half of them.

    In a third of them up to two objects are replaced by copies of another one.
    """
    count = 0 if rng.random() < 0.04 else int(rng.integers(1, 10, 2).max())
    picked = [known[i] for i in rng.permutation(len(known))[:count]]
    widest = max(known, key=_width)
    if rng.random() < 0.6 and count and all(thing is not widest for thing in picked):
        picked[0] = widest
    # The widest first, so that the rest lands on it rather than under it; of the rest anything may carry anything.
    picked.sort(key=lambda thing: thing is not widest)
    if rng.random() < _COPIES:
        copies = picked[1:-1][: int(rng.integers(1, 3))]
        picked[1 : 1 + len(copies)] = picked[-1:] * len(copies)
    strangers = [other[i] for i in rng.permutation(len(other))[: rng.integers(0, 4)]] if rng.random() < 0.5 else []
    return [*picked, *strangers]


def _width(thing: Thing) -> float:
    return float(np.ptp(thing.mesh.vertices[:, :2], axis=0).max())


def _start(
    thing: Thing, occupied: list[tuple[Floats, float, float]], rng: np.random.Generator, *, tidy: bool
) -> Floats:
    """A pose just above whatever was placed there before: (centre, radius, top) per object, extended here."""
    pose = np.eye(4)
    pose[:3, :3] = _rotation(thing, rng, tidy=tidy)
    vertices = thing.mesh.vertices @ pose[:3, :3].T
    radius = float(np.ptp(vertices[:, :2], axis=0).max() / 2)
    centre = _place(radius, occupied, rng)
    below = [top for where, other, top in occupied if np.linalg.norm(where - centre) < 0.9 * (radius + other)]
    bottom = max(below, default=0.0) + 0.005
    pose[:3, 3] = *centre, bottom - vertices[:, 2].min()
    occupied.append((centre, radius, bottom + float(np.ptp(vertices[:, 2]))))
    return pose


def _rotation(thing: Thing, rng: np.random.Generator, *, tidy: bool) -> Floats:
    """Upright mostly when tidy; otherwise any resting rotation or any rotation at all."""
    turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
    if rng.random() < (0.85 if tidy else 0.3):
        return turn @ thing.resting[0]
    if tidy or rng.random() < 0.6:
        return turn @ thing.resting[rng.integers(len(thing.resting))]
    return Rotation.random(rng=rng).as_matrix()


def _place(radius: float, occupied: list[tuple[Floats, float, float]], rng: np.random.Generator) -> Floats:
    """A spot on the table: free if one is found soon, or deliberately on an object that is there already."""
    if occupied and rng.random() < _STACKED:
        where, other, _ = occupied[rng.integers(len(occupied))]
        return where + rng.uniform(-0.5, 0.5, 2) * max(other - radius, 0.01)
    spots = rng.uniform(-_REACH, _REACH, (12, 2))
    # The widest object (the tray) does not count as an obstacle: things stand on it.
    for spot in spots:
        if all(np.linalg.norm(where - spot) > radius + other for where, other, _ in occupied if other < 0.15):
            return spot
    return spots[-1]


def settle(dropped: Sequence[Thing], starts: Sequence[Floats]) -> list[Floats]:
    """Poses T_table_object after 1.4 s of rigid-body physics on the plane z = 0."""
    spec = mujoco.MjSpec()
    spec.option.timestep = _TIMESTEP
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(2, 2, 0.1))
    for thing, start in zip(dropped, starts, strict=True):
        _add(spec, thing, start)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=_SETTLE_STEPS)
    poses = np.tile(np.eye(4), (len(dropped), 1, 1))
    poses[:, :3, 3] = data.xpos[1:]
    poses[:, :3, :3] = data.xmat[1:].reshape(-1, 3, 3)
    return list(poses)


def _add(spec: mujoco.MjSpec, thing: Thing, start: Floats) -> None:
    """Adds a free body made of the thing's collision pieces."""
    body = spec.worldbody.add_body(pos=start[:3, 3], quat=_quaternion(start))
    body.add_freejoint()
    for piece in thing.collision:
        size = np.zeros(3)
        half = np.asarray(piece.size) / 2
        size[: len(half)] = half if piece.kind == "box" else (piece.size[0], half[1])
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX if piece.kind == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=size,
            pos=piece.T_object_primitive[:3, 3],
            quat=_quaternion(piece.T_object_primitive),
            mass=thing.mass / len(thing.collision),
            friction=(thing.friction, 0.005, 0.001),
        )


def _quaternion(pose: Floats) -> Floats:
    """w, x, y, z as MuJoCo wants them."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
