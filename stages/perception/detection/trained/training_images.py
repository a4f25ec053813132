"""Random images of known objects with their boxes: what the detector learns from and is measured on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.perception.detection.trained.network import HEIGHT, WIDTH
from stages.perception.rendering.renderer import Camera, Item, Light, Lighting, Renderer
from stages.scene.catalogue import Mesh

Image = NDArray[np.uint8]
DISTRACTOR = -1

VISIBLE_SHARE = 0.1
"""An object of which less can be seen is neither demanded of the detector nor held against it."""
_SMALLEST = 6  # Pixels; smaller boxes are ignored as well.
_JPEG_QUALITY = 95


@dataclass(frozen=True)
class Body:
    """An object at rest on the table."""

    mesh: Mesh
    label: int
    """Index into the list of labels, or DISTRACTOR."""
    T_table_object: Floats


@dataclass(frozen=True)
class Layout:
    """Objects on a table whose surface is z = 0, near the origin."""

    bodies: tuple[Body, ...]


@dataclass(frozen=True)
class Example:
    """An image and the extent of what can be seen of each known object in it."""

    image: Image
    """HEIGHT x WIDTH x 3."""
    boxes: NDArray[np.float64]
    """N x 4: x0, y0, x1, y1."""
    labels: NDArray[np.int64]
    """N"""
    ignored: NDArray[np.bool_]
    """N, True where too little is visible."""


@dataclass(frozen=True)
class _Table:
    """Where the table top ends, and what it and the rest of the room look like."""

    low: Floats
    high: Floats
    texture: Image
    floor: Image
    wall: Floats
    """2 x 3: colours of the wall's lower and upper end."""


def render_example(
    renderer: Renderer, layout: Layout, rng: np.random.Generator, *, like_robot: bool | None = None
) -> Example:
    """One view of a layout with random camera, light, table, room, robot limbs and sensor.

    ``like_robot`` places the camera where the robot's head is; by default half the images have it there.
    """
    camera = random_camera(rng, like_robot=bool(rng.random() < 0.5) if like_robot is None else like_robot)
    items = [Item(body.mesh, body.T_table_object) for body in layout.bodies]
    identity, _ = renderer.instances(items, camera)
    image = _paint(renderer, items, identity, camera, rng)
    if rng.random() < 0.3:
        identity[_limbs(image, rng)] = -1
    labels = [body.label for body in layout.bodies]
    return labelled(_sensed(image, rng), identity, items, labels, camera=camera, rng=rng)


def labelled(
    image: Image,
    identity: NDArray[np.int32],
    items: Sequence[Item],
    labels: Sequence[int],
    *,
    camera: Camera,
    rng: np.random.Generator,
) -> Example:
    """The image with a box around the visible pixels of every known item; ``identity`` is H x W, -1 elsewhere."""
    found: list[tuple[int, int, int, int]] = []
    names: list[int] = []
    ignored: list[bool] = []
    for index, (item, label) in enumerate(zip(items, labels, strict=True)):
        mask = identity == index
        box = _visible_box(mask)
        if label == DISTRACTOR or box is None:
            continue
        found.append(box)
        names.append(label)
        small = min(box[2] - box[0], box[3] - box[1]) < _SMALLEST
        ignored.append(small or _visible_share(mask, item, camera, rng) < VISIBLE_SHARE)
    boxes = np.array(found, np.float64).reshape(-1, 4)
    return Example(image, boxes, np.array(names, np.int64), np.array(ignored, bool))


def random_camera(rng: np.random.Generator, *, like_robot: bool) -> Camera:
    """Looks at the table's middle: from the robot's head, or from 0.6 to 1.4 m away and 25 to 75 degrees above."""
    focal = rng.uniform(250, 300)
    K = np.array([[focal, 0, WIDTH / 2 - 0.5], [0, focal, HEIGHT / 2 - 0.5], [0, 0, 1]])
    K[:2, 2] += rng.uniform(-6, 6, 2)
    if like_robot:
        target = rng.uniform((-0.12, -0.15, -0.05), (0.12, 0.15, 0.1))
        eye = np.array([-0.65, 0.0, 0.65]) + rng.uniform(-0.12, 0.12, 3)
    else:
        target = rng.uniform((-0.12, -0.12, 0.0), (0.12, 0.12, 0.08))
        pitch, turn = np.deg2rad(rng.uniform(25, 75)), rng.uniform(0, 2 * np.pi)
        away = np.array([np.cos(pitch) * np.cos(turn), np.cos(pitch) * np.sin(turn), np.sin(pitch)])
        eye = target + rng.uniform(0.6, 1.4) * away
    return Camera(K, _looking(eye, target, roll=np.deg2rad(rng.normal(0, 3))))


def _looking(eye: Floats, target: Floats, *, roll: float) -> Floats:
    """T_table_camera of an optical frame at ``eye`` that looks at ``target``."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", roll).as_matrix()
    pose[:3, 3] = eye
    return pose


def _paint(
    renderer: Renderer, items: Sequence[Item], identity: NDArray[np.int32], camera: Camera, rng: np.random.Generator
) -> Image:
    """The lit objects in front of a painted or a rendered table."""
    table = _random_table(items, rng)
    if rng.random() < 0.35:
        slab = Item(_slab(table), np.eye(4))
        return renderer.color([*items, slab], camera, lighting=_random_lighting(rng), background=_colour(table.wall[0]))
    background = _painted_room(table, camera)
    if rng.random() < 0.5:
        background = _shadowed(background, items, camera, rng)
    middle = _colour(background.mean(axis=(0, 1)))
    image = renderer.color(items, camera, lighting=_random_lighting(rng), background=middle)
    return np.where(identity[..., None] < 0, background, image)


def _random_lighting(rng: np.random.Generator) -> Lighting:
    """One to three lights from above with a tint, and ambient light."""
    lights: list[Light] = []
    for _ in range(rng.integers(1, 4)):
        x, y = rng.uniform(-1, 1, 2)
        r, g, b = 1 - rng.uniform(0, 0.12, 3)
        lights.append(Light("directional", (x, y, -rng.uniform(0.5, 1.5)), 0.0, (r, g, b)))
    strength = rng.uniform(1.5, 4.5) * rng.dirichlet(np.ones(len(lights)))
    lights = [Light(light.kind, light.vector, float(s), light.color) for light, s in zip(lights, strength, strict=True)]
    ambient = float(rng.uniform(0.2, 0.6))
    return Lighting(tuple(lights), (ambient, ambient, ambient))


def _random_table(items: Sequence[Item], rng: np.random.Generator) -> _Table:
    """A table that reaches under every object, with a random surface, floor and wall."""
    ground = np.array([item.T_world_item[:2, 3] for item in items]).reshape(-1, 2)
    low = np.minimum(ground.min(axis=0, initial=-0.15), -0.15) - rng.uniform(0.1, 0.5, 2)
    high = np.maximum(ground.max(axis=0, initial=0.15), 0.15) + rng.uniform(0.1, 0.5, 2)
    wall = np.clip(rng.uniform(20, 235) + rng.normal(0, 12, (2, 3)) + rng.normal(0, 15, (2, 1)), 0, 255)
    return _Table(low, high, random_texture(rng), random_texture(rng), wall)


def random_texture(rng: np.random.Generator) -> Image:
    """A surface, 128 x 128 x 3: plain, wood-like, striped, chequered or cloudy in two related colours."""
    first = _random_colour(rng)
    contrast = rng.normal(0, 30, 3) + rng.normal(0, 30)
    blend = _pattern(rng)
    return np.clip(first + blend[..., None] * contrast, 0, 255).astype(np.uint8)


def _random_colour(rng: np.random.Generator) -> Floats:
    """Mostly muted: a grey level with a moderate tint; sometimes any colour."""
    if rng.random() < 0.25:
        return rng.uniform(0, 255, 3)
    return np.clip(rng.uniform(30, 235) + rng.normal(0, 18, 3), 0, 255)


def _pattern(rng: np.random.Generator) -> Floats:
    """How much of the second colour is where, 128 x 128 in 0..1."""
    y, x = np.mgrid[0:128, 0:128] / 128.0
    kind = rng.integers(5)
    turn = rng.uniform(0, np.pi)
    across = x * np.cos(turn) + y * np.sin(turn)
    if kind == 0:
        return np.zeros((128, 128))
    if kind == 1:
        ripple = cv2.resize(rng.normal(size=(6, 6)), (128, 128), interpolation=cv2.INTER_CUBIC)
        return 0.5 + 0.5 * np.sin(rng.uniform(20, 90) * across + 2 * ripple)
    if kind == 2:
        return np.sign(np.sin(rng.uniform(15, 80) * across)) * 0.5 + 0.5
    if kind == 3:
        frequency = rng.uniform(10, 50)
        return (np.sin(frequency * x) * np.sin(frequency * y) > 0).astype(float)
    cells = int(rng.integers(4, 40))
    return np.clip(0.5 + 0.3 * cv2.resize(rng.normal(size=(cells, cells)), (128, 128)), 0, 1)


def _slab(table: _Table) -> Mesh:
    """The table top as a mesh of 24 x 24 coloured squares."""
    count = 25
    x, y = np.meshgrid(np.linspace(table.low[0], table.high[0], count), np.linspace(table.low[1], table.high[1], count))
    vertices = np.stack([x, y, np.full_like(x, -1e-3)], axis=-1).reshape(-1, 3)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).reshape(-1)
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + count + 1], 1),
            np.stack([corner, corner + count + 1, corner + count], 1),
        ]
    )
    colors = cv2.resize(table.texture, (count, count), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    return Mesh(vertices, faces.astype(np.int32), colors.astype(np.uint8))


def _painted_room(table: _Table, camera: Camera) -> Image:
    """What the camera sees without objects: table top, floor 0.7 m below it, wall above the horizon."""
    rays = _rays(camera)
    height = np.linspace(0, 1, HEIGHT)[:, None, None]
    room = np.broadcast_to(table.wall[1] * (1 - height) + table.wall[0] * height, (HEIGHT, WIDTH, 3))
    room = room.astype(np.uint8)
    for surface, level, low, high in (
        (table.floor, -0.7, np.array([-2.5, -2.5]), np.array([2.5, 2.5])),
        (table.texture, 0.0, table.low, table.high),
    ):
        distance = (level - camera.T_world_camera[2, 3]) / np.minimum(rays[..., 2], -1e-6)
        ground = camera.T_world_camera[:2, 3] + distance[..., None] * rays[..., :2]
        place = ((ground - low) / (high - low)).astype(np.float32)
        inside = ((place >= 0) & (place <= 1)).all(axis=-1) & (rays[..., 2] < 0)
        looked_up = cv2.remap(surface, place[..., 0] * 127, place[..., 1] * 127, cv2.INTER_LINEAR)
        room = np.where(inside[..., None], looked_up, room)
    return room


def _rays(camera: Camera) -> Floats:
    """Viewing directions of all pixels in the table frame, HEIGHT x WIDTH x 3."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    return pixels @ np.linalg.inv(camera.K).T @ camera.T_world_camera[:3, :3].T


def _shadowed(image: Image, items: Sequence[Item], camera: Camera, rng: np.random.Generator) -> Image:
    """The background with soft shadows where objects stand between a light and the table."""
    slant = rng.uniform(-0.6, 0.6, 2)
    shade = np.zeros((HEIGHT, WIDTH), np.uint8)
    for item in items:
        points = item.mesh.vertices @ item.T_world_item[:3, :3].T + item.T_world_item[:3, 3]
        fallen = np.column_stack([points[:, :2] + slant * points[:, 2:], np.zeros(len(points))])
        pixels, depth = _project(fallen, camera)
        if (depth > 0.05).all():
            hull = cv2.convexHull(np.clip(pixels, -2000, 2000).astype(np.int32))
            cv2.fillConvexPoly(shade, hull, 255)
    soft = cv2.GaussianBlur(shade, (0, 0), rng.uniform(1, 5)).astype(np.float32) / 255
    return (image * (1 - rng.uniform(0.1, 0.6) * soft[..., None])).astype(np.uint8)


def _project(points: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Pixels, N x 2, and depths, N, of points in the table frame."""
    seen = (points - camera.T_world_camera[:3, 3]) @ camera.T_world_camera[:3, :3]
    depth = np.where(np.abs(seen[:, 2]) < 1e-6, 1e-6, seen[:, 2])
    return (seen @ camera.K.T)[:, :2] / depth[:, None], depth


def _limbs(image: Image, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Paints one to three robot-like limbs that reach in from the image's border; returns their pixels."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for _ in range(rng.integers(1, 4)):
        along = rng.uniform(0, 1)
        start = np.array(
            [(along * WIDTH, -10), (along * WIDTH, HEIGHT + 10), (-10, along * HEIGHT), (WIDTH + 10, along * HEIGHT)]
        )[rng.integers(4)]
        middle = np.array([WIDTH, HEIGHT]) * rng.uniform(0.25, 0.75, 2)
        end = start + (middle - start) * rng.uniform(0.1, 0.6)
        limb = np.zeros_like(mask)
        cv2.line(limb, start.astype(int).tolist(), end.astype(int).tolist(), 255, int(rng.integers(14, 60)))
        colour = np.clip(rng.choice([35, 70, 110, 200]) + rng.normal(0, 12) + rng.normal(0, 5, 3), 0, 255)
        light = 0.6 + 0.4 * cv2.GaussianBlur(limb, (0, 0), 8).astype(np.float32) / 255
        np.copyto(image, (light[..., None] * colour).astype(np.uint8), where=limb[..., None] > 0)
        mask |= limb
    return mask > 0


def _sensed(image: Image, rng: np.random.Generator) -> Image:
    """What a camera makes of it: blur, white balance, exposure, gamma, noise."""
    values = image.astype(np.float32)
    if rng.random() < 0.5:
        values = cv2.GaussianBlur(values, (0, 0), rng.uniform(0.3, 0.9))
    values = 255 * (values / 255) ** rng.uniform(0.8, 1.25)
    values = values * rng.uniform(0.8, 1.2) * rng.normal(1, 0.03, 3)
    values += rng.normal(0, rng.uniform(0.5, 6), values.shape)
    return np.clip(values, 0, 255).astype(np.uint8)


def _visible_box(mask: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    """Extent of a mask, exclusive on the right and below."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(columns):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def _visible_share(mask: NDArray[np.bool_], item: Item, camera: Camera, rng: np.random.Generator) -> float:
    """Share of the silhouette that can be seen, from points drawn over the surfaces that face the camera."""
    corners = item.mesh.vertices[item.mesh.faces] @ item.T_world_item[:3, :3].T + item.T_world_item[:3, 3]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    views = camera.T_world_camera[:3, 3] - corners.mean(axis=1)
    # A facing triangle's share of the silhouette: its area, foreshortened, at its distance.
    weights = np.maximum(np.einsum("fi,fi->f", normals, views), 0) / np.linalg.norm(views, axis=1) ** 3
    chosen = corners[rng.choice(len(corners), 200, p=weights / weights.sum())]
    points = np.einsum("nc,nci->ni", rng.dirichlet(np.ones(3), 200), chosen)
    pixels, _ = _project(points, camera)
    u, v = np.rint(pixels).astype(int).T
    inside = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    return float((mask[np.clip(v, 0, HEIGHT - 1), np.clip(u, 0, WIDTH - 1)] & inside).mean())


def _colour(values: Floats) -> tuple[int, int, int]:
    r, g, b = (int(value) for value in values)
    return r, g, b


def save_examples(path: Path, examples: Sequence[Example], labels: Sequence[str]) -> None:
    """Writes examples as one npz file: JPEG images end to end, and boxes with the image they belong to."""
    jpegs = [_jpeg(example.image) for example in examples]
    np.savez(
        path,
        jpegs=np.frombuffer(b"".join(jpegs), np.uint8),
        ends=np.cumsum([len(jpeg) for jpeg in jpegs]),
        image=np.repeat(np.arange(len(examples)), [len(example.labels) for example in examples]),
        boxes=np.concatenate([example.boxes for example in examples]).astype(np.float32),
        label=np.concatenate([example.labels for example in examples]),
        ignored=np.concatenate([example.ignored for example in examples]),
        labels=np.array(labels),
    )


def load_examples(path: Path) -> tuple[list[Example], tuple[str, ...]]:
    """Reads examples and the list of labels. Raises :class:`Refused` where the file is missing or another."""
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        starts = np.append(0, arrays["ends"][:-1])
        members = [np.flatnonzero(arrays["image"] == i) for i in range(len(starts))]
        examples = [
            Example(
                _image(arrays["jpegs"][start:end]),
                arrays["boxes"][rows].astype(np.float64),
                arrays["label"][rows],
                arrays["ignored"][rows],
            )
            for start, end, rows in zip(starts, arrays["ends"], members, strict=True)
        ]
    except (OSError, KeyError, ValueError) as error:
        raise Refused(f"{path}: not a file of examples ({error})") from None
    return examples, tuple(arrays["labels"].tolist())


def _jpeg(image: Image) -> bytes:
    parameters = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), parameters)[1].tobytes()


def _image(jpeg: NDArray[Any]) -> Image:
    image = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError("a JPEG image is damaged")
    return np.ascontiguousarray(image[..., ::-1], np.uint8)
