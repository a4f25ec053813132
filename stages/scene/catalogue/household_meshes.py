"""Builds the meshes of the built-in catalogue: fifteen household objects with painted surfaces.

``python -m stages.scene.catalogue.household_meshes`` writes them as binary PLY files beside the catalogue's file. Every
mesh is closed, its faces wind counter-clockwise seen from outside, and its origin is the centre of its enclosing box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from stages.geometry.arrays import Floats
from stages.scene.catalogue.objects import Mesh

Bools = NDArray[np.bool_]
Color = tuple[int, int, int]
FOLDER = Path(__file__).parents[1] / "meshes"

WHITE: Color = (244, 244, 240)
IVORY: Color = (236, 224, 196)
BLACK: Color = (30, 30, 34)
GREY: Color = (176, 180, 184)
RED: Color = (204, 34, 40)
MAROON: Color = (122, 24, 38)
ORANGE: Color = (240, 128, 26)
YELLOW: Color = (246, 206, 44)
GREEN: Color = (44, 140, 66)
MINT: Color = (150, 214, 176)
TEAL: Color = (18, 128, 132)
SKY: Color = (120, 190, 232)
BLUE: Color = (34, 76, 172)
NAVY: Color = (24, 36, 84)
PURPLE: Color = (108, 52, 144)
PINK: Color = (236, 130, 164)
WOOD: Color = (188, 138, 88)
DARK_WOOD: Color = (112, 70, 40)


# --- shapes -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shape:
    """A closed surface without colours: vertices V x 3 in metres, faces F x 3."""

    vertices: Floats
    faces: NDArray[np.int64]


def circle(count: int = 72) -> Floats:
    """Unit circle, counter-clockwise, M x 2."""
    return superellipse(count, exponent=2.0)


def superellipse(count: int, exponent: float) -> Floats:
    """Unit outline |x|^e + |y|^e = 1, evenly spaced along its length, M x 2: a square with rounded corners."""
    angle = np.linspace(0, 2 * np.pi, 4096, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    fine = direction / (np.abs(direction) ** exponent).sum(1, keepdims=True) ** (1 / exponent)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.roll(fine, -1, 0) - fine, axis=1))])
    wanted = np.arange(count) * length[-1] / count
    closed = np.concatenate([fine, fine[:1]])
    return np.stack([np.interp(wanted, length, closed[:, k]) for k in range(2)], axis=1)


def loft(outline: Floats, sections: Sequence[tuple[float, float, float]], *, step: float = 0.003) -> Shape:
    """Sweeps ``outline`` (M x 2) through ``sections`` (x scale, y scale, z), from the bottom's centre to the top's.

    Rings lie ``step`` metres apart. The first and the last section have scale zero and become one vertex.
    """
    rings = _resample(np.asarray(sections, np.float64), step)
    body = [np.column_stack([outline * ring[:2], np.full(len(outline), ring[2])]) for ring in rings[1:-1]]
    poles = np.array([[0, 0, rings[0, 2]], [0, 0, rings[-1, 2]]])
    return Shape(np.concatenate([*body, poles]), _tube_faces(len(body), len(outline)))


def tube(path: Floats, radius: float, *, count: int = 14) -> Shape:
    """A round bar along ``path`` (K x 3) in the plane y = 0, closed at both ends."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.cross([0.0, 1.0, 0.0], tangent)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)[None, :, None]
    rings = path[:, None] + radius * (np.cos(angle) * across[:, None] + np.sin(angle) * np.array([0.0, 1.0, 0.0]))
    vertices = np.concatenate([rings.reshape(-1, 3), path[:1], path[-1:]])
    return Shape(vertices, _tube_faces(len(path), count))


def block(size: tuple[float, float, float], *, step: float = 0.0032) -> Shape:
    """A box of full extents ``size``, each face a grid of about ``step`` metres."""
    vertices: list[Floats] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            grid, quads = _box_face(np.asarray(size), axis, sign, step)
            faces.append(quads + sum(map(len, vertices)))
            vertices.append(grid)
    return _merged(np.concatenate(vertices), np.concatenate(faces))


def _resample(sections: Floats, step: float) -> Floats:
    """Sections at most ``step`` apart; flat bottoms, which nobody sees, stay as they are."""
    rows = [sections[:1]]
    for index, (start, end) in enumerate(pairwise(sections)):
        count = 2 if index == 0 else max(1, int(np.ceil(np.linalg.norm(end - start) / step)))
        rows.append(start + (end - start) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(rows)


def _tube_faces(rings: int, count: int) -> NDArray[np.int64]:
    """Faces between consecutive rings of ``count`` vertices, closed by two poles that follow the last ring."""
    around = np.arange(count)
    after = np.roll(around, -1)
    faces = [np.column_stack([np.full(count, rings * count), after, around])]
    for ring in range(rings - 1):
        a, b = ring * count + around, ring * count + after
        faces += [np.column_stack([a, b, b + count]), np.column_stack([a, b + count, a + count])]
    last = (rings - 1) * count
    faces.append(np.column_stack([last + around, last + after, np.full(count, rings * count + 1)]))
    return np.concatenate(faces)


def _box_face(size: Floats, axis: int, sign: float, step: float) -> tuple[Floats, NDArray[np.int64]]:
    u, v = (axis + 1) % 3, (axis + 2) % 3
    counts = [int(np.ceil(size[k] / step)) + 1 for k in (u, v)]
    a, b = (np.linspace(-size[k] / 2, size[k] / 2, n) for k, n in zip((u, v), counts, strict=True))
    grid = np.empty((counts[0], counts[1], 3))
    grid[..., axis], grid[..., u], grid[..., v] = sign * size[axis] / 2, a[:, None], b[None, :]
    index = np.arange(grid[..., 0].size).reshape(counts)
    p, q, r, s = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((p, q, r), (p, r, s))])
    return grid.reshape(-1, 3), faces if sign > 0 else faces[:, ::-1]


def _merged(vertices: Floats, faces: NDArray[np.int64]) -> Shape:
    """Joins vertices at the same place (to a micrometre)."""
    _, first, inverse = np.unique(np.round(vertices * 1e6), axis=0, return_index=True, return_inverse=True)
    return Shape(vertices[first], inverse.reshape(-1)[faces])


def _united(*shapes: Shape) -> Shape:
    """Several closed surfaces as one mesh; they may overlap."""
    offsets = np.cumsum([0, *(len(shape.vertices) for shape in shapes[:-1])])
    faces = [shape.faces + offset for shape, offset in zip(shapes, offsets, strict=True)]
    return Shape(np.concatenate([shape.vertices for shape in shapes]), np.concatenate(faces))


# --- paint ------------------------------------------------------------------------------------------------------


class Coat:
    """Colours of a surface, laid on layer by layer."""

    def __init__(self, shape: Shape, base: Color) -> None:
        mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
        self.shape = shape
        self.x, self.y, self.z = shape.vertices.T
        self.normals = np.asarray(mesh.vertex_normals)
        self.angle = np.arctan2(self.y, self.x)
        self.radius = np.hypot(self.x, self.y)
        self.colors = np.tile(np.array(base, np.uint8), (len(shape.vertices), 1))

    @property
    def top(self) -> float:
        """Height of the highest point, metres."""
        return float(self.z.max())

    @property
    def inside(self) -> Bools:
        """Where the surface faces the z axis: the inner wall of a vessel."""
        return (self.x * self.normals[:, 0] + self.y * self.normals[:, 1]) < -1e-6

    def on(self, where: Bools, color: Color) -> Coat:
        """Paints ``color`` where told."""
        self.colors[where] = color
        return self

    def band(self, low: float, high: float, color: Color) -> Coat:
        """Paints a horizontal band from ``low`` to ``high``, metres in the object frame."""
        return self.on((self.z > low) & (self.z < high), color)

    def face(self, axis: str) -> tuple[Bools, Floats, Floats]:
        """A side of a box such as ``+x``: where it is, and metres to the right and up seen from outside."""
        index, sign = "xyz".index(axis[1]), 1.0 if axis[0] == "+" else -1.0
        depth = sign * self.shape.vertices[:, index]
        where = depth > depth.max() - 1e-6
        right, up = {"x": (sign * self.y, self.z), "y": (-sign * self.x, self.z), "z": (self.x, sign * self.y)}[axis[1]]
        return where, right, up

    def mesh(self) -> Mesh:
        """The painted mesh, centred on its enclosing box."""
        vertices = self.shape.vertices
        centre = (vertices.min(0) + vertices.max(0)) / 2
        # Rounded as the file stores it, so that the mesh is the same before and after saving.
        stored = (vertices - centre).astype(np.float32).astype(np.float64)
        return Mesh(vertices=stored, faces=self.shape.faces.astype(np.int32), colors=self.colors)


def _stripes(value: Floats, period: float, duty: float = 0.5) -> Bools:
    return (value / period) % 1.0 < duty


def _checks(u: Floats, v: Floats, size: float) -> Bools:
    return (np.floor(u / size) + np.floor(v / size)) % 2 == 0


def _disc(u: Floats, v: Floats, radius: float) -> Bools:
    return np.hypot(u, v) < radius


def _diamond(u: Floats, v: Floats, radius: float) -> Bools:
    return np.abs(u) + np.abs(v) < radius


def _patch(u: Floats, v: Floats, width: float, height: float) -> Bools:
    return (np.abs(u) < width / 2) & (np.abs(v) < height / 2)


# --- the objects ------------------------------------------------------------------------------------------------


def tray() -> Mesh:
    """A wooden tray with a thin raised rim and an inlaid frame."""
    floor, top = -0.009, 0.015
    outer, inner = (0.196, 0.136), (0.190, 0.130)
    sections = [(0, 0, -top), (*outer, -top), (0.2, 0.14, top), (0.195, 0.135, top), (*inner, floor), (0, 0, floor)]
    coat = Coat(loft(superellipse(150, 12.0), sections, step=0.0075), DARK_WOOD)
    inwards = ((np.abs(coat.x) / inner[0]) ** 12 + (np.abs(coat.y) / inner[1]) ** 12) ** (1 / 12)
    bottom = (coat.z > floor - 1e-4) & (coat.z < floor + 1e-4) & (inwards < 1.001)
    coat.on(bottom, WOOD).on(bottom & (np.abs(inwards - 0.78) < 0.035), IVORY)
    return coat.on(bottom & (inwards < 0.40), (208, 164, 112)).mesh()


def plate() -> Mesh:
    """A white dinner plate with a double blue rim."""
    sections = [(0.0, 0.0), (0.055, 0.0), (0.060, 0.003), (0.098, 0.019), (0.100, 0.022)]
    sections += [(0.097, 0.022), (0.062, 0.0075), (0.058, 0.006), (0.0, 0.006)]
    coat = Coat(loft(circle(80), _round(sections), step=0.0036), WHITE)
    coat.on((coat.radius > 0.084) & (coat.radius < 0.091), BLUE).on((coat.radius > 0.074) & (coat.radius < 0.078), BLUE)
    coat.on((coat.radius < 0.058) & (coat.z > 0.005) & _disc(coat.x, coat.y, 0.017), SKY)
    return coat.mesh()


def bowl() -> Mesh:
    """A terracotta bowl, cream inside, with a zigzag around it."""
    t = np.linspace(0.12, 1.0, 12)
    outer = [(0.074 * np.sin(np.pi / 2 * s), 0.060 * (1 - np.cos(np.pi / 2 * s))) for s in t]
    inner = [(0.0695 * np.sin(np.pi / 2 * s), 0.060 - 0.0545 * np.cos(np.pi / 2 * s)) for s in t[::-1]]
    foot = [(0.0, 0.0), (0.030, 0.0), (0.034, 0.004)]
    rim = [(0.0745, 0.0605)]
    coat = Coat(loft(circle(84), _round([*foot, *outer[3:], *rim, *inner, (0.0, inner[-1][1])]), step=0.0032), ORANGE)
    zigzag = 0.036 + 0.007 * np.abs((coat.angle / np.pi * 9) % 2 - 1)
    coat.on(np.abs(coat.z - zigzag) < 0.0045, MAROON).on(coat.inside | (coat.z > 0.0585), IVORY)
    return coat.mesh()


def cup() -> Mesh:
    """A tapered tumbler without a handle: lilac with white dots."""
    sections = [(0.0, 0.0), (0.0295, 0.0), (0.0305, 0.001), (0.038, 0.095)]
    sections += [(0.0355, 0.095), (0.0285, 0.004), (0.0, 0.004)]
    coat = Coat(loft(circle(76), _round(sections), step=0.0028), PURPLE)
    column = np.floor(coat.angle / (2 * np.pi) * 8)
    u = ((coat.angle / (2 * np.pi) * 8) % 1.0 - 0.5) * 0.027
    for height in (0.022, 0.046, 0.070):
        coat.on(_disc(u, coat.z - height - 0.006 * (column % 2), 0.0075), WHITE)
    return coat.on(coat.inside | (coat.z < 0.005), (198, 176, 220)).mesh()


def mug() -> Mesh:
    """A straight mug with a handle towards +x: teal with a white label and a red heart-like mark."""
    sections = [(0.0, 0.0), (0.037, 0.0), (0.039, 0.002), (0.039, 0.090)]
    sections += [(0.0355, 0.090), (0.0355, 0.005), (0.0, 0.005)]
    body = loft(circle(76), _round(sections), step=0.0028)
    bow = np.linspace(-1.0, 1.0, 26) * np.deg2rad(88)
    path = np.column_stack([0.0375 + 0.027 * np.cos(bow), np.zeros(26), 0.045 + 0.026 * np.sin(bow)])
    coat = Coat(_united(body, tube(path, 0.0052)), TEAL)
    label = (np.abs(np.abs(coat.angle) - np.pi / 2) < 0.75) & (np.abs(coat.z - 0.045) < 0.024)
    u = (np.abs(coat.angle) - np.pi / 2) * 0.039
    coat.on(label, WHITE).on(label & _diamond(u, coat.z - 0.045, 0.017), RED)
    coat.on((coat.z > 0.082) & (coat.radius < 0.041), NAVY).on(coat.inside & (coat.radius < 0.0365), WHITE)
    coat.on((coat.radius < 0.034) & (coat.z > 0.004), WHITE)
    return coat.mesh()


def water_bottle() -> Mesh:
    """A pale blue bottle with a wave label and a dark blue cap."""
    sections = [(0.0, 0.0), (0.030, 0.0), (0.0325, 0.003), (0.0325, 0.115), (0.030, 0.130), (0.020, 0.146)]
    sections += [(0.0145, 0.152), (0.0145, 0.156), (0.0165, 0.1561), (0.0165, 0.1745), (0.0155, 0.176), (0.0, 0.176)]
    coat = Coat(loft(circle(64), _round(sections), step=0.0028), (178, 220, 238))
    coat.band(0.045, 0.098, BLUE)
    wave = 0.070 + 0.008 * np.sin(4 * coat.angle)
    coat.on(np.abs(coat.z - wave) < 0.005, WHITE).on(np.abs(coat.z - wave + 0.013) < 0.003, SKY)
    return coat.band(0.1552, 0.2, NAVY).mesh()


def sauce_bottle() -> Mesh:
    """An oval red squeeze bottle with a yellow label on both sides and a white cap."""
    sections = [(0, 0, 0), (0.034, 0.022, 0), (0.037, 0.025, 0.004), (0.037, 0.025, 0.085), (0.033, 0.023, 0.105)]
    sections += [(0.018, 0.017, 0.122), (0.016, 0.016, 0.126), (0.0175, 0.0175, 0.1261), (0.0175, 0.0175, 0.140)]
    sections += [(0.010, 0.010, 0.158), (0.008, 0.008, 0.160), (0, 0, 0.160)]
    coat = Coat(loft(circle(66), sections, step=0.0028), RED)
    label = (np.abs(coat.x) < 0.027) & (np.abs(coat.z - 0.052) < 0.029)
    coat.on(label, YELLOW).on(label & _disc(coat.x, coat.z - 0.052, 0.016), GREEN)
    coat.on(label & _disc(coat.x, coat.z - 0.052, 0.008), RED)
    return coat.band(0.1255, 0.2, WHITE).mesh()


def soup_can() -> Mesh:
    """A soup can: red above, white below, a gold seal and bare metal ends."""
    sections = [(0.0, 0.001), (0.0315, 0.001), (0.0325, 0.0), (0.034, 0.0015), (0.034, 0.0985)]
    sections += [(0.0325, 0.1), (0.0315, 0.0985), (0.0, 0.0985)]
    coat = Coat(loft(circle(72), _round(sections), step=0.0028), GREY)
    coat.on(_stripes(coat.radius, 0.012) & (coat.z > 0.095), (140, 144, 150))
    side = coat.radius > 0.0336
    coat.on(side & (coat.z > 0.006) & (coat.z < 0.052), WHITE).on(side & (coat.z >= 0.052) & (coat.z < 0.094), RED)
    u = (np.abs(coat.angle) - np.pi / 2) * 0.034
    coat.on(side & _disc(u, coat.z - 0.052, 0.013), YELLOW)
    letters = side & (np.abs(coat.z - 0.076) < 0.006) & _stripes(coat.angle, np.pi / 8, 0.6)
    return coat.on(letters, WHITE).mesh()


def tuna_can() -> Mesh:
    """A flat tin with a blue and yellow wrapper and a fish-shaped patch on the lid."""
    sections = [(0.0, 0.001), (0.036, 0.001), (0.037, 0.0), (0.039, 0.002), (0.039, 0.038)]
    sections += [(0.0375, 0.040), (0.036, 0.0385), (0.0, 0.0385)]
    coat = Coat(loft(circle(80), _round(sections), step=0.0026), GREY)
    side = coat.radius > 0.0386
    coat.on(side & (coat.z > 0.005) & (coat.z < 0.035), BLUE)
    coat.on(side & (np.abs(coat.z - 0.020) < 0.007) & _stripes(coat.angle, np.pi / 4, 0.55), YELLOW)
    lid = (coat.z > 0.038) & (coat.radius < 0.0355)
    coat.on(lid, SKY).on(lid & (np.hypot(coat.x / 0.020, coat.y / 0.010) < 1), NAVY)
    return coat.on(lid & (coat.x > 0.017) & (np.abs(coat.y) < 0.8 * (coat.x - 0.015)), NAVY).mesh()


def tea_box() -> Mesh:
    """A green tea box with a yellow label, a cup mark and a white lid line."""
    coat = Coat(block((0.062, 0.120, 0.080)), GREEN)
    coat.band(0.022, 0.027, WHITE)
    for side in ("+x", "-x"):
        face, u, v = coat.face(side)
        coat.on(face & _patch(u, v + 0.008, 0.078, 0.042), YELLOW)
        coat.on(face & _disc(u, np.minimum(v + 0.004, 0) * 1.0, 0.016) & (v < -0.004), MAROON)
        coat.on(face & _patch(u, v - 0.003, 0.036, 0.004), MAROON)
    for side in ("+y", "-y"):
        face, u, v = coat.face(side)
        coat.on(face & _stripes(u + v, 0.016), MINT)
    face, u, v = coat.face("+z")
    return coat.on(face & _patch(u, v, 0.036, 0.084), MINT).on(face & _diamond(u, v, 0.016), GREEN).mesh()


def cereal_box() -> Mesh:
    """A small yellow cereal box with an orange sun, a blue bowl and a magenta stripe."""
    coat = Coat(block((0.050, 0.115, 0.150), step=0.0034), YELLOW)
    for side in ("+x", "-x"):
        face, u, v = coat.face(side)
        rays = _stripes(np.arctan2(v - 0.020, u), np.pi / 6) & _disc(u, v - 0.020, 0.040)
        coat.on(face & rays, ORANGE).on(face & _disc(u, v - 0.020, 0.021), RED)
        coat.on(face & _disc(u, v + 0.032, 0.032) & (v < -0.032), BLUE)
        coat.on(face & _patch(u, v - 0.066, 0.115, 0.012), PURPLE)
    for side in ("+y", "-y"):
        face, u, v = coat.face(side)
        coat.on(face & _stripes(v, 0.018, 0.3), PURPLE)
    face, u, v = coat.face("+z")
    return coat.on(face & _stripes(v, 0.020), PURPLE).mesh()


def sugar_box() -> Mesh:
    """A white and light blue checked sugar box with a dark blue name plate."""
    coat = Coat(block((0.046, 0.086, 0.122), step=0.0028), WHITE)
    for side in ("+x", "-x", "+y", "-y"):
        face, u, v = coat.face(side)
        coat.on(face & _checks(u + 0.0005, v + 0.0005, 0.0145), SKY)
    for side in ("+x", "-x"):
        face, u, v = coat.face(side)
        coat.on(face & _patch(u, v - 0.015, 0.070, 0.036), NAVY).on(face & _patch(u, v - 0.015, 0.046, 0.009), WHITE)
    face, u, v = coat.face("+z")
    return coat.on(face & _patch(u, v, 0.03, 0.066), NAVY).mesh()


def milk_carton() -> Mesh:
    """A gable-top milk carton: white with blue cow patches and a red ridge."""
    shape = block((0.068, 0.068, 0.150), step=0.003)
    vertices = shape.vertices.copy()
    slope = np.clip((vertices[:, 2] - 0.035) / 0.030, 0, 1)
    vertices[:, 1] *= 1 - 0.94 * slope
    coat = Coat(Shape(vertices, shape.faces), WHITE)
    for x, y, z, radius in _COW_PATCHES:
        coat.on(np.linalg.norm(vertices - (x, y, z), axis=1) < radius, BLACK)
    coat.band(-0.062, -0.046, BLUE).band(0.0655, 0.1, RED)
    return coat.on((slope > 0.05) & (slope < 0.95), (96, 150, 214)).mesh()


_COW_PATCHES = (
    (0.034, 0.010, 0.010, 0.018),
    (0.034, -0.022, -0.024, 0.014),
    (-0.034, -0.006, -0.014, 0.019),
    (-0.034, 0.024, 0.020, 0.013),
    (-0.010, 0.034, 0.004, 0.017),
    (0.020, 0.034, -0.030, 0.012),
    (0.008, -0.034, -0.018, 0.018),
    (-0.020, -0.034, 0.020, 0.014),
)


def salt_shaker() -> Mesh:
    """A black and white pepper-pot style shaker with a steel cap."""
    sections = [(0.0, 0.0), (0.024, 0.0), (0.026, 0.002), (0.022, 0.060), (0.022, 0.068), (0.0245, 0.0682)]
    sections += [(0.0245, 0.082), (0.019, 0.092), (0.010, 0.095), (0.0, 0.095)]
    coat = Coat(loft(circle(64), _round(sections), step=0.0024), WHITE)
    coat.on(_stripes(coat.angle, np.pi / 4) & (coat.z < 0.060), BLACK).band(0.060, 0.0679, RED)
    coat.band(0.0679, 0.2, GREY)
    holes = (coat.z > 0.0905) & _disc(
        (coat.radius - 0.008) * 2.0, (coat.angle % (np.pi / 3) - np.pi / 6) * 0.01, 0.0032
    )
    return coat.on(holes, BLACK).mesh()


def sponge() -> Mesh:
    """A kitchen sponge: pink foam with pores, a dark scouring layer below."""
    coat = Coat(block((0.070, 0.110, 0.044), step=0.0028), PINK)
    cell = np.floor(coat.shape.vertices / 0.0075).astype(np.int64)
    pores = (cell @ np.array([73, 151, 283])) % 11 < 2
    coat.on(pores, (196, 84, 124)).band(-0.03, -0.008, (52, 92, 74))
    return coat.mesh()


def _round(profile: Sequence[tuple[float, float]]) -> list[tuple[float, float, float]]:
    """Sections of a solid of revolution from (radius, height) pairs."""
    return [(radius, radius, height) for radius, height in profile]


OBJECTS: tuple[Callable[[], Mesh], ...] = (
    tray,
    plate,
    bowl,
    cup,
    mug,
    water_bottle,
    sauce_bottle,
    soup_can,
    tuna_can,
    tea_box,
    cereal_box,
    sugar_box,
    milk_carton,
    salt_shaker,
    sponge,
)


def save(mesh: Mesh, path: Path) -> None:
    """Writes a binary PLY with vertex colours."""
    colors = np.column_stack([mesh.colors, np.full(len(mesh.colors), 255, np.uint8)])
    shaped = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    shaped.export(path, encoding="binary", vertex_normal=False)


def main() -> None:
    """Rewrites the PLY files of the built-in catalogue."""
    FOLDER.mkdir(exist_ok=True)
    for build in OBJECTS:
        save(build(), FOLDER / f"{build.__name__}.ply")


if __name__ == "__main__":
    main()
