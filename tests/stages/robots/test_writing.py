"""Where the camera is gets into a description; nothing else of the file changes."""

from pathlib import Path

import numpy as np
import pytest

from stages.geometry.poses import exp_so3, pose
from stages.robots import read_robot
from stages.robots.writing import with_camera
from tests.stages.robots.test_robots import FOLDER

T = pose(exp_so3(np.array([1.2, -0.3, 2.0])), np.array([0.123, -0.456, 0.789]))


@pytest.mark.parametrize("name", ["ur5e", "fetch"])
def test_only_the_camera_of_a_description_changes(name: str, tmp_path: Path) -> None:
    file = tmp_path / f"{name}.yaml"
    before = (FOLDER / file.name).read_text()
    file.write_text(before)
    camera = read_robot(file).camera
    with_camera(file, file, camera.link, T, "2026-01-02, 15 boards")
    read_robot.cache_clear()
    now = read_robot(file).camera
    assert now.T_link_camera is not None
    np.testing.assert_allclose(now.T_link_camera, T, atol=1e-5)
    assert (now.link, now.focal, now.size, now.calibrated) == (
        camera.link,
        camera.focal,
        camera.size,
        "2026-01-02, 15 boards",
    )
    kept = [line for line in before.splitlines() if not line.startswith("camera:")]
    assert [line for line in file.read_text().splitlines() if line in kept] == kept


def test_it_is_written_again(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    for note in ("first", "second"):
        with_camera(FOLDER / "ur5e.yaml" if note == "first" else file, file, "", T, note)
    text = file.read_text()
    assert text.startswith(f"# Its camera was calibrated.\nlike: {FOLDER / 'ur5e.yaml'}\ncamera:\n")
    assert text.count("camera:") == 1 and "calibrated: second" in text and "first" not in text


def test_comments_after_the_camera_stay(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(
        f"like: {FOLDER}/ur5e.yaml\ncamera:\n  position: [0, 0, 1]\n  focal: 620\n  size: [640, 480]\n"
        "\n# The floor.\nfloor: -0.7\n"
    )
    with_camera(file, file, "", T, "now")
    assert file.read_text().endswith("calibrated: now\n\n# The floor.\nfloor: -0.7\n")
