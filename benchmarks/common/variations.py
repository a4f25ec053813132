"""Other photographs from those that there are: half of the objects unknown, another camera."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from stages.messages import Frame
from stages.perception.detection.views import Views
from stages.scene.catalogue.loading import written_link

_EXPOSURE, _BALANCE, _GAMMA = 0.35, 0.1, 0.2
"""Natural logarithms by which all colours, each by itself, and the exponent of brightness are off at most."""
_BLUR, _GRAIN = (0.0, 0.6, 1.0), 5.0
"""Pixels (at 640 pixels across) of blur, and grey levels of noise at most."""
_DEPTH, _SHIFT, _NOISE = 0.015, 3.0, 0.0015
"""Share by which depths are off, pixels (at 640 pixels across) by which they are off colour, and metres of noise at one
metre, which grows with the square of depth."""


@dataclass(frozen=True)
class Objects:
    """A catalogue and what is learned of it."""

    catalogue: Path
    learned: Path | None
    """None learns it at the start."""


def half(models: Path, views: Views, odd: bool, folder: Path) -> Objects:
    """The objects of a BOP ``models`` folder with odd numbers, or with even ones; the others become unknown."""
    models = written_link(models) or models
    infos = json.loads((models / "models_info.json").read_text())
    infos = {number: info for number, info in infos.items() if int(number) % 2 == odd}
    found = Objects(folder / "models", learned := folder / "views.safetensors")
    found.catalogue.mkdir(parents=True, exist_ok=True)
    (found.catalogue / "models_info.json").write_text(json.dumps(infos))
    for number in infos:
        link = found.catalogue / f"obj_{int(number):06d}.ply"
        link.unlink(missing_ok=True)
        link.symlink_to((models / link.name).resolve())
    labels = tuple(info["name"] for info in infos.values())
    columns = [views.labels.index(label) for label in labels]
    rows = np.isin(views.label, columns)
    kept = {field.name: getattr(views, field.name)[rows] for field in fields(Views)
            if field.name not in ("labels", "label", "basis")}  # fmt: skip
    label = np.array([columns.index(column) for column in views.label[rows]])
    replace(views, labels=labels, label=label, **kept).save(learned)
    return found


def by_another_camera(frame: Frame, seed: int) -> tuple[Frame, float]:
    """The same frame with other exposure, white balance, sharpness, noise, depth scale and registration.

    And by how much depths, and so the true poses, are farther.
    """
    rng = np.random.default_rng([seed, frame.scene_id, frame.image_id])
    scale = frame.rgb.shape[1] / 640
    gains = np.exp(rng.uniform(-_EXPOSURE, _EXPOSURE)) * np.exp(rng.uniform(-_BALANCE, _BALANCE, 3))
    rgb = (frame.rgb / 255.0) ** np.exp(rng.uniform(-_GAMMA, _GAMMA)) * gains * 255
    rgb = np.clip(rgb, 0, 255)
    blur = float(rng.choice(_BLUR))
    if blur:
        rgb = cv2.GaussianBlur(rgb, (0, 0), blur * scale)
    rgb = np.clip(rgb + rng.normal(0, rng.uniform(0, _GRAIN), rgb.shape), 0, 255).astype(np.uint8)
    farther = 1 + float(rng.uniform(-_DEPTH, _DEPTH))
    shift = np.rint(rng.uniform(-_SHIFT, _SHIFT, 2) * scale).astype(int).tolist()
    depth = np.roll(frame.depth * np.float32(farther), shift, (0, 1))
    noise = rng.normal(0, _NOISE, depth.shape).astype(np.float32) * depth**2
    depth = np.where(depth > 0, depth + noise, 0).astype(np.float32)
    return msgspec.structs.replace(frame, rgb=rgb, depth=depth), farther
