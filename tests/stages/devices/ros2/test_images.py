"""Pixels in, pixels out: every encoding, lenses, and what is refused."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from stages.devices.ros2.images import color, depth, lens, pinhole
from tests.stages.devices.ros2.bags import TYPES, compressed, image, info, png

RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 255, (4, 6, 3), np.uint8)
MILLIMETRES = np.array([[0, 0, 500, 501, 0, 65535], [499, 0, 0, 0, 1200, 1]], np.uint16)
METRES = (MILLIMETRES / 1000).astype(np.float32)
K = np.array([[100.0, 0, 49.5], [0, 100.0, 39.5], [0, 0, 1]])


@pytest.mark.parametrize(("encoding", "order"), [("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("rgba8", [0, 1, 2, 0])])
@pytest.mark.parametrize("padding", [0, 5])
def test_colour(encoding: str, order: list[int], padding: int) -> None:
    assert np.array_equal(color(image(RGB[:, :, order], encoding, padding=padding)), RGB)


def test_colour_that_is_compressed() -> None:
    assert np.array_equal(color(compressed(png(RGB[:, :, ::-1]), "rgb8; png compressed bgr8")), RGB)


def test_depth_in_millimetres_of_either_order_and_in_metres() -> None:
    assert np.array_equal(depth(image(MILLIMETRES, "16UC1", padding=2)), METRES)
    swapped = image(MILLIMETRES.byteswap(), "16UC1")
    swapped.is_bigendian = 1
    assert np.array_equal(depth(swapped), METRES)
    holes = np.where(METRES == 0, np.nan, METRES)
    assert np.array_equal(depth(image(holes, "32FC1")), METRES)


def test_compressed_depth() -> None:
    parameters = np.array([0, 0, 0], "<f4").tobytes()
    for format in ("16UC1; compressedDepth", "16UC1; compressedDepth png"):
        assert np.array_equal(depth(compressed(parameters + png(MILLIMETRES), format)), METRES)
    assert np.array_equal(depth(compressed(parameters + rvl(MILLIMETRES), "16UC1; compressedDepth rvl")), METRES)


def test_compressed_depth_of_floats_is_an_inverse() -> None:
    a, b = 1000.0, -200.0
    metres = np.array([[0.5, 1.0, 2.0]], np.float32)
    values = np.round(a / metres + b).astype(np.uint16)
    header = np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()
    read = depth(compressed(header + png(np.pad(values, ((0, 0), (0, 1)))), "32FC1; compressedDepth png"))
    assert read[0, :3] == pytest.approx(metres[0], rel=1e-3)
    assert read[0, 3] == 0


def test_rvl_of_a_large_image() -> None:
    surface = RNG.integers(300, 4000, (48, 64)).astype(np.uint16)
    surface[RNG.random(surface.shape) < 0.3] = 0
    read = depth(compressed(bytes(12) + rvl(surface), "16UC1; compressedDepth rvl"))
    assert np.array_equal(np.round(read * 1000).astype(np.uint16), surface)


FORMAT = "16UC1; compressedDepth png"


def words(*packed: int) -> Any:
    """RVL of these words: columns, rows, nibbles."""
    return compressed(bytes(12) + np.array(packed, "<u4").tobytes(), "16UC1; compressedDepth rvl")


@pytest.mark.parametrize(
    ("read", "message", "says"),
    [
        (color, image(MILLIMETRES, "mono16"), "encoding 'mono16' is no colour that is read; valid: rgb8, bgr8"),
        (depth, image(RGB, "rgb8"), "encoding 'rgb8' is no depth that is read; valid: 16UC1"),
        (color, image(RGB[:, :0], "rgb8"), "an image of 0 x 4 pixels"),
        (color, compressed(b"nothing", "jpeg"), "7 bytes of format 'jpeg' are no image"),
        (depth, compressed(b"", "jpeg"), "format 'jpeg' is no depth that is read"),
        (depth, compressed(bytes(12), "16UC1; compressedDepth png"), "0 bytes of format"),
        (depth, compressed(bytes(12) + b"\2\0\0\0\2\0\0\0\0\0\0\0", "16UC1; compressedDepth rvl"), "ends after"),
        (depth, compressed(bytes(20), "16UC1; compressedDepth rvl"), "RVL of 8 bytes has no pixels"),
        (depth, compressed(b"", "16UC1; compressedDepth png"), "compressed depth of 0 bytes has no header"),
        (
            color,
            compressed(png(RGB[:, :, 0]), "mono8; png compressed "),
            "'mono8; png compressed ' holds 1 channel of 8 b",
        ),
        (
            color,
            compressed(png(MILLIMETRES), "rgb8; png compressed bgr8"),
            "holds 1 channel of 16 bits; colour has 3 or",
        ),
        (depth, compressed(bytes(12) + png(RGB), FORMAT), "holds 3 channels of 8 bits; depth has 1 channel of 16 bits"),
        (
            depth,
            compressed(bytes(12) + png(RGB[:, :, 0]), FORMAT),
            "'16UC1; compressedDepth png' holds 1 channel of 8 b",
        ),
        (depth, image(1000 * METRES, "32FC1"), "median depth is 500.5 m; metres are expected.*; 16UC1 is millimetres"),
        (depth, image(METRES / 1000, "32FC1"), "median depth is 0.0005005 m"),
        (depth, words(4_000_000, 4_000_000, 0x01234567), "RVL of 4000000 x 4000000 pixels; at most 16777216 are read"),
        (depth, words(2, 2, 0xFFFFFFFF), "RVL of 2 x 2 pixels has a number without end"),
        (depth, words(2, 2, 0xFFFFFFFF, 0xFFF00000), "RVL of 2 x 2 pixels has a number without end"),
        (depth, words(2, 2, 0x05222220), "RVL of 2 x 2 pixels has 5"),
        (depth, words(2, 2, 0x07222220), "RVL of 2 x 2 pixels ends after 0"),
    ],
)
def test_what_cannot_be_read_is_named(read: Any, message: Any, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        read(message)


def test_an_image_that_is_too_short_is_refused() -> None:
    message = image(RGB, "rgb8")
    message.data = message.data[:-1]
    with pytest.raises(ValueError, match="71 bytes in lines of 18 do not hold 6 x 4 pixels of rgb8"):
        color(message)


def test_what_a_camera_info_says() -> None:
    projection = np.column_stack([np.diag([2.0, 2.0, 1.0]) @ K, np.zeros(3)]).ravel()
    assert pinhole(info(K, (80, 100), d=[0.1] * 5, p=projection), rectified=True)[0, 0] == 200
    assert pinhole(info(K, (80, 100), d=[0.0] * 5), rectified=False).tolist() == K.tolist()
    rgb, metres = np.zeros((80, 100, 3), np.uint8), np.ones((80, 100), np.float32)
    for bent, rectified in ((False, False), (True, True)):
        found = lens(info(K, (80, 100), d=[0.3 * bent] * 5), K, rectified=rectified)
        assert found.straighten(rgb, metres)[1] is metres
    assert not lens(info(K, (80, 100), d=[0.3] * 5), K, rectified=False).straighten(rgb, metres)[1].all()
    with pytest.raises(ValueError, match="distortion model 'thin' is not known; valid: plumb_bob"):
        lens(info(K, (80, 100), d=[0.1], distortion_model="thin"), K, rectified=False)
    with pytest.raises(ValueError, match="the camera is not calibrated"):
        pinhole(TYPES.new("sensor_msgs/msg/CameraInfo"), rectified=False)
    for name in ("binning_x", "binning_y", "roi.x_offset", "roi.y_offset"):
        part = info(K, (80, 100), d=[])
        setattr(part.roi if "roi" in name else part, name.removeprefix("roi."), 2)
        with pytest.raises(ValueError, match=f"^{name} = 2: images that are binned or cut out are not read; valid: "):
            pinhole(part, rectified=False)
    with pytest.raises(ValueError, match=r"K = .*without skew"):
        pinhole(info(K + np.diag([2.0, 0], 1), (80, 100), d=[]), rectified=False)


def rvl(values: np.ndarray) -> bytes:
    """As the paper writes it, one number after the other."""
    nibbles: list[int] = []
    for number in _numbers(values.ravel().tolist()):
        rest = number
        while rest >= 8:
            nibbles.append(rest & 7 | 8)
            rest >>= 3
        nibbles.append(rest)
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{nibble:x}" for nibble in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8)]
    return np.array([values.shape[1], values.shape[0], *words], "<u4").tobytes()


def _numbers(values: list[int]) -> Iterator[int]:
    place = previous = 0
    while place < len(values):
        start = place
        while place < len(values) and values[place] == 0:
            place += 1
        yield place - start
        start = place
        while place < len(values) and values[place] != 0:
            place += 1
        yield place - start
        for value in values[start:place]:
            delta, previous = value - previous, value
            yield 2 * delta if delta >= 0 else -2 * delta - 1
