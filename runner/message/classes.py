"""What the class of a message may hold: what could not be sent, read or described is refused before anything starts."""

from collections.abc import Set
from typing import Any, get_args, get_origin

import numpy as np

from runner.contract import Message, Refused, Spec
from runner.message.codec import DTYPES, MAX_DIMENSIONS, describe, fields_of, is_record, spec_of


def refuse_class(kind: type[Message]) -> None:
    """Raises Refused, naming field and reason, where messages of a class could not be sent, read or described."""
    undescribed = _why_undescribed(kind)
    _refuse_type(kind.__name__, kind, set(), by_field=bool(undescribed))
    if undescribed:
        raise Refused(f"{kind.__name__}: {undescribed}")


def _refuse_type(place: str, annotation: Any, known: set[Any], *, by_field: bool) -> None:
    """With ``by_field`` each field is described alone: something in the class cannot be."""
    kind = get_origin(annotation) or annotation
    if (spec := spec_of(annotation)) is not None:
        if reason := _why_no_array(get_args(annotation)[0], spec):
            raise Refused(f"{place}: {reason}")
        return
    if kind is np.ndarray:
        raise Refused(f"{place}: an array needs its Spec; valid: Annotated[NDArray[...], Spec(dtype, shape)]")
    if isinstance(kind, type) and issubclass(kind, Set):  # in another order in each process, and so are the bytes
        raise Refused(f"{place}: a set has no order; valid: tuple")
    if kind is Any:
        raise Refused(f"{place}: Any does not say what is sent; valid: numbers, texts, tuples, arrays, Structs")
    if is_record(kind) and kind not in known:
        known.add(kind)
        for name, hint in _fields(place, kind).items():
            _refuse_type(f"{place}.{name}", hint, known, by_field=by_field)
            if by_field and (reason := _why_undescribed(hint)):
                raise Refused(f"{place}.{name}: {reason}")
    for argument in get_args(annotation):
        _refuse_type(place, argument, known, by_field=by_field)


def _fields(place: str, kind: Any) -> dict[str, Any]:
    try:
        return fields_of(kind)
    except NameError as error:
        raise Refused(f"{place}: an annotation cannot be resolved: {error}") from None


def _why_undescribed(annotation: Any) -> str:
    """Why msgspec does not take a type, empty where it does: it holds another class, a union that cannot be told
    apart, a default of another type."""
    try:
        describe(annotation)
    except (TypeError, ValueError, NameError) as error:
        reason = str(error).rpartition("\n")[2]
        return reason + ("; valid: numbers, texts, tuples, arrays, Structs" if reason.startswith("type ") else "")
    return ""


def _why_no_array(kind: Any, spec: Spec) -> str:
    """What is wrong with a Spec; empty where nothing is."""
    if (get_origin(kind) or kind) is not np.ndarray:
        return f"a Spec says what an array is, and this is {kind}; valid: Annotated[NDArray[...], {spec}]"
    if spec.dtype not in DTYPES:
        return f"element type {spec.dtype!r} is not one of {', '.join(DTYPES)}"
    shape: Any = spec.shape
    if not isinstance(shape, tuple) or len(shape) > MAX_DIMENSIONS or not all(map(_is_extent, shape)):
        return f"shape {shape!r} is not a tuple of at most {MAX_DIMENSIONS} numbers and names"
    return ""


def _is_extent(extent: Any) -> bool:
    return isinstance(extent, str) or (type(extent) is int and extent >= 0)
