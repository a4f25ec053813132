"""Bags of both kinds, read as a camera; what is missing in them is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runner.contract import Refused
from runner.testing import run_stage
from stages.camera import BagCamera
from stages.devices.ros2.settings import Source
from stages.messages import Frame, Pose
from tests.stages.devices.ros2.bags import (
    CAMERA,
    SOURCE,
    START,
    TYPES,
    Stamped,
    image,
    info,
    looks,
    replaced,
    transform,
    without,
    write_bag,
)

OWN = "camera_depth_optical_frame"
K = np.array([[50.0, 0, 15.5], [0, 50.0, 11.5], [0, 0, 1]])
RGB = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
DEPTH = np.random.default_rng(1).integers(400, 2000, (24, 32)).astype(np.float32) / np.float32(1000)
STAMPS = [START + k * 100_000_000 for k in range(5)]


def T_base_camera(x: float = 0.3) -> Pose:
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, 0.0, 1.0
    return T


def bag() -> list[Stamped]:
    return looks(RGB, DEPTH, K, T_base_camera(), STAMPS)


def frames(path: Path, **settings: Any) -> list[Frame]:
    camera = BagCamera(BagCamera.Config(bag=path, **settings))
    try:
        return run_stage(camera)
    finally:
        camera.close()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_every_look_of_a_bag(tmp_path: Path, storage: Any) -> None:
    path = write_bag(tmp_path / "bag", bag(), storage=storage)
    for given in (path, next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))):
        found = frames(given)
        assert [(frame.name, frame.index, frame.total) for frame in found] == [
            (f"{k / 10:.3f} s", k, 5) for k in range(5)
        ]
        assert [frame.stamp_ns for frame in found] == STAMPS
        assert all(np.array_equal(frame.rgb, RGB) and np.array_equal(frame.depth, DEPTH) for frame in found)
        assert all(np.array_equal(frame.K, K) and frame.T_base_camera is not None for frame in found)
        assert found[0].T_base_camera == pytest.approx(T_base_camera())


def test_chosen_looks(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", bag())
    assert [frame.name for frame in frames(path, times=(0.15, 0.4))] == ["0.200 s", "0.400 s"]
    assert [frame.name for frame in frames(path, period=0.2)] == ["0.000 s", "0.200 s", "0.400 s"]
    with pytest.raises(Refused, match=r"bag: has no look after 0.5 s; the last one is at 0.400 s"):
        frames(path, times=(0.5,))


def test_a_camera_that_moves(tmp_path: Path) -> None:
    messages = [(SOURCE.info, START, info(K, (24, 32)))]
    messages += without(looks(RGB, DEPTH, K, None, STAMPS), SOURCE.info)
    for stamp, x in ((STAMPS[1], 0.2), (STAMPS[3], 0.4)):
        messages.append(("/tf", stamp, transform("base_link", CAMERA, T_base_camera(x), stamp)))
    said: list[str] = []
    camera = BagCamera(BagCamera.Config(bag=write_bag(tmp_path / "bag", messages)))
    found = run_stage(camera, log=lambda text, level: said.append(f"{level}: {text}"))
    camera.close()
    assert [frame.T_base_camera[0, 3] for frame in found] == pytest.approx([0.2, 0.3, 0.4])
    assert said == [
        f"warning: 2 looks are left out: camera frame '{CAMERA}' of {SOURCE.color}: base_link to {CAMERA} is not known "
        "at 1700000000.000 s: it is from 1700000000.100 s to 1700000000.300 s"
    ]


def test_without_a_base_frame_nobody_knows_where_the_camera_stands(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", looks(RGB, DEPTH, K, None, STAMPS[:1]))
    (found,) = frames(path, topics=Source(base_frame=None))
    assert found.T_base_camera is None


def test_depth_pairs_with_the_nearest_colour(tmp_path: Path) -> None:
    messages = [(SOURCE.info, START, info(K, (24, 32)))]
    for k, stamp in enumerate(STAMPS):
        messages.append((SOURCE.color, stamp, image(RGB, "rgb8", stamp)))
        if k != 2:
            late = stamp + 4_000_000
            messages.append((SOURCE.depth, late, image((DEPTH * 1000).astype(np.uint16), "16UC1", late)))
    path = write_bag(tmp_path / "bag", messages)
    assert [frame.stamp_ns for frame in frames(path, topics=Source(base_frame=None))] == STAMPS[:2] + STAMPS[3:]
    with pytest.raises(Refused, match=r"no two images of .* and .* within 0.001 s"):
        frames(path, topics=Source(base_frame=None, slop=0.001))


def wrong(name: str, messages: list[Stamped]) -> list[Stamped]:
    """A bag with one thing wrong."""
    millimetres = np.round(DEPTH * 1000).astype(np.uint16)
    unturned = transform("base_link", CAMERA, np.eye(4))
    unturned.transforms[0].transform.rotation.w = 0.0
    return {
        "no colour": without(messages, SOURCE.color),
        "no info": without(messages, SOURCE.info),
        "no transform": without(messages, "/tf_static"),
        "a quaternion of zeros": replaced(messages, {"/tf_static": unturned}),
        "a lens of nan": replaced(messages, {SOURCE.info: info(K, (24, 32), d=np.full(5, np.nan))}),
        "another frame": replaced(messages, {"/tf_static": transform("base_link", "hand", np.eye(4))}),
        "colour as depth": replaced(messages, {SOURCE.depth: image(RGB, "rgb8")}),
        "depth as colour": replaced(messages, {SOURCE.color: image(millimetres, "16UC1")}),
        "not registered": replaced(messages, {SOURCE.depth: image(millimetres[:12], "16UC1")}),
        "own frame": replaced(messages, {SOURCE.depth: image(millimetres, "16UC1", frame=OWN)}),
        "other calibration": replaced(messages, {SOURCE.info: info(K, (48, 64))}),
        "another type": replaced(messages, {SOURCE.info: TYPES.new("std_msgs/msg/String")}),
    }[name]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("no colour", rf"has no topic {SOURCE.color}; there are of type .*: {SOURCE.depth}"),
        ("no info", rf"has no topic {SOURCE.info}; there are in all: {SOURCE.depth}, {SOURCE.color}, /tf_static"),
        ("no transform", rf"camera frame '{CAMERA}' of {SOURCE.color}: no transform names frame 'base_link'"),
        ("another frame", rf"no transform names frame '{CAMERA}'; there are: base_link, hand"),
        (
            "a quaternion of zeros",
            rf"frame '{CAMERA}' of {SOURCE.color}: base_link to {CAMERA} has the rotation .* 0 0 0 0",
        ),
        ("a lens of nan", rf"{SOURCE.info}: distortion d = \[nan, .*: its coefficients must be finite"),
        ("colour as depth", rf"{SOURCE.depth}: encoding 'rgb8' is no depth that is read; valid: 16UC1, mono16, 32FC1"),
        ("depth as colour", rf"{SOURCE.color}: encoding '16UC1' is no colour that is read; valid: rgb8, bgr8"),
        (
            "not registered",
            rf"{SOURCE.depth}: 32 x 12 pixels, but {SOURCE.color} has 32 x 24; depth must be registered",
        ),
        (
            "own frame",
            rf"{SOURCE.depth}: is of frame '{OWN}', but {SOURCE.color} of '{CAMERA}'; depth must be registered to "
            r"colour: choose the aligned topic \(align_depth.enable:=true\), or set topics.registered=true",
        ),
        ("other calibration", rf"{SOURCE.info}: speaks of 64 x 48 pixels, the image has 32 x 24"),
        ("another type", rf"{SOURCE.info} is of type std_msgs/msg/String; wanted is sensor_msgs/msg/CameraInfo"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path: Path, name: str, says: str) -> None:
    messages = wrong(name, looks(RGB, DEPTH, K, T_base_camera(), STAMPS[:1]))
    path = write_bag(tmp_path / "bag", messages)
    with pytest.raises(Refused, match=says) as refused:
        frames(path)
    assert "\n" not in str(refused.value) and str(refused.value).startswith(f"{path}: ")


def test_depth_of_another_frame_is_taken_where_somebody_says_that_it_is_registered(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", wrong("own frame", looks(RGB, DEPTH, K, T_base_camera(), STAMPS[:1])))
    (found,) = frames(path, topics=Source(registered=True))
    assert np.array_equal(found.depth, DEPTH) and found.T_base_camera == pytest.approx(T_base_camera())


def test_frames_are_equal_whether_a_slash_begins_them_or_not(tmp_path: Path) -> None:
    millimetres = np.round(DEPTH * 1000).astype(np.uint16)
    slashed = {SOURCE.depth: image(millimetres, "16UC1", frame=f"/{CAMERA}")}
    path = write_bag(tmp_path / "bag", replaced(looks(RGB, DEPTH, K, T_base_camera(), STAMPS[:1]), slashed))
    (found,) = frames(path)
    assert np.array_equal(found.depth, DEPTH)


def test_what_is_no_bag_is_named(tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"none: no such bag; a bag is a folder with metadata.yaml, or a file"):
        frames(tmp_path / "none")
    (tmp_path / "odd.mcap").write_bytes(b"odd")
    with pytest.raises(Refused, match=r"odd.mcap: is no ROS 2 bag that can be read"):
        frames(tmp_path / "odd.mcap")
    with pytest.raises(Refused, match="is no ROS 2 bag that can be read"):
        frames(tmp_path)
