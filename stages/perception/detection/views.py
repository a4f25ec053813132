"""Views of every object of a catalogue: rendered, described, and kept in a small file."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from runner.contract import Refused
from stages.geometry.arrays import Floats
from stages.perception.detection.appearance import Looks, Mask, Piece, square
from stages.perception.rendering.contact_sheet import looking_at
from stages.perception.rendering.rasteriser import Float32s, Soup, View, inverse_depth
from stages.perception.rendering.renderer import Camera, Item, Light, Lighting, Renderer
from stages.scene.catalogue import Catalogue, CatalogueObject
from stages.scene.catalogue.mesh_shape import resting_rotations, transform

_SOURCES = ("views", "appearance", "backbone")
_ELEVATIONS = (10.0, 30.0, 50.0, 70.0)
"""Degrees above the horizon from which objects are seen."""
_AZIMUTHS = 6
_SIZE = 224
"""Pixels along a render."""
_NEAR = 2.5
"""The camera's distance in radii of the object, and at least _LEAST metres."""
_LEAST = 0.7
_SMALLEST = 40
"""Pixels below which a view shows nothing."""
_CHANNELS = 64
"""Of the middle features' principal components that are kept cell by cell."""


@dataclass(frozen=True)
class Views:
    """What N rendered views of a catalogue's objects look like, and how large they are."""

    labels: tuple[str, ...]
    """The catalogue's names."""
    label: NDArray[np.int64]
    """N, index into ``labels``."""
    elevation: Float32s
    """N, degrees above the horizon from which it is seen."""
    extent: Float32s
    """N x 2: width and height of the view's box, metres at the depth of what it shows."""
    top: Float32s
    """N: the highest point above the plane it rests on, metres."""
    middle: Float32s
    """N x 112; this and what follows is of :class:`Looks`."""
    last: Float32s
    """N x 320."""
    grid: Float32s
    """N x GRID^2 x _CHANNELS, in the basis of the principal components, unit length."""
    covered: Mask
    chroma: Float32s
    light: Float32s
    outline: Mask
    basis: Float32s
    """112 x _CHANNELS."""

    @staticmethod
    def learn(catalogue: Catalogue, *, azimuths: int = _AZIMUTHS) -> Views:
        """Renders every object in every way it rests on a plane, from so many sides at each of four elevations."""
        renderer = Renderer(_SIZE, _SIZE)
        items = enumerate(catalogue.objects.values())
        rendered = [(index, *view) for index, item in items for view in _views(item, renderer, azimuths)]
        renderer.close()
        label, elevation, extent, top, pieces = zip(*rendered, strict=True)
        looks = Looks.of(pieces)
        basis = _basis(looks)
        return Views(
            labels=tuple(catalogue.objects),
            label=np.array(label),
            elevation=np.array(elevation, np.float32),
            extent=np.array(extent, np.float32),
            top=np.array(top, np.float32),
            middle=looks.middle,
            last=looks.last,
            grid=projected(looks.grid, basis),
            covered=looks.covered,
            chroma=looks.chroma,
            light=looks.light,
            outline=looks.outline,
            basis=basis,
        )

    @staticmethod
    def of(catalogue: Path, learned: Path | None, *, place: str) -> Views:
        """Those of a catalogue: what a file has of it, or learned now unless that was done before.

        Raises:
            Refused: the file is of another catalogue; ``place`` names the setting.
        """
        objects = Catalogue.shared(catalogue)
        views = Views.load(learned) if learned else Views.cached(objects)
        if set(views.labels) != set(objects.objects):
            raise Refused(
                f"{place}: {learned} has the views of {', '.join(views.labels)}, but the objects of {catalogue} are "
                f"{', '.join(objects.objects)}; learn the catalogue again"
            )
        return views

    @staticmethod
    def cached(catalogue: Catalogue) -> Views:
        """As :meth:`learn`, but kept in the user's cache folder for the next time."""
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "scene-programming"
        path = folder / f"views-{_digest(catalogue)}.safetensors"
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # Of several processes that begin together one learns.
            if not path.is_file():
                Views.learn(catalogue).save(path)
        return Views.load(path)

    def save(self, path: Path) -> None:
        """Writes a safetensors file: features in half precision, cells in whole numbers of 1/127."""
        tensors = {
            field.name: np.asarray(getattr(self, field.name)) for field in fields(self) if field.name != "labels"
        }
        tensors = {name: array.astype(np.float16) if array.dtype == np.float32 else array
                   for name, array in tensors.items()}  # fmt: skip
        tensors["grid"] = np.round(self.grid[self.covered] * 127).astype(np.int8)
        tensors["outline"] = np.packbits(self.outline, axis=1)
        path.parent.mkdir(parents=True, exist_ok=True)
        # Whoever reads at the same time finds the whole file or none.
        unfinished = path.with_suffix(f".{os.getpid()}")
        save_file(tensors, unfinished, metadata={"labels": json.dumps(self.labels)})
        unfinished.replace(path)

    @staticmethod
    def load(path: Path) -> Views:
        """Reads what :meth:`save` wrote.

        Raises:
            Refused: the file is missing or something else.
        """
        try:
            with safe_open(path, framework="np") as file:
                labels = tuple(json.loads((file.metadata() or {})["labels"]))
                stored = {field.name: file.get_tensor(field.name) for field in fields(Views) if field.name != "labels"}
        except (OSError, SafetensorError, KeyError, ValueError) as error:
            raise Refused(f"{path}: not the views of a catalogue ({str(error).splitlines()[0]}); make them with "
                          "python -m stages.perception.detection.learn CATALOGUE OUT") from None  # fmt: skip
        covered, cells = stored["covered"], stored.pop("grid")
        grid = np.zeros((*covered.shape, cells.shape[1]), np.float32)
        grid[covered] = unit(cells.astype(np.float32))
        stored = {name: array.astype(np.float32) if array.dtype == np.float16 else array
                  for name, array in stored.items()}  # fmt: skip
        outline = np.unpackbits(stored.pop("outline"), axis=1).astype(bool)
        return Views(labels=labels, grid=grid, outline=outline, **stored)


def unit(rows: Float32s) -> Float32s:
    """Rows of unit length; those of zeros stay."""
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-9)


def projected(grid: Float32s, basis: Float32s) -> Float32s:
    """Cells of middle features (... x 112) in the basis, unit length."""
    return unit(grid @ basis)


def _digest(catalogue: Catalogue) -> str:
    """Names what views of a catalogue depend on: its meshes, and the code that makes views."""
    digest = sha256(b"".join(Path(__file__).with_name(f"{name}.py").read_bytes() for name in _SOURCES))
    for name, item in catalogue.objects.items():
        digest.update(name.encode())
        for array in (item.mesh.vertices, item.mesh.faces, item.mesh.colors):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _basis(looks: Looks) -> Float32s:
    """The directions that keep most of the cells' length, 112 x _CHANNELS."""
    cells = unit(looks.grid[looks.covered])
    return np.linalg.eigh(cells.T @ cells)[1][:, : -_CHANNELS - 1 : -1].copy()


def _views(
    item: CatalogueObject, renderer: Renderer, azimuths: int
) -> Iterator[tuple[float, tuple[float, float], float, Piece]]:
    """Elevation, extent, top, crop and mask of every view of an object."""
    middle = item.bounds.mean(0)
    radius = float(np.linalg.norm(item.mesh.vertices - middle, axis=1).max())
    distance = max(_NEAR * radius, _LEAST)
    focal = 0.48 * _SIZE / np.tan(np.arcsin(radius / distance))
    K = np.array([[focal, 0, _SIZE / 2 - 0.5], [0, focal, _SIZE / 2 - 0.5], [0, 0, 1.0]])
    soup = Soup.of(item.mesh)
    for R in resting_rotations(item.mesh):
        top = float(np.ptp(item.mesh.vertices @ R[2]))
        placed = Item(item.mesh, transform(R, -R @ middle))
        for elevation in _ELEVATIONS:
            for direction in _directions(elevation, azimuths):
                camera = Camera(K, looking_at(distance * direction, np.zeros(3)))
                T = np.linalg.inv(camera.T_world_camera) @ placed.T_world_item
                inverse = inverse_depth(soup, T, View.of(K, _SIZE, _SIZE))
                mask = inverse > 0
                if mask.sum() >= _SMALLEST:
                    rgb = renderer.color([placed], camera, lighting=_lighting(direction))
                    yield (
                        elevation,
                        _extent(mask, 1 / (focal * float(np.median(inverse[mask])))),
                        top,
                        square(rgb, mask),
                    )


def _directions(elevation: float, azimuths: int) -> Floats:
    """Unit vectors from the object to the camera, azimuths x 3."""
    up, around = np.deg2rad(elevation), np.arange(azimuths) * 2 * np.pi / azimuths
    return np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.full(azimuths, np.sin(up))], 1)


def _lighting(direction: Floats) -> Lighting:
    """Light from behind the camera and above, as rooms have it."""
    x, y, z = -direction - (0.0, 0.0, 0.8)
    return Lighting((Light("directional", (x, y, z), 2.2),), (0.55, 0.55, 0.55))


def _extent(mask: Mask, metres: float) -> tuple[float, float]:
    """Width and height of a mask's box whose pixels are so many metres."""
    return float(mask.any(0).sum() * metres), float(mask.any(1).sum() * metres)
