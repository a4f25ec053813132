"""The observation of a frame: whose support plane it has."""

import msgspec
import numpy as np

from stages.messages import Candidate, Frame
from stages.perception.observation.preprocessing import preprocess
from stages.perception.rendering.rasteriser import View

K = np.array([[200.0, 0.0, 79.5], [0.0, 200.0, 59.5], [0.0, 0.0, 1.0]])
VIEW = View.of(K, 160, 120)
STOOL, FLOOR = 0.8, 1.5
"""Metres below the camera, which looks straight down."""


def seen() -> Frame:
    """A box on a small stool, and the floor around it."""
    depth = np.full((VIEW.height, VIEW.width), FLOOR)
    depth[40:80, 55:105] = STOOL
    depth[52:68, 70:90] = STOOL - 0.1
    noisy = depth + np.random.default_rng(0).normal(0, 0.001, depth.shape)
    return Frame(
        rgb=np.zeros((*depth.shape, 3), np.uint8), depth=noisy.astype(np.float32), K=K, T_base_camera=None,
        robot_mask=None, name="stool", index=0, total=1,
    )  # fmt: skip


def height_of_the_box(candidates: list[Candidate]) -> float:
    observation = preprocess(seen(), candidates, np.random.default_rng(0), max_height=0.9)
    T = observation.T_camera_table
    return float(((np.array([0.0, 0.0, STOOL - 0.1]) - T[:3, 3]) * T[:3, 2]).sum())


def test_unsure_candidates_on_the_floor_do_not_make_it_the_support() -> None:
    box = Candidate(box=np.array([70.0, 52.0, 90.0, 68.0]), label="box", confidence=0.7)
    corners = [(5.0, 5.0), (130.0, 5.0), (5.0, 95.0), (130.0, 95.0), (60.0, 5.0), (60.0, 95.0)]
    floor = [
        Candidate(box=np.array([x, y, x + 25, y + 20]), label="mat", confidence=0.2 + 0.01 * i)
        for i, (x, y) in enumerate(corners)
    ]
    assert abs(height_of_the_box([box, *floor]) - 0.1) < 0.01
    assert height_of_the_box(floor) > 0.5


def test_what_is_seen_beyond_the_working_area_is_kept_apart() -> None:
    robot = np.zeros((VIEW.height, VIEW.width), bool)
    robot[:20], robot[60:62] = True, True
    frame = msgspec.structs.replace(seen(), robot_mask=robot)
    box = Candidate(box=np.array([70.0, 52.0, 90.0, 68.0]), label="box", confidence=0.7)
    kept = preprocess(frame, [box], np.random.default_rng(0), max_height=0.9)
    assert kept.beyond is not None
    assert (kept.depth > 0).any() and not kept.depth[:, :60].any() and not kept.beyond[42:78, 60:100].any()
    np.testing.assert_array_equal(kept.depth + kept.beyond, np.where(robot, 0, frame.depth))
