"""What goes over the wire and into recordings: msgpack maps, arrays with a checked type and shape, never pickle."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import is_dataclass
from functools import cache
from itertools import repeat
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NotRequired,
    Required,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

import msgspec
import numpy as np

from runner.contract import Level, Message, Spec, name_of
from runner.message.ids import IdText
from runner.message.packet import Process

M = TypeVar("M", bound=Message)
R = TypeVar("R", bound=msgspec.Struct)

Outcome = Literal["done", "stopped", "failed", "ended"]
"""How a step ended: only ``done`` acknowledges what it consumed. ``ended`` is the last record of a process."""
Activity = Literal["waiting", "working", "held back"]
"""What a process does: wait for input, run a handler, or wait for room at its consumers."""
MAX_BYTES = 256 * 2**20
"""Largest payload that is encoded and decoded."""
MAX_DIMENSIONS = 8
IN_PLACE_BYTES = 2**16
"""Arrays of larger messages are read where they lie."""
ALIGNMENT = 16
"""Of the elements of every array, as memory is allocated anyway: other code may be compiled for other arrays."""
DTYPES = {
    name: np.dtype(name)
    for name in (
        *("bool", "int8", "int16", "int32", "int64"),
        *("uint8", "uint16", "uint32", "uint64", "float16", "float32", "float64"),
    )
}
"""Element types an array may have, little-endian on the wire."""
_NAMES = {dtype: name for name, dtype in DTYPES.items()}
_BOOL = DTYPES["bool"]


class CodecError(Exception):
    """A payload or message that breaks its type: ``type`` and ``field`` say where, ``reason`` why."""

    def __init__(self, type_name: str, field: str, reason: str):
        self.type = type_name
        self.field = field
        self.reason = reason
        super().__init__(f"{type_name}{'.' if field else ''}{field}: {reason}")


Count = Annotated[int, msgspec.Meta(ge=0)]
Nanoseconds = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


class Envelope(msgspec.Struct, frozen=True):
    """One message as it travels and is recorded: a msgpack map with the message itself under ``body``."""

    id: IdText
    """``stage.port#sequence``."""
    lineage: IdText
    """Id of the message at the root of everything this one hangs on."""
    time_ns: Nanoseconds
    """Logical time."""
    type: str
    """Class name of the message."""
    version: int
    causes: tuple[str, ...]
    """Ids that the step which emitted this message had consumed."""
    body: msgspec.Raw


class OfProcess(msgspec.Struct, frozen=True):
    """What begins with the process that it speaks of."""

    stage: str
    replica: Count
    incarnation: Count
    """0 for the first process of this replica, one more after each restart."""

    @property
    def process(self) -> Process:
        """Of whom it speaks."""
        return Process(self.stage, self.replica, self.incarnation)


class Step(OfProcess, frozen=True):
    """One journalled step of one stage: what it consumed and emitted, in which order, and how long it took."""

    number: Count
    """Counts the steps of one process from 0."""
    handler: str
    consumed: tuple[tuple[str, IdText], ...]
    """(port, message id) in the order of the handler's parameters; a gather's parts by index."""
    emitted: tuple[IdText, ...]
    """Ids in the order of emission."""
    time_ns: Nanoseconds
    """Logical time of the step."""
    waited_ns: int
    """From the arrival of the last input to the start of the handler."""
    travelled_ns: int
    """From the publication of the last input to its arrival."""
    computed_ns: int
    """Time inside the handler."""
    outcome: Outcome = "done"
    error: str = ""
    left: tuple[tuple[str, IdText], ...] = ()
    """(port, message id) of what has arrived and no step of this process will consume: it was refused, or put aside
    unused, or the process ended before; said once."""


class Lost(OfProcess, frozen=True):
    """The supervisor's word that a process is dead, whatever else is heard of it: the one thing that makes it so."""

    reason: str
    time_ns: Nanoseconds
    """Wall clock, nanoseconds since the epoch."""


def answered(step: Step) -> tuple[tuple[str, IdText], ...]:
    """(port, message id) of what a step has done with; what a process leaves at its end is for its successor."""
    return (*(step.consumed if step.outcome == "done" else ()), *(step.left if step.outcome != "ended" else ()))


class Journal(msgspec.Struct, frozen=True):
    """What the recorder has of one stage, in its order."""

    steps: tuple[Step, ...] = ()
    answered: tuple[tuple[int, str, IdText], ...] = ()
    """(replica, port, message id) that the stage had done with before the recorder had the message; -1: whichever."""

    def done(self) -> Iterator[tuple[int, tuple[tuple[str, str], ...]]]:
        """What each replica has done with, (port, message id)."""
        yield from ((replica, ((port, id),)) for replica, port, id in self.answered)
        yield from ((step.replica, answered(step)) for step in self.steps)


class Deal(msgspec.Struct, frozen=True):
    """The part that a replica is to work on; the others leave it alone."""

    id: IdText


class CaughtUp(msgspec.Struct, frozen=True):
    """What the recorder says to a process that took the place of another, once it has sent all that is older."""

    undone: tuple[tuple[str, str, IdText], ...] = ()
    """(consumer, port, message id) of the parts that earlier processes of the stage have sent and nobody has done
    with."""
    numbers: dict[str, int] = {}
    """Next sequence number, by output port, after what they have sent in steps that were never done."""


class LogLine(msgspec.Struct, frozen=True):
    """One line a stage (or the supervisor) shows to people."""

    stage: str
    replica: int
    level: Level
    text: str
    time_ns: Nanoseconds
    """Wall clock, nanoseconds since the epoch."""


class Pulse(OfProcess, frozen=True):
    """What a process says of itself twice a second, of the recorder too; it is not recorded."""

    state: Activity = "waiting"
    handler: str = ""
    """What runs at present; empty while waiting."""
    busy_ns: int = 0
    """Time spent inside the present handler, back-pressure not counted."""
    steps: int = 0
    refused: int = 0
    """Messages that could not be taken."""
    queued: dict[str, int] = {}
    """Messages that have arrived and are not worked on, by where they wait: an input port, or before it is known."""
    sent: dict[str, tuple[int, int]] = {}
    """(messages, bytes) emitted so far, by output port."""
    cpu_ns: int = 0
    """Processor time of all its threads since it began."""
    memory_bytes: int = 0
    """What it holds in memory (resident set)."""


# ---------------------------------------------------------------------------------------------- arrays


def _to_wire(value: Any) -> Any:
    """Arrays become ``[dtype, shape, bytes]``, numpy scalars plain numbers."""
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        raise ValueError(f"{type(value).__name__} cannot be encoded")
    name = _NAMES.get(value.dtype)
    if name is None:
        raise ValueError(f"an array of {value.dtype} cannot be encoded; valid: {', '.join(DTYPES)}")
    # In C order, and not copied where the elements lie so.
    return [name, value.shape, value.data if value.flags.c_contiguous else value.tobytes()]


def _from_wire(kind: type, value: Any) -> Any:
    """Reads ``[dtype, shape, bytes]`` as a read-only array that owns no copy."""
    if isinstance(value, np.ndarray):  # of a message that is checked before it travels
        return value
    if getattr(kind, "__origin__", None) is not np.ndarray:
        raise ValueError(f"{kind} cannot be decoded")
    match value:
        case [str() as name, list() as shape, bytes() as data]:
            return _array(name, shape, data)
        case _:
            raise ValueError("expected an array as [dtype, shape, bytes]")


def _array(name: str, shape: list[Any], data: bytes | memoryview) -> np.ndarray:
    dtype = DTYPES.get(name)
    if dtype is None:
        raise ValueError(f"element type {name[:20]!r} is not one of {', '.join(DTYPES)}")
    if len(shape) > MAX_DIMENSIONS or [one for one in shape if type(one) is not int or one < 0]:
        raise ValueError(f"shape {str(shape)[:60]} is not a list of at most {MAX_DIMENSIONS} extents")
    if math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"{len(data)} bytes do not fill shape {shape} of {name}")
    if dtype is _BOOL and np.frombuffer(data, np.uint8).max(initial=0) > 1:
        raise ValueError("a bool is neither 0 nor 1")
    return np.ndarray(shape, dtype, buffer=data)


def array_of(value: Any, spec: Spec) -> np.ndarray:
    """The array that nested lists of numbers say; raises ValueError where it is not what a field declares."""
    given = np.array(value)  # raises ValueError where the lists differ in length
    array = given.astype(DTYPES[spec.dtype]) if given.dtype.kind in "biuf" else given
    if array.dtype.kind != "f" and not np.array_equal(array, given):
        raise ValueError(f"expected {spec.dtype}, got {given.dtype}")
    _check_array(array, spec)
    return array


def shown(spec: Spec) -> str:
    """What an array must be, for people: ``float64 (3,)``."""
    return f"{spec.dtype} ({', '.join(map(str, spec.shape))})"


def _check_array(array: np.ndarray, spec: Spec) -> None:
    """Raises ValueError unless the array is what its field declares."""
    _check_size(array.nbytes)
    if array.dtype != DTYPES[spec.dtype]:
        raise ValueError(f"expected {spec.dtype}, got {array.dtype}")
    if array.shape != spec.shape and not _fits(array.shape, spec.shape):
        raise ValueError(f"expected shape {_shape(spec.shape)}, got {_shape(array.shape)}")
    if spec.finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"NaN or infinity in {np.count_nonzero(~np.isfinite(array))} elements")


def _fits(shape: tuple[int, ...], pattern: tuple[int | str, ...]) -> bool:
    if len(shape) != len(pattern):
        return False
    named = dict(zip(pattern, shape, strict=True))
    return shape == tuple(named[want] if isinstance(want, str) else want for want in pattern)


def _shape(extents: Iterable[int | str]) -> str:
    return f"({', '.join(str(extent) for extent in extents)})"


def _check_size(size: int) -> None:
    if size > MAX_BYTES:
        raise ValueError(f"{size} bytes are more than the limit of {MAX_BYTES}")


# ---------------------------------------------------------------------------------------------- checks

Check = Callable[[Any], None]
"""Checks the arrays inside one value; raises ValueError, with the place within the value as msgspec gives it."""


def is_record(kind: Any) -> bool:
    """True for what has fields with names: structs, dataclasses, named tuples and dictionaries with types."""
    named = isinstance(kind, type) and (issubclass(kind, msgspec.Struct) or hasattr(kind, "_fields"))
    return named or (isinstance(kind, type) and is_dataclass(kind)) or is_typeddict(kind)


def fields_of(kind: Any) -> dict[str, Any]:
    """The annotation of each field of a record."""
    hints = get_type_hints(kind, include_extras=True).items()
    fields = ((name, hint) for name, hint in hints if ClassVar not in (hint, get_origin(hint)))
    told = (Required, NotRequired)  # of dictionaries with types
    return {name: get_args(hint)[0] if get_origin(hint) in told else hint for name, hint in fields}


def spec_of(annotation: Any) -> Spec | None:
    """What an annotation says of its array."""
    extras = get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()
    return next((extra for extra in extras if isinstance(extra, Spec)), None)


@cache
def _record_checks(kind: Any) -> dict[str, Check]:
    """The fields of a record that may hold arrays, each with its check."""
    checks = ((name, _check_of(hint)) for name, hint in fields_of(kind).items())
    return {name: check for name, check in checks if check is not None}


def _check_of(annotation: Any) -> Check | None:
    """The check for values of one annotation, or None where they hold no arrays."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        spec = spec_of(annotation)
        return _check_of(arguments[0]) if spec is None else lambda value: _check_array(value, spec)
    if origin is np.ndarray or annotation is np.ndarray:
        raise TypeError("an array field needs its Spec: Annotated[NDArray[...], Spec(dtype, shape)]")
    if is_typeddict(annotation):
        return lambda value: _check_each(value.items(), map(_record_checks(annotation).get, value))
    if is_record(annotation):
        return _check_struct
    checks = [_check_of(argument) for argument in arguments]
    return _check_inside(origin, arguments, checks) if any(checks) else None


def _check_inside(origin: Any, arguments: tuple[Any, ...], checks: list[Check | None]) -> Check:
    """The check for the members of a union or the values in a container, of which each argument has its own."""
    if origin in (Union, UnionType):
        return _check_member(arguments, checks)
    if issubclass(cast("type", origin), Mapping):
        return lambda values: _check_each(values.items(), repeat(checks[1]))
    one_by_one = origin is tuple and arguments[-1] is not ...
    return lambda values: _check_each(enumerate(values), checks if one_by_one else repeat(checks[0]))


def _check_struct(value: Any) -> None:
    for name, check in _record_checks(type(value)).items():
        try:
            check(getattr(value, name))
        except ValueError as error:
            raise _within(f".{name}", error) from None


def _check_each(items: Iterable[tuple[Any, Any]], checks: Iterable[Check | None]) -> None:
    """Checks the values of (index or key, value) pairs."""
    for (key, value), check in zip(items, checks, strict=False):
        try:
            if check is not None:
                check(value)
        except ValueError as error:
            raise _within(f"[{key!r:.40}]", error) from None


def _check_member(members: tuple[Any, ...], checks: list[Check | None]) -> Check:
    """Checks a value as the member of a union that it is: msgspec takes members of different kinds only."""
    bare = (get_args(member)[0] if get_origin(member) is Annotated else member for member in members)
    bare = (dict if is_typeddict(kind) else kind for kind in bare)
    kinds = [(get_origin(kind) or kind, check) for kind, check in zip(bare, checks, strict=True) if check is not None]

    def check_member(value: Any) -> None:
        for kind, check in kinds:
            if isinstance(value, kind):
                check(value)

    return check_member


def _within(place: str, error: ValueError) -> ValueError:
    """The same error, of a value that lies at a place within a larger one."""
    reason, _, inner = str(error).partition(" - at `")
    return ValueError(f"{reason} - at `{place}{inner or '`'}")


# ---------------------------------------------------------------------------------------------- encode, decode

_BINARY = (bytes, bytearray, memoryview)
_ENCODER = msgspec.msgpack.Encoder(enc_hook=_to_wire)


@cache
def _decoder(kind: type) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(kind, dec_hook=_from_wire)


def encode(message: Message) -> bytes:
    """The message's bytes; raises CodecError where a field is not what its class declares, or it is too large."""
    return bytes(_encode_after(b"", message))


def _encode_after(head: bytes, message: Message) -> bytearray:
    """What the message's bytes follow, and these: in one piece, in which large arrays are copied once."""
    payload = bytearray(head)
    try:
        _check_fields(message)
        _ENCODER.encode_into(message, payload, len(head))
        _check_size(len(payload))
    except (msgspec.MsgspecError, ValueError, TypeError, OverflowError) as error:
        raise _codec_error(type(message).__name__, error) from None
    return payload


def _check_fields(message: Message) -> None:
    """What decoding would check, without copying arrays, and made where the blame lies: at the publisher."""
    values = msgspec.to_builtins(message, builtin_types=(np.ndarray, *_BINARY), enc_hook=_to_wire)
    _check_struct(msgspec.convert(values, type(message), builtin_types=_BINARY, dec_hook=_from_wire))


def decode(kind: type[M], body: bytes | msgspec.Raw) -> M:
    """Reads one message of a known class; raises CodecError and nothing else, whatever the bytes."""
    message = _decode_in_place(kind, body) if memoryview(body).nbytes > IN_PLACE_BYTES else None
    if message is None:
        message = unpack(kind, body)
    try:
        _check_struct(message)
    except (ValueError, TypeError) as error:
        raise _codec_error(kind.__name__, error) from None
    return message


def _decode_in_place(kind: type[M], body: bytes | msgspec.Raw) -> M | None:
    """Reads a message without copying its arrays; None where something is wrong with it, for others to say what."""
    fields, values = _field_decoders(kind), dict[str, Any]()
    try:
        for name, raw in _decoder(dict[str, msgspec.Raw]).decode(body).items():
            if name in fields:
                values[name] = _array_in_place(raw) if fields[name] is None else fields[name].decode(raw)
        return kind(**values)
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError, MemoryError, OverflowError):
        return None


@cache
def _field_decoders(kind: type[Message]) -> dict[str, Any]:
    """By field of a message; None for arrays."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: None if _is_array(hints[name]) else _decoder(hints[name]) for name in kind.__struct_fields__}


def _is_array(annotation: Any) -> bool:
    return get_origin(annotation) is Annotated and get_origin(get_args(annotation)[0]) is np.ndarray


def _array_in_place(raw: msgspec.Raw) -> np.ndarray:
    name, shape, data = _decoder(tuple[str, list[Any], memoryview]).decode(raw)
    array = _array(name, shape, data)
    if array.itemsize == 1 or array.ctypes.data % ALIGNMENT == 0:
        return array
    array = array.copy()
    array.flags.writeable = False
    return array


def pack(record: Envelope | Step | Journal | CaughtUp | Deal | Lost | LogLine | Pulse) -> bytes:
    """A record's bytes, on the wire and in a recording alike; raises CodecError where they are too many.

    Texts may hold what UTF-8 cannot, as names of files do that are not UTF-8: that is spelled out.
    """
    try:
        payload = _ENCODER.encode(record)
    except UnicodeEncodeError:
        payload = _ENCODER.encode(_spelled_out(record))
    try:
        _check_size(len(payload))
    except ValueError as error:
        raise _codec_error(type(record).__name__, error) from None
    return payload


def _spelled_out(record: R) -> R:
    values = ((name, getattr(record, name)) for name in record.__struct_fields__)
    return msgspec.structs.replace(
        record, **{name: spelled_out(text) for name, text in values if isinstance(text, str)}
    )


def spelled_out(text: str) -> str:
    """What a record holds of a text: characters that UTF-8 cannot hold as the codes that they have in Python."""
    return text.encode(errors="backslashreplace").decode()


def unpack(kind: type[R], payload: bytes | memoryview | msgspec.Raw) -> R:
    """Reads a record; raises CodecError and nothing else, whatever the bytes."""
    try:
        _check_size(memoryview(payload).nbytes)
        return _decoder(kind).decode(payload)
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError, MemoryError, OverflowError) as error:
        raise _codec_error(kind.__name__, error) from None


class Draft(msgspec.Struct, frozen=True):
    """A message that is ready for its journey."""

    envelope: Envelope
    payload: bytearray
    """What :func:`pack` makes of the envelope, whose body lies in here."""


def draft(message: Message, *, id: str, lineage: str, time_ns: int, causes: tuple[str, ...]) -> Draft:
    """Wraps a message for its journey; raises CodecError where the message breaks its class or is too large."""
    kind = type(message)
    cover = Envelope(id, lineage, time_ns, name_of(kind), kind.version, causes, msgspec.Raw())
    head = pack(cover)
    payload = _encode_after(head, message)
    body = msgspec.Raw(memoryview(payload)[len(head) :].toreadonly())
    return Draft(msgspec.structs.replace(cover, body=body), payload)


def envelope(message: Message, *, id: str, lineage: str, time_ns: int, causes: tuple[str, ...]) -> Envelope:
    """Wraps a message as :func:`draft` does; the envelope alone."""
    return draft(message, id=id, lineage=lineage, time_ns=time_ns, causes=causes).envelope


def open_envelope(kind: type[M], sealed: Envelope) -> M:
    """The message inside, which must be of the given class and version."""
    if sealed.type != (name := name_of(kind)):
        raise CodecError("Envelope", "type", f"expected {name}, got {sealed.type[:60]!r}")
    if sealed.version != kind.version:
        raise CodecError("Envelope", "version", f"expected {name} {kind.version}, got {sealed.version}")
    return decode(kind, sealed.body)


class Fields(dict[str, Any]):
    """A message or struct whose class is not known: its fields by name."""


def decode_untyped(body: bytes | msgspec.Raw) -> Any:
    """Reads a message without knowing its class: maps as :class:`Fields`, arrays as arrays. Raises CodecError."""
    return _named(unpack(cast("type[msgspec.Struct]", Any), body))


def _named(value: Any) -> Any:
    match value:
        case dict():
            return Fields({str(key): _named(inner) for key, inner in value.items()})
        case [str() as name, list() as shape, bytes() as data] if name in DTYPES:
            try:
                return _array(name, shape, data)
            except ValueError as error:
                raise CodecError("array", "", str(error)) from None
        case list():
            return [_named(inner) for inner in value]
        case _:
            return value


def _codec_error(type_name: str, error: Exception) -> CodecError:
    """Splits the place off an error text of the form ``reason - at `$.field```."""
    reason, _, place = str(error).partition(" - at `")
    return CodecError(type_name, re.sub(r"^\$?\.?|`$", "", place), reason)


# ---------------------------------------------------------------------------------------------- schemas


def json_schema(kind: type[Message]) -> dict[str, Any]:
    """JSON Schema of the map that carries one message type: the envelope with its body."""
    (place,), definitions = describe(kind)
    name = place["$ref"].rpartition("/")[2]
    body = definitions[name]
    if repr(place["$ref"]) not in repr(definitions):  # it does not hold itself
        del definitions[name]
    (schema,) = msgspec.json.schema_components([Envelope])[1].values()
    schema["title"], schema["properties"]["body"] = name_of(kind), body
    return {**schema, "$defs": definitions} if definitions else schema


def describe(annotation: Any) -> tuple[tuple[dict[str, Any], ...], dict[str, Any]]:
    """JSON Schema of values of a type, and of all classes inside by name; raises TypeError where it cannot travel."""
    return msgspec.json.schema_components([annotation], schema_hook=_array_schema, ref_template="#/$defs/{name}")


def _array_schema(kind: type) -> dict[str, Any]:
    if not issubclass(kind, np.ndarray):
        raise NotImplementedError
    extents = {"type": "array", "items": {"type": "integer", "minimum": 0}, "maxItems": MAX_DIMENSIONS}
    data = {"type": "string", "contentEncoding": "binary"}
    return {"title": "array", "type": "array", "prefixItems": [{"enum": list(DTYPES)}, extents, data]}
