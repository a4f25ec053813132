"""Writes where the camera is into a robot's description; everything else in the file stays as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from stages.geometry.arrays import Floats
from stages.robots.reading import read_robot

_KEY = "camera"


def with_camera(file: Path, target: Path, link: str, T_link_camera: Floats, note: str) -> None:
    """Writes ``target``: ``file`` with its camera at ``T_link_camera`` (4 x 4); ``link`` is empty for the base.

    ``note`` says when and how well that was measured. Where ``target`` is another file, it is ``like`` the first.

    Raises:
        Refused: what would be written is no description; nothing is written then.
    """
    camera = read_robot(file).camera
    rotation = Rotation.from_matrix(T_link_camera[:3, :3]).as_euler("xyz", degrees=True)
    lines = [
        f"{_KEY}:",
        *([f"  link: {link}"] if link else []),
        f"  position: {_numbers(T_link_camera[:3, 3], 5)}",
        f"  rotation: {_numbers(rotation, 4)}",
        f"  focal: {camera.focal:g}",
        f"  size: {list(camera.size)}",
        f"  calibrated: {note}",
    ]
    text = file.read_text() if target == file else f"# Its camera was calibrated.\nlike: {file}\n"
    draft = target.with_name(f".{target.stem}-new{target.suffix}")
    draft.write_text("\n".join(_replaced(text.splitlines(), lines)) + "\n")
    try:
        read_robot(draft)
        draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)


def _replaced(text: list[str], camera: list[str]) -> list[str]:
    """The lines with those of the camera instead of what stands there, or at the end."""
    root = yaml.compose("\n".join(text))
    assert isinstance(root, yaml.MappingNode)  # It has been read.
    for key, value in root.value:
        if key.value == _KEY:
            first, behind = key.start_mark.line, value.end_mark
            last = behind.line + (behind.column > 0)
            while last > first + 1 and not text[last - 1].split("#")[0].strip():
                last -= 1  # Comments and empty lines in front of the next key belong to that.
            return [*text[:first], *camera, *text[last:]]
    return [*text, *camera]


def _numbers(values: Floats, digits: int) -> str:
    return f"[{', '.join(f'{value:.{digits}f}' for value in np.asarray(values) + 0.0)}]"
