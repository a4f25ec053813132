"""Clutter: objects of a catalogue piled by physics and seen by a structured-light camera, as a BOP data set."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from stages.devices.bop import TARGETS
from stages.devices.drops import Thing, settle, things
from stages.geometry.arrays import Floats
from stages.geometry.poses import inverse
from stages.messages.arrays import Depth, Rgb
from stages.perception.detection.trained.training_images import random_texture
from stages.perception.rendering.contact_sheet import looking_at
from stages.perception.rendering.depth_noise import StructuredLight, color_noise, structured_light
from stages.perception.rendering.renderer import Camera, Item, Light, Lighting, Renderer
from stages.scene.catalogue import Catalogue, CatalogueObject, Mesh

SIZE = 640, 480
K = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
SENSOR = StructuredLight(disparity_sigma=0.06, edge_dropout=0.45, holes=0.006)
"""Noisier than the simulated robot's camera."""
COUNTS = (5, 6, 4, 7, 5, 6, 3, 6, 5, 5)
"""Objects of ten scenes: 104 in 20 scenes, 3 to 7 in one."""
LEAST_VISIBLE = 0.2
"""A pile of which an object shows a smaller share is dropped again."""
_FARTHEST = 0.3
"""Metres from the middle at which an object has rolled out of the pile."""
_RESTING_SHARE = 0.45
_STILL = 0.002
"""Metres that no object moves any more in 1.4 s."""
_DEPTH_SCALE = 0.1
"""Millimetres per unit of the depth images."""
_TABLE = 0.8
_CELLS = 40


@dataclass(frozen=True, kw_only=True)
class Pile:
    """How objects are piled and seen; the defaults are Clutter-15's."""

    counts: tuple[int, ...] = COUNTS
    """Objects of one scene after the other, then from the first again."""
    labels: tuple[str, ...] = ()
    """The objects that scenes choose from; none means all of the catalogue."""
    spread: float = 0.045
    """Standard deviation of where objects are dropped, metres."""
    least_visible: float = LEAST_VISIBLE
    """Share of its silhouette that every object shows."""
    views: int = 5
    """Of which the one is taken that hides most."""
    distance: tuple[float, float] = (0.8, 1.2)
    """Metres between camera and pile."""
    pitch: tuple[float, float] = (25.0, 60.0)
    """Degrees between the line of sight and the table."""
    sensor: StructuredLight = SENSOR
    jitter: float = 0.05
    """Share of its size by which a noisy box is off."""
    false: tuple[int, int] = (2, 3)
    """Least and greatest number of noisy boxes of objects that are not there."""


CLUTTER_15 = Pile()


@dataclass(frozen=True)
class Seen:
    """What can be seen of one object; boxes are x, y, width, height in pixels."""

    box: tuple[int, int, int, int]
    visible_box: tuple[int, int, int, int]
    pixels: int
    visible_pixels: int

    @property
    def visible(self) -> float:
        """Share of the silhouette that nothing hides."""
        return self.visible_pixels / max(1, self.pixels)


@dataclass(frozen=True)
class ClutterImage:
    """One image of a pile, and the truth."""

    labels: tuple[str, ...]
    T_world_objects: tuple[Floats, ...]
    """The table is z = 0."""
    camera: Camera
    rgb: Rgb
    depth: Depth
    seen: tuple[Seen, ...]


class Clutter:
    """Piles of the objects of a catalogue; scene ``i`` of a seed is the same whatever else is generated."""

    def __init__(self, catalogue: Catalogue, *, seed: int = 0, pile: Pile = CLUTTER_15) -> None:
        self._catalogue = catalogue
        self._things = dict(zip(catalogue.objects, things(catalogue), strict=True))
        self._seed = seed
        self._pile = pile
        self._renderer = Renderer(*SIZE)

    def chosen(self, count: int) -> list[tuple[str, ...]]:
        """The objects of the first ``count`` scenes: all that there are equally often, none twice in a scene."""
        rng = np.random.default_rng([self._seed, 0])
        counts = self._pile.counts
        used = dict.fromkeys(self._pile.labels or self._catalogue.objects, 0)
        scenes: list[tuple[str, ...]] = []
        for index in range(count):
            order = {label: (used[label], rng.random()) for label in used}
            size = min(counts[index % len(counts)], len(used))
            scenes.append(tuple(sorted(used, key=order.__getitem__)[:size]))
            for label in scenes[-1]:
                used[label] += 1
        return scenes

    def scene(self, index: int, labels: Sequence[str]) -> ClutterImage:
        """Drops the objects until a view shows enough of each, and takes of its views the one that hides most."""
        rng = np.random.default_rng([self._seed, 1, index])
        while True:
            poses = self._dropped(labels, rng)
            cameras = [_camera(poses, self._pile, rng) for _ in range(self._pile.views)] if poses else []
            views = [(camera, self._see(labels, poses, camera)) for camera in cameras]
            views = [view for view in views if _enough(view[1], self._pile.least_visible)]
            if views:
                camera, seen = min(views, key=lambda view: np.mean([each.visible for each in view[1]]))
                rgb, depth = self._image(labels, poses, camera, rng)
                return ClutterImage(tuple(labels), tuple(poses), camera, rgb, depth, tuple(seen))

    def close(self) -> None:
        """Frees the renderer."""
        self._renderer.close()

    def _dropped(self, labels: Sequence[str], rng: np.random.Generator) -> list[Floats]:
        """T_world_object of each, dropped one after the other, the widest first; empty where one rolled away."""
        order = sorted(range(len(labels)), key=lambda i: -_width(self._things[labels[i]]))
        down: list[Thing] = []
        poses: list[Floats] = []
        for i in order:
            down.append(self._things[labels[i]])
            poses = settle(down, [*poses, _start(down[-1], down, poses, self._pile.spread, rng)])
        still = _resting(down, poses)
        if still is None or any(np.linalg.norm(T[:2, 3]) > _FARTHEST for T in still):
            return []
        return [still[order.index(i)] for i in range(len(labels))]

    def _items(self, labels: Sequence[str], poses: Sequence[Floats]) -> list[Item]:
        return [Item(self._catalogue[label].mesh, T) for label, T in zip(labels, poses, strict=True)]

    def _see(self, labels: Sequence[str], poses: Sequence[Floats], camera: Camera) -> list[Seen]:
        items = self._items(labels, poses)
        identity, _ = self._renderer.instances(items, camera)
        alone = [self._renderer.depth([item], camera) > 0 for item in items]
        return [_seen(mask, identity == i) for i, mask in enumerate(alone)]

    def _image(
        self, labels: Sequence[str], poses: Sequence[Floats], camera: Camera, rng: np.random.Generator
    ) -> tuple[Rgb, Depth]:
        items = [*self._items(labels, poses), Item(_table(rng), np.eye(4))]
        grey = int(rng.integers(40, 200))
        rgb = self._renderer.color(items, camera, lighting=_lighting(rng), background=(grey, grey, grey))
        depth = self._renderer.depth(items, camera)
        return color_noise(rgb, rng, sigma=4.0), structured_light(depth, camera.K, rng, self._pile.sensor)


def _width(thing: Thing) -> float:
    return float(np.ptp(thing.mesh.vertices[:, :2], axis=0).max())


def _start(
    thing: Thing, down: Sequence[Thing], poses: Sequence[Floats], spread: float, rng: np.random.Generator
) -> Floats:
    """A pose above whatever lies where the thing is dropped."""
    T = np.eye(4)
    if rng.random() < _RESTING_SHARE or not poses:
        turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        T[:3, :3] = turn @ thing.resting[int(rng.integers(len(thing.resting))) if poses else 0]
    else:
        T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:2, 3] = rng.normal(0, spread, 2) if poses else 0.0
    points = thing.mesh.vertices @ T[:3, :3].T
    reach = float(np.linalg.norm(points[:, :2], axis=1).max())
    T[2, 3] = _top(T[:2, 3], reach, down, poses) + 0.01 - points[:, 2].min()
    return T


def _top(centre: Floats, reach: float, down: Sequence[Thing], poses: Sequence[Floats]) -> float:
    """Height of what lies within ``reach`` of a place, metres."""
    top = 0.0
    for thing, T in zip(down, poses, strict=False):
        points = thing.mesh.vertices @ T[:3, :3].T + T[:3, 3]
        near = np.linalg.norm(points[:, :2] - centre, axis=1) < reach
        top = max(top, float(points[near, 2].max(initial=0.0)))
    return top


def _resting(down: Sequence[Thing], poses: list[Floats]) -> list[Floats] | None:
    """The poses once nothing moves; None where something goes on rolling."""
    for _ in range(4):
        later = settle(down, poses)
        moved = max(np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(poses, later, strict=True))
        poses = later
        if moved < _STILL:
            return poses
    return None


def _camera(poses: Sequence[Floats], pile: Pile, rng: np.random.Generator) -> Camera:
    """Looks at the pile from above the table."""
    target = np.mean([T[:3, 3] for T in poses], axis=0) + rng.normal(0, 0.02, 3)
    pitch, turn = np.deg2rad(rng.uniform(*pile.pitch)), rng.uniform(0, 2 * np.pi)
    away = np.array([np.cos(pitch) * np.cos(turn), np.cos(pitch) * np.sin(turn), np.sin(pitch)])
    T = looking_at(target + rng.uniform(*pile.distance) * away, target)
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("z", rng.normal(0, 3), degrees=True).as_matrix()
    return Camera(K, T)


def _seen(alone: NDArray[np.bool_], visible: NDArray[np.bool_]) -> Seen:
    return Seen(_box(alone), _box(visible), int(alone.sum()), int(visible.sum()))


def _box(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(columns):
        return -1, -1, -1, -1
    return int(columns[0]), int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1


def _enough(seen: Sequence[Seen], least_visible: float) -> bool:
    """Whether all objects lie in the image and show enough of themselves."""
    return all(
        each.visible >= least_visible
        and min(each.box[:2]) > 0
        and each.box[0] + each.box[2] < SIZE[0]
        and each.box[1] + each.box[3] < SIZE[1]
        for each in seen
    )


def _table(rng: np.random.Generator) -> Mesh:
    """A textured square whose surface is z = 0."""
    x, y = np.meshgrid(*(2 * [np.linspace(-_TABLE, _TABLE, _CELLS)]))
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    corner = (np.arange(_CELLS - 1)[:, None] * _CELLS + np.arange(_CELLS - 1)).reshape(-1)
    right, above = corner + 1, corner + _CELLS
    faces = np.concatenate([np.stack([corner, right, above + 1], 1), np.stack([corner, above + 1, above], 1)])
    texture = random_texture(rng)
    pick = np.linspace(0, len(texture) - 1, _CELLS).astype(int)
    return Mesh(vertices, faces.astype(np.int32), texture[np.ix_(pick, pick)].reshape(-1, 3))


def _lighting(rng: np.random.Generator) -> Lighting:
    """Two lights from above and ambient light."""
    lights: list[Light] = []
    for strength in rng.uniform(0.8, 2.2, 2):
        x, y = rng.uniform(-1, 1, 2)
        lights.append(Light("directional", (x, y, -rng.uniform(0.6, 1.5)), float(strength)))
    ambient = float(rng.uniform(0.3, 0.5))
    return Lighting(tuple(lights), (ambient, ambient, ambient))


# --- BOP files --------------------------------------------------------------------------------------------------


def write_clutter(folder: Path, catalogue: Catalogue, *, scenes: int, seed: int, pile: Pile = CLUTTER_15) -> None:
    """Writes models, ``scenes`` images, truth, targets and detections; the same bytes for the same seed."""
    clutter = Clutter(catalogue, seed=seed, pile=pile)
    write_models(folder / "models", catalogue)
    targets: list[Any] = []
    exact: list[Any] = []
    noisy: list[Any] = []
    for index, labels in enumerate(clutter.chosen(scenes)):
        scene = clutter.scene(index, labels)
        numbers = [catalogue[label].label for label in labels]
        _write_scene(folder / "test" / f"{index + 1:06d}", scene, numbers)
        targets += [{"scene_id": index + 1, "im_id": 0, "obj_id": number, "inst_count": 1} for number in numbers]
        boxes = [list(each.visible_box) for each in scene.seen]
        exact += [_detection(index + 1, *each, 1.0) for each in zip(numbers, boxes, strict=True)]
        others = [item.label for item in catalogue.objects.values() if item.label not in numbers]
        rng = np.random.default_rng([seed, 2, index])
        noisy += [_detection(index + 1, *each) for each in _noisy(numbers, boxes, others, pile, rng)]
    clutter.close()
    _write_json(folder / TARGETS, targets)
    _write_json(folder / "detections_exact.json", exact)
    _write_json(folder / "detections_noisy.json", noisy)


def write_models(folder: Path, catalogue: Catalogue) -> None:
    """Meshes with vertex colours, millimetres, and ``models_info.json`` with names and symmetries."""
    folder.mkdir(parents=True, exist_ok=True)
    for item in catalogue.objects.values():
        mesh = trimesh.Trimesh(
            1000 * item.mesh.vertices, item.mesh.faces, vertex_colors=item.mesh.colors, process=False
        )
        content: Any = mesh.export(file_type="ply", vertex_normal=False)
        (folder / f"obj_{item.label:06d}.ply").write_bytes(content)
    _write_json(folder / "models_info.json", {str(each.label): _info(each) for each in catalogue.objects.values()})


def _info(item: CatalogueObject) -> dict[str, Any]:
    vertices = 1000 * item.mesh.vertices
    low, size = vertices.min(0), np.ptp(vertices, axis=0)
    info: dict[str, Any] = {"diameter": float(pdist(vertices[ConvexHull(vertices).vertices]).max())}
    info |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    info |= {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}
    info |= {"name": item.name, "concave": item.concave}
    symmetries = item.symmetries
    if len(symmetries.discrete):
        info["symmetries_discrete"] = [_flat(T) for T in symmetries.discrete]
    if symmetries.continuous:
        info["symmetries_continuous"] = [
            {"axis": axis.tolist(), "offset": (1000 * offset).tolist()} for axis, offset in symmetries.continuous
        ]
    if len(symmetries.near):
        info["near_symmetries_discrete"] = [_flat(T) for T in symmetries.near]
    return info


def _flat(T: Floats) -> list[float]:
    """Row by row, the translation in millimetres."""
    scaled = T.copy()
    scaled[:3, 3] *= 1000
    return scaled.reshape(-1).tolist()


def _write_scene(folder: Path, scene: ClutterImage, numbers: Sequence[int]) -> None:
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    Image.fromarray(scene.rgb).save(folder / "rgb" / "000000.png")
    units = np.round(1000 * scene.depth.astype(np.float64) / _DEPTH_SCALE)
    Image.fromarray(units.astype(np.uint16)).save(folder / "depth" / "000000.png")
    T_camera_world = inverse(scene.camera.T_world_camera)
    camera = {
        "cam_K": scene.camera.K.reshape(-1).tolist(),
        "depth_scale": _DEPTH_SCALE,
        "cam_R_w2c": T_camera_world[:3, :3].reshape(-1).tolist(),
        "cam_t_w2c": (1000 * T_camera_world[:3, 3]).tolist(),
    }
    truths = [_truth(T_camera_world @ T, number) for T, number in zip(scene.T_world_objects, numbers, strict=True)]
    infos = [
        {
            "bbox_obj": each.box, "bbox_visib": each.visible_box, "px_count_all": each.pixels,
            "px_count_visib": each.visible_pixels, "visib_fract": each.visible,
        }
        for each in scene.seen
    ]  # fmt: skip
    _write_json(folder / "scene_camera.json", {"0": camera})
    _write_json(folder / "scene_gt.json", {"0": truths})
    _write_json(folder / "scene_gt_info.json", {"0": infos})


def _truth(T_camera_object: Floats, number: int) -> dict[str, Any]:
    R, t = T_camera_object[:3, :3], 1000 * T_camera_object[:3, 3]
    return {"cam_R_m2c": R.reshape(-1).tolist(), "cam_t_m2c": t.tolist(), "obj_id": number}


def _noisy(
    numbers: Sequence[int], boxes: Sequence[Sequence[float]], others: Sequence[int], pile: Pile,
    rng: np.random.Generator,
) -> list[tuple[int, list[float], float]]:  # fmt: skip
    """Jittered true boxes, and a few false ones of objects that are not there, mostly on others' boxes."""
    found = [
        (number, _jittered(box, pile.jitter, rng), float(rng.uniform(0.6, 1.0)))
        for number, box in zip(numbers, boxes, strict=True)
    ]
    least, greatest = pile.false
    false = rng.permutation(np.asarray(others))[: int(rng.integers(least, greatest + 1))]
    for number in false:
        box = _jittered(boxes[int(rng.integers(len(boxes)))], 2 * pile.jitter, rng)
        if rng.random() < 0.25:
            box[:2] = (np.asarray(box[:2]) + rng.normal(0, 60, 2)).clip(0, np.array(SIZE) - box[2:]).tolist()
        found.append((int(number), box, float(rng.uniform(0.35, 0.95))))
    return found


def _jittered(box: Sequence[float], share: float, rng: np.random.Generator) -> list[float]:
    """The box moved and resized by about a ``share`` of its size."""
    x, y, width, height = box
    move, grow = rng.normal(0, share, 2), np.exp(rng.normal(0, share, 2))
    return [x + move[0] * width, y + move[1] * height, width * grow[0], height * grow[1]]


def _detection(scene: int, number: int, box: Sequence[float], score: float) -> dict[str, Any]:
    return {"scene_id": scene, "image_id": 0, "category_id": number, "bbox": list(box), "score": score, "time": 0.0}


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n")
