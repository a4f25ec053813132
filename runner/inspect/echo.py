"""Any message as text, without knowing its type: msgpack to indented lines, arrays by their shape and extremes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from runner.inspect.info import byte_count
from runner.message.codec import CodecError, Envelope, decode_untyped, unpack

SHOWN_ELEMENTS = 16
"""Arrays of up to so many elements are written out."""
SHOWN_ITEMS = 32
"""Of longer lists and texts the rest is counted."""
SHOWN_CHARACTERS = 2000


def lines_of(payload: bytes | memoryview) -> Iterator[str]:
    """The envelope in one line and its content below; what cannot be read is said, never raised."""
    try:
        envelope = unpack(Envelope, payload)
        body = decode_untyped(envelope.body)
    except (CodecError, RecursionError) as error:
        yield f"unreadable, {byte_count(len(payload))}: {error}"
        return
    causes = f" from {', '.join(envelope.causes)}" if envelope.causes else ""
    yield f"{envelope.id}: {envelope.type}, {byte_count(len(payload))}{causes}"
    yield from _indented(body, "  ")


def _indented(value: Any, indent: str) -> Iterator[str]:
    match value:
        case dict():
            for key, inner in value.items():
                yield from _entry(f"{indent}{key}:", inner, indent)
        case list():
            for inner in value[:SHOWN_ITEMS]:
                first, *more = _item(inner, f"{indent}  ")
                yield f"{indent}- {first.lstrip()}"
                yield from more
            if len(value) > SHOWN_ITEMS:
                yield f"{indent}... and {len(value) - SHOWN_ITEMS} more"
        case _:
            yield f"{indent}{_scalar(value)}"


def _item(value: Any, indent: str) -> list[str]:
    """One item of a list; its first line goes beside the dash."""
    return list(_indented(value, indent) if _is_nested(value) else _entry("", value, indent))


def _entry(head: str, value: Any, indent: str) -> Iterator[str]:
    if _is_nested(value):
        yield head
        yield from _indented(value, indent + "  ")
    elif isinstance(value, str) and "\n" in value:
        yield f"{head} |"
        yield from (f"{indent}    {line}" for line in value[:SHOWN_CHARACTERS].splitlines())
    else:
        yield f"{head} {_scalar(value)}"


def _is_nested(value: Any) -> bool:
    """What does not fit on one line: short lists of plain values do, and arrays."""
    if not isinstance(value, dict | list) or not value:
        return False
    inner = any(isinstance(item, dict | list | np.ndarray) or "\n" in str(item) for item in value)
    return isinstance(value, dict) or inner or len(value) > SHOWN_ELEMENTS


def _scalar(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return array_text(value)
    if isinstance(value, bytes):
        return f"{byte_count(len(value))} of bytes"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return f"[{', '.join(map(_scalar, value))}]"
    text = str(value)
    return f"{text[:SHOWN_CHARACTERS]}{'...' if len(text) > SHOWN_CHARACTERS else ''}"


def array_text(array: np.ndarray[Any, Any]) -> str:
    """``float32 (480, 640) 0 .. 2.31, mean 0.98``; small arrays with their elements."""
    text = f"{array.dtype.name} ({', '.join(map(str, array.shape))})"
    if array.size == 0:
        return text
    if array.size <= SHOWN_ELEMENTS:
        return f"{text} {_scalar(array.tolist())}"
    if array.dtype == np.bool_:
        return f"{text} {np.count_nonzero(array)} of {array.size} true"
    valid = array[np.isfinite(array)] if array.dtype.kind == "f" else array
    if valid.size == 0:
        return f"{text} nothing finite"
    strange = array.size - valid.size
    rest = f", {strange} not finite" if strange else ""
    return f"{text} {valid.min():.6g} .. {valid.max():.6g}, mean {valid.mean(dtype=np.float64):.6g}{rest}"
