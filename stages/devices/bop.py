"""Reads data sets in BOP format: the images that ``test_targets_bop19.json`` lists, checked before the first is used.

Format: https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from runner.contract import Refused
from stages.geometry.camera import checked_depth, checked_intrinsics
from stages.messages.arrays import Depth, Intrinsics, Rgb

TARGETS = "test_targets_bop19.json"
_COLOR_SUFFIXES = (".png", ".jpg")
_DEPTH_MODES = ("I;16", "I;16B", "I")
"""Pillow's, of one channel of 16 or 32 bits."""


@dataclass(frozen=True)
class BopImage:
    """One image of a data set and where its files are."""

    scene_id: int
    image_id: int
    n_objects: int
    """Objects that the targets file asks for in this image."""
    rgb: Path
    depth: Path
    K: Intrinsics
    depth_scale: float
    """Millimetres per unit of the depth image."""

    def read(self) -> tuple[Rgb, Depth]:
        """Colour (H x W x 3) and depth (H x W, metres, 0 = no reading).

        Raises:
            Refused: a file cannot be decoded, or depth cannot be metres.
        """
        rgb = np.ascontiguousarray(_pixels(self.rgb, "RGB"), np.uint8)
        millimetres = _pixels(self.depth).astype(np.float64) * self.depth_scale
        try:
            return rgb, checked_depth((millimetres / 1000.0).astype(np.float32))
        except ValueError as error:
            raise Refused(f"{self.depth}: {error}; a unit is depth_scale = {self.depth_scale:g} millimetres") from None


class _Target(msgspec.Struct, frozen=True):
    scene_id: int
    im_id: int
    obj_id: int
    inst_count: Annotated[int, msgspec.Meta(ge=1)]


class _View(msgspec.Struct, frozen=True):
    cam_K: Annotated[list[float], msgspec.Meta(min_length=9, max_length=9)]
    depth_scale: Annotated[float, msgspec.Meta(gt=0)]


def read_dataset(dataset: Path) -> list[BopImage]:
    """Every image of the data set's targets, in the order of the file.

    Raises:
        Refused: a file is missing or malformed, colour and depth differ in size, or depth is not of 16 bits; names
            file, image and key.
    """
    if not dataset.is_dir():
        raise Refused(f"{dataset}: no such data set folder; it holds {TARGETS}, test/ and models/")
    file = dataset / TARGETS
    counts: dict[tuple[int, int], int] = {}
    for target in _decoded(file, list[_Target]):
        key = (target.scene_id, target.im_id)
        counts[key] = counts.get(key, 0) + target.inst_count
    if not counts:
        raise Refused(f"{file}: lists no images")
    cameras = {scene: _cameras(dataset / "test" / f"{scene:06d}") for scene in dict.fromkeys(s for s, _ in counts)}
    return [_image(dataset, key, count, cameras[key[0]]) for key, count in counts.items()]


def _cameras(scene: Path) -> dict[str, Any]:
    return _decoded(scene / "scene_camera.json", dict[str, Any])


def _image(dataset: Path, key: tuple[int, int], n_objects: int, cameras: dict[str, Any]) -> BopImage:
    scene_id, image_id = key
    scene = dataset / "test" / f"{scene_id:06d}"
    view = _view(scene / "scene_camera.json", str(image_id), cameras)
    name = f"{image_id:06d}"
    rgb = _existing((scene / "rgb" / f"{name}{suffix}" for suffix in _COLOR_SUFFIXES), "colour")
    depth = _existing([scene / "depth" / f"{name}.png"], "depth")
    (size, mode), (wanted, _) = _header(depth), _header(rgb)
    if size != wanted:
        raise Refused(f"{depth}: {_shown(size)} pixels, but the colour image has {_shown(wanted)}")
    if mode not in _DEPTH_MODES:
        raise Refused(f"{depth}: an image of mode {mode}; depth is one channel of 16 bits ({', '.join(_DEPTH_MODES)})")
    try:
        K = checked_intrinsics(np.array(view.cam_K, np.float64).reshape(3, 3))
    except ValueError as error:
        raise Refused(f"{scene / 'scene_camera.json'}: image {image_id}: cam_K: {error}") from None
    return BopImage(scene_id, image_id, n_objects, rgb, depth, K, view.depth_scale)


def _view(file: Path, key: str, cameras: dict[str, Any]) -> _View:
    if key not in cameras:
        raise Refused(f"{file}: image {key} is missing; there are {', '.join(list(cameras)[:8])}")
    try:
        return msgspec.convert(cameras[key], _View)
    except msgspec.ValidationError as error:
        raise Refused(f"{file}: image {key}: {error}") from None


def _existing(candidates: Iterable[Path], kind: str) -> Path:
    files = list(candidates)
    for file in files:
        if file.is_file():
            return file
    raise Refused(f"{files[0]}: the {kind} image is missing")


def _decoded(file: Path, kind: Any) -> Any:
    try:
        return msgspec.json.decode(file.read_bytes(), type=kind)
    except OSError as error:
        raise Refused(f"{file}: cannot be read: {error.strerror}") from None
    except msgspec.MsgspecError as error:
        raise Refused(f"{file}: {error}") from None


def _header(file: Path) -> tuple[tuple[int, int], str]:
    """Width and height, and Pillow's mode."""
    try:
        with Image.open(file) as image:
            return image.size, image.mode
    except (OSError, UnidentifiedImageError) as error:
        _unreadable(file, error)


def _pixels(file: Path, mode: str | None = None) -> NDArray[Any]:
    try:
        with Image.open(file) as image:
            return np.asarray(image.convert(mode) if mode else image)
    except (OSError, UnidentifiedImageError) as error:
        _unreadable(file, error)


def _unreadable(file: Path, error: Exception) -> NoReturn:
    raise Refused(f"{file}: not a readable image: {error}") from None


def _shown(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"
