"""Which of several poses a photograph shows."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.geometry.poses import exp_so3, pose
from stages.perception.refinement.colour import ColourSettings, likeness, log_odds
from stages.perception.rendering.paint import Paint
from stages.perception.rendering.rasteriser import Soup, View, inverse_depth
from stages.scene.catalogue import Mesh
from tests.stages.perception.painted import painted
from tests.stages.perception.scenes import CATALOGUE

VIEW = View(500.0, 500.0, 79.5, 79.5, 160, 160)
CAN = CATALOGUE["soup_can"].mesh
STANDING = pose(exp_so3(np.array([np.pi / 2 + 0.6, 0.0, 0.0])), np.array([0.0, 0.0, 0.6]))
YAWS = np.stack([pose(exp_so3(np.array([0.0, 0.0, yaw])), np.zeros(3)) for yaw in np.deg2rad(np.arange(0, 360, 30))])
OVER = pose(exp_so3(np.array([np.pi, 0.0, 0.0])), np.zeros(3))
POSES = np.concatenate([STANDING @ YAWS, STANDING @ OVER @ YAWS])[:, :3]
"""One end up at twelve yaws, then the other. The label is printed twice: six yaws farther all looks the same."""
PLAIN = replace(CAN, colors=np.full_like(CAN.colors, (180, 40, 30)))
SHOWN = inverse_depth(Soup.of(CAN), STANDING, VIEW) > 0


def odds(rgb: np.ndarray, *, shown: np.ndarray = SHOWN, mesh: Mesh = CAN) -> np.ndarray:
    return log_odds(rgb, VIEW, shown, POSES, paint=Paint.of(mesh), settings=ColourSettings())


@pytest.mark.parametrize("true", [2, 17])
def test_end_and_yaw_are_seen(true: int) -> None:
    found = odds(painted([(CAN, POSES[true])], VIEW))
    assert np.argmax(found) % 6 == true % 6
    ends = found.reshape(2, 12).max(1)
    assert ends[true // 12] > ends[1 - true // 12] + 5


@pytest.mark.parametrize("what", ["dark", "bright", "yellow light", "lit from one side", "blurred", "beside depth"])
def test_the_camera_does_not_matter(what: str) -> None:
    rgb = painted([(CAN, POSES[17])], VIEW, ambient=0.25 if what == "lit from one side" else 0.5).astype(np.float32)
    changed = {
        "dark": 0.4 * rgb,
        "bright": 1.25 * rgb + 20,
        "yellow light": rgb * [1.15, 1.0, 0.7],
        "blurred": cv2.GaussianBlur(rgb, (0, 0), 1.5),
        "beside depth": np.roll(rgb, (4, -5), (0, 1)),
    }
    found = odds(np.clip(changed.get(what, rgb), 0, 255).astype(np.uint8))
    assert np.argmax(found) // 12 == 1
    # Beside depth, a yaw and a shift look nearly alike.
    assert np.argmax(found) % 6 in ({4, 5, 0} if what == "beside depth" else {5})


@pytest.mark.parametrize("light", [0.5, 1.2])
def test_a_photograph_looks_like_what_is_there_and_not_like_what_merely_has_its_shape(light: float) -> None:
    other = replace(CAN, colors=np.ascontiguousarray(CAN.colors[::-1]))
    there = [
        likeness(
            np.clip(light * painted([(mesh, POSES[17])], VIEW).astype(float), 0, 255).astype(np.uint8),
            VIEW, SHOWN, POSES, paint=Paint.of(CAN), settings=ColourSettings(),
        )
        for mesh in (CAN, other)
    ]  # fmt: skip
    assert there[0] > there[1] + 0.5, there


def test_a_white_lid_is_no_black_one_in_bright_light() -> None:
    z, rim = CAN.vertices[:, 2], 0.002
    grey = np.where(z > z.max() - rim, 235, np.where(z < z.min() + rim, 25, 110))
    lids = replace(CAN, colors=np.repeat(grey[:, None], 3, 1).astype(np.uint8))
    for true in (0, 12):
        found = odds(painted([(lids, POSES[true])], VIEW), mesh=lids)
        assert np.argmax(found) // 12 == true // 12


def test_one_colour_says_nothing() -> None:
    assert np.ptp(odds(painted([(PLAIN, STANDING)], VIEW), mesh=PLAIN)) == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("seen", ["nothing", "noise"])
def test_an_image_that_shows_nothing_says_little(seen: str) -> None:
    noise = np.random.default_rng(5).integers(0, 256, (VIEW.height, VIEW.width, 3)).astype(np.uint8)
    assert np.ptp(odds(noise if seen == "noise" else 0 * noise)) < 5


def test_a_few_pixels_say_nothing() -> None:
    few = np.zeros_like(SHOWN)
    few[80:88, 80:88] = True
    photograph = painted([(CAN, STANDING)], VIEW)
    assert not odds(photograph, shown=few).any()
    alike = likeness(photograph, VIEW, few, POSES[:1], paint=Paint.of(CAN), settings=ColourSettings())
    assert np.isnan(alike)


SCRIPT = """
from tests.stages.perception.painted import painted
from tests.stages.perception.refinement.test_colour import CAN, POSES, VIEW, odds
print(odds(painted([(CAN, POSES[2])], VIEW)).tobytes().hex())
"""


def test_no_byte_depends_on_the_number_of_threads() -> None:
    def printed(threads: int) -> str:
        counts = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
        script = [sys.executable, "-c", SCRIPT]
        root = Path(__file__).parents[4]
        return subprocess.run(script, cwd=root, env=os.environ | counts, text=True, check=True, stdout=-1).stdout

    assert len(alone := printed(1)) > 64
    assert printed(2) == alone
