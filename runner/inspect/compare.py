"""Compares two decoded messages field by field, bit by bit, and says where and by how much they differ."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from runner.contract import Message
from runner.message.codec import CodecError, Envelope, Fields, decode, decode_untyped

SHOWN = 60
"""Characters of a value that are shown."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One field that differs. ``field`` is its path, for example ``objects[2].T_camera_object[0, 3]``."""

    field: str
    recorded: str
    replayed: str
    extent: str = ""
    """For arrays: how many elements differ, and by how much at most."""
    largest: float | None = None
    """Largest absolute difference of numbers; infinite between a number and NaN, None where they are no numbers."""
    owner: str = ""
    """``Type.field`` of the struct that declares the field."""
    share: float = 1.0
    """Of an array's elements that differ."""

    @property
    def pattern(self) -> str:
        """The field without indices, for example ``objects[].T_camera_object[]``."""
        return re.sub(r"\[[\d, ]*\]", "[]", self.field)

    def __str__(self) -> str:
        extent = f" ({self.extent})" if self.extent else ""
        return f"{self.field}: recorded {self.recorded}, replayed {self.replayed}{extent}"


Differences = Iterator[Difference]


def differences(recorded: Any, replayed: Any, field: str = "", owner: str = "") -> Differences:
    """Every field that differs, in the order of declaration. Floats are compared bit by bit: NaN equals NaN."""
    if type(recorded) is not type(replayed):
        yield Difference(field, _show(recorded), _show(replayed), "types differ", owner=owner)
    elif isinstance(recorded, msgspec.Struct):
        for name in recorded.__struct_fields__:
            pair, place = (getattr(recorded, name), getattr(replayed, name)), f"{field}.{name}".lstrip(".")
            yield from differences(*pair, place, f"{type(recorded).__name__}.{name}")
    elif isinstance(recorded, np.ndarray):
        yield from _array_difference(recorded, replayed, field, owner)
    elif isinstance(recorded, dict):
        yield from _mapping_differences(recorded, replayed, field, owner)
    elif isinstance(recorded, list | tuple):
        yield from _sequence_differences(recorded, replayed, field, owner)
    elif repr(recorded) != repr(replayed):
        yield Difference(field, _show(recorded), _show(replayed), largest=_gap(recorded, replayed), owner=owner)


def envelope_differences(
    recorded: Envelope, replayed: Envelope, header: Iterable[str], kind: type[Message] | None = None
) -> Differences:
    """Every difference of two messages, those of ``header`` first; their fields are those of ``kind`` if it can read
    both, else those that are there. Where only the bytes of the body differ, that is the one difference."""
    for name in header:
        yield from differences(getattr(recorded, name), getattr(replayed, name), name)
    if bytes(recorded.body) != bytes(replayed.body):
        found = list(_body_differences(recorded, replayed, kind))
        before, now = (f"{memoryview(one.body).nbytes} bytes" for one in (recorded, replayed))
        yield from found or [Difference("body", before, now, "the same values in other bytes")]


def _body_differences(recorded: Envelope, replayed: Envelope, kind: type[Message] | None) -> Differences:
    try:
        first, second = (decode(kind, one.body) if kind else decode_untyped(one.body) for one in (recorded, replayed))
    except CodecError as error:
        if kind:
            yield from _body_differences(recorded, replayed, None)
        else:
            yield Difference("body", "", "", f"cannot be read: {error}")
    else:
        yield from differences(first, second)


def _mapping_differences(recorded: dict[Any, Any], replayed: dict[Any, Any], field: str, owner: str) -> Differences:
    if recorded.keys() != replayed.keys():
        keys = _show(sorted(recorded, key=repr)), _show(sorted(replayed, key=repr))
        yield Difference(field or "fields", *keys, "keys differ", owner=owner)
    for key in filter(replayed.__contains__, recorded):
        place = f"{field}.{key}".lstrip(".") if isinstance(recorded, Fields) else f"{field}[{key!r}]"
        yield from differences(recorded[key], replayed[key], place, owner)


def _sequence_differences(recorded: Sequence[Any], replayed: Sequence[Any], field: str, owner: str) -> Differences:
    if len(recorded) != len(replayed):
        yield Difference(field, f"{len(recorded)} items", f"{len(replayed)} items", "lengths differ", owner=owner)
    for index, pair in enumerate(zip(recorded, replayed, strict=False)):
        yield from differences(*pair, f"{field}[{index}]", owner)


def _array_difference(recorded: NDArray[Any], replayed: NDArray[Any], field: str, owner: str) -> Differences:
    if recorded.dtype != replayed.dtype or recorded.shape != replayed.shape:
        yield Difference(field, _kind(recorded), _kind(replayed), "element types or shapes differ", owner=owner)
        return
    unequal = _bits(recorded) != _bits(replayed)
    if not unequal.any():
        return
    first = tuple(int(extent) for extent in np.argwhere(unequal)[0])
    largest = _largest(recorded[unequal], replayed[unequal])
    extent = f"{np.count_nonzero(unequal)} of {unequal.size} elements differ, by {largest:.3g} at most"
    place = f"{field}[{', '.join(map(str, first))}]"
    share = np.count_nonzero(unequal) / unequal.size
    yield Difference(place, _show(recorded[first].item()), _show(replayed[first].item()), extent, largest, owner, share)


def _bits(array: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(array).view(f"u{array.dtype.itemsize}").reshape(array.shape)


def _gap(recorded: Any, replayed: Any) -> float | None:
    if isinstance(recorded, int) and not isinstance(recorded, bool):
        return float(abs(recorded - replayed))
    return _largest(np.array([recorded]), np.array([replayed])) if isinstance(recorded, float) else None


def _largest(recorded: NDArray[Any], replayed: NDArray[Any]) -> float:
    """Largest absolute difference; infinite where a number became NaN or infinite or the other way round."""
    if recorded.dtype.kind in "iu":  # as integers: float64 would round those beyond 2**53
        above, below = (choose(recorded, replayed).astype(np.uint64) for choose in (np.maximum, np.minimum))
        return float(np.max(above - below, initial=0))
    with np.errstate(all="ignore"):
        gaps = np.abs(recorded.astype(np.float64) - replayed.astype(np.float64))
    gaps[(recorded == replayed) | (np.isnan(recorded) & np.isnan(replayed))] = 0.0
    return float(np.max(np.where(np.isnan(gaps), np.inf, gaps), initial=0.0))


def _kind(array: NDArray[Any]) -> str:
    return f"{array.dtype.name} {array.shape}"


def _show(value: Any) -> str:
    return clipped(repr(value), SHOWN)


def clipped(text: str, length: int) -> str:
    """A text of at most ``length`` characters, three dots in the place of the rest."""
    return text if len(text) <= length else f"{text[: length - 3]}..."
