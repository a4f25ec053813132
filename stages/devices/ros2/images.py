"""Pixels of ROS 2 images: colour as bytes, depth in metres, and what a CameraInfo says of them.

Encodings: sensor_msgs/image_encodings.hpp; compressed depth: compressed_depth_image_transport; RVL: Wilson, Fast
Lossless Depth Image Compression (2017). What cannot be read raises ValueError, with the encoding that was found.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.geometry.camera import checked_depth, checked_intrinsics
from stages.geometry.lens import PLUMB_BOB, Lens
from stages.messages.arrays import Depth, Intrinsics, Rgb

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_COLORS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "rgba8": (4, [0, 1, 2]), "bgra8": (4, [2, 1, 0])}
"""By encoding: channels, and where red, green and blue are."""
_DEPTHS = {"16UC1": np.dtype(np.uint16), "mono16": np.dtype(np.uint16), "32FC1": np.dtype(np.float32)}
_DEPTH_HEADER = struct.Struct("<iff")
_RVL_HEADER = struct.Struct("<II")
_MOST_PIXELS = 4096 * 4096
"""Of compressed depth: what says that it has more is broken."""
_LONGEST = 9
"""Nibbles of the longest number of RVL: of a run over all those pixels."""


def color(message: Any) -> Rgb:
    """H x W x 3 of an Image or CompressedImage."""
    if message.__msgtype__ == COMPRESSED:
        pixels = _unpacked(message.data, message.format)
        if pixels.dtype != np.uint8 or pixels.ndim != 3:
            raise ValueError(f"format {message.format!r} holds {_kind(pixels)}; colour has 3 or 4 channels of 8 bits")
        return np.ascontiguousarray(pixels[:, :, 2::-1])
    if message.encoding not in _COLORS:
        raise ValueError(f"encoding {message.encoding!r} is no colour that is read; valid: {', '.join(_COLORS)}")
    channels, order = _COLORS[message.encoding]
    return np.ascontiguousarray(_rows(message, np.dtype(np.uint8), channels)[:, :, order])


def depth(message: Any) -> Depth:
    """H x W of an Image or of compressedDepth, metres along the optical axis; 0 where there is no reading."""
    if message.__msgtype__ == COMPRESSED:
        return _compressed_depth(message)
    if message.encoding not in _DEPTHS:
        raise ValueError(f"encoding {message.encoding!r} is no depth that is read; valid: {', '.join(_DEPTHS)}")
    return _metres(_rows(message, _DEPTHS[message.encoding], 1)[:, :, 0])


def pinhole(info: Any, *, rectified: bool) -> Intrinsics:
    """The matrix of a CameraInfo for images that are ``rectified`` or not; ValueError without a focal length, with
    skew, or where the images are binned or cut out: drivers differ in whether the matrix is that of the whole."""
    for name, value, valid in (
        ("binning_x", info.binning_x, (0, 1)),
        ("binning_y", info.binning_y, (0, 1)),
        ("roi.x_offset", info.roi.x_offset, (0,)),
        ("roi.y_offset", info.roi.y_offset, (0,)),
    ):
        if value not in valid:
            raise ValueError(f"{name} = {value}: images that are binned or cut out are not read; valid: {valid[-1]}")
    K = np.array(np.reshape(info.p, (3, 4))[:, :3] if rectified else np.reshape(info.k, (3, 3)), np.float64)
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise ValueError("no focal length: the camera is not calibrated")
    return checked_intrinsics(K)


def lens(info: Any, K: Intrinsics, *, rectified: bool) -> Lens:
    """The lens that is left in the images; ValueError where it is of unknown kind."""
    return Lens(K, (int(info.height), int(info.width)), () if rectified else info.d, info.distortion_model or PLUMB_BOB)


def _rows(message: Any, dtype: np.dtype[Any], channels: int) -> NDArray[Any]:
    """H x W x channels; lines may be longer than their pixels."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    used = width * channels * dtype.itemsize
    if not width or not height:
        raise ValueError(f"an image of {width} x {height} pixels")
    if step < used or len(message.data) < height * step:
        raise ValueError(
            f"{len(message.data)} bytes in lines of {step} do not hold {width} x {height} pixels of {message.encoding}"
        )
    lines = message.data[: height * step].reshape(height, step)[:, :used]
    order = dtype.newbyteorder(">" if message.is_bigendian else "<")
    return np.ascontiguousarray(lines).view(order).reshape(height, width, channels)


def _metres(values: NDArray[Any]) -> Depth:
    """Whole numbers are millimetres; ValueError where others cannot be metres."""
    if values.dtype.kind == "u":
        return (values / np.float32(1000)).astype(np.float32)
    try:
        return checked_depth(np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32))
    except ValueError as error:
        raise ValueError(f"encoding '32FC1': {error}; 16UC1 is millimetres") from None


def _compressed_depth(message: Any) -> Depth:
    """``ENCODING; compressedDepth [png|rvl]``: twelve bytes of parameters, then the image."""
    encoding, _, how = (part.strip() for part in message.format.partition(";"))
    transport, _, codec = how.partition(" ")
    if transport != "compressedDepth" or encoding not in _DEPTHS or codec not in ("", "png", "rvl"):
        raise ValueError(f"format {message.format!r} is no depth that is read; valid: '16UC1; compressedDepth png'")
    if len(message.data) < _DEPTH_HEADER.size:
        raise ValueError(f"compressed depth of {len(message.data)} bytes has no header")
    packed = message.data[_DEPTH_HEADER.size :]
    values = _rvl(packed.tobytes()) if codec == "rvl" else _unpacked(packed, message.format)
    if values.dtype != np.uint16 or values.ndim != 2:
        raise ValueError(f"format {message.format!r} holds {_kind(values)}; depth has 1 channel of 16 bits")
    if _DEPTHS[encoding].kind == "u":
        return _metres(values)
    _, a, b = _DEPTH_HEADER.unpack(message.data[: _DEPTH_HEADER.size].tobytes())
    inverse = values.astype(np.float32)
    return _metres(np.divide(a, inverse - b, out=np.zeros_like(inverse), where=values > 0))


def _unpacked(data: NDArray[np.uint8], format: str) -> NDArray[Any]:
    """The pixels as they were packed, colours in the order blue, green, red."""
    try:
        pixels: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except cv2.error:  # more pixels than OpenCV unpacks
        pixels = None
    if pixels is None:
        raise ValueError(f"{len(data)} bytes of format {format!r} are no image")
    return pixels


def _kind(pixels: NDArray[Any]) -> str:
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    return f"{channels} channel{'s' if channels > 1 else ''} of {8 * pixels.itemsize} bits"


def _rvl(data: bytes) -> NDArray[np.uint16]:
    """Runs of zeros and of differences; numbers of three bits a nibble, low ones first, bit 3 where more follow."""
    if len(data) < _RVL_HEADER.size + 4:
        raise ValueError(f"RVL of {len(data)} bytes has no pixels")
    columns, rows = _RVL_HEADER.unpack_from(data)
    if rows * columns > _MOST_PIXELS:
        raise ValueError(f"RVL of {columns} x {rows} pixels; at most {_MOST_PIXELS} are read")
    words = np.frombuffer(data, "<u4", offset=_RVL_HEADER.size, count=(len(data) - _RVL_HEADER.size) // 4)
    nibbles = (words[:, None] >> np.arange(28, -4, -4, dtype=np.uint32)).ravel() & 15
    ends = np.flatnonzero(nibbles < 8)
    starts = np.concatenate([[0], ends + 1])[:-1]
    if not len(ends) or (ends - starts).max() >= _LONGEST:
        raise ValueError(f"RVL of {columns} x {rows} pixels has a number without end")
    place = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    numbers = np.add.reduceat((nibbles[: ends[-1] + 1].astype(np.int64) & 7) << (3 * place), starts)
    changes = np.zeros(rows * columns, np.int64)
    filled = np.zeros(rows * columns, np.bool_)
    pixel = number = 0
    while pixel < len(changes):
        count = int(numbers[number + 1]) if number + 1 < len(numbers) else len(numbers)
        if number + 2 + count > len(numbers):
            raise ValueError(f"RVL of {columns} x {rows} pixels ends after {pixel}")
        pixel += int(numbers[number])
        if pixel + count > len(changes):
            raise ValueError(f"RVL of {columns} x {rows} pixels has {pixel + count}")
        coded = numbers[number + 2 : number + 2 + count]
        changes[pixel : pixel + count] = (coded >> 1) ^ -(coded & 1)
        filled[pixel : pixel + count] = True
        pixel, number = pixel + count, number + 2 + count
    return np.where(filled, np.cumsum(changes), 0).astype(np.uint16).reshape(rows, columns)
