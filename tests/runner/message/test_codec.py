"""Messages survive the wire bit for bit, and nothing malformed gets past it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, NotRequired, Required, TypedDict
from unittest import mock

import jsonschema
import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from runner.contract import Message, Spec, Struct
from runner.message import codec
from runner.message.codec import CodecError, Envelope, LogLine, Step
from tests.runner.common import toys

Image = Annotated[NDArray[np.uint8], Spec("uint8", ("H", "W", 3))]
Square = Annotated[NDArray[np.float64], Spec("float64", ("N", "N"))]
Mask = Annotated[NDArray[np.bool_], Spec("bool", ("N",))]


class Thing(Struct, frozen=True, kw_only=True):
    pose: Square
    label: str = ""


class Sample(Message, frozen=True, kw_only=True):
    image: Image
    square: Square | None = None
    mask: Mask | None = None
    things: tuple[Thing, ...] = ()
    scale: float = 1.0


def sample(**changes: object) -> Sample:
    return msgspec.structs.replace(Sample(image=np.zeros((2, 3, 3), np.uint8)), **changes)


def sealed(message: Message) -> Envelope:
    return codec.envelope(message, id="camera.sample#4", lineage="camera.sample#4", time_ns=5, causes=("a.b#1",))


finite = st.floats(allow_nan=False, allow_infinity=False)
squares = st.integers(0, 4).flatmap(lambda n: hnp.arrays(np.float64, (n, n), elements=finite))
samples = st.builds(
    Sample,
    image=hnp.arrays(np.uint8, st.tuples(st.integers(0, 3), st.integers(0, 3), st.just(3))),
    square=st.none() | squares,
    mask=st.none() | hnp.arrays(np.bool_, st.integers(0, 5)),
    things=st.lists(st.builds(Thing, pose=squares, label=st.text()), max_size=3).map(tuple),
    scale=finite,
)


@given(samples)
def test_bytes_survive_decoding(message: Sample):
    payload = codec.pack(sealed(message))
    envelope = codec.unpack(Envelope, payload)
    read = codec.open_envelope(Sample, envelope)
    np.testing.assert_array_equal(read.image, message.image)
    assert codec.pack(envelope) == payload
    assert codec.encode(read) == codec.encode(message)


@given(st.binary(max_size=200))
def test_random_bytes_raise_nothing_but_codec_error(payload: bytes):
    for kind in (Envelope, Step, LogLine):
        with pytest.raises(CodecError):
            codec.unpack(kind, payload)
    with pytest.raises(CodecError):
        codec.decode(Sample, payload)


@given(samples, st.data())
def test_a_changed_byte_raises_nothing_but_codec_error(message: Sample, data: st.DataObject):
    payload = bytearray(codec.pack(sealed(message)))
    payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        codec.open_envelope(Sample, codec.unpack(Envelope, bytes(payload)))
    except CodecError as error:
        assert error.reason


@given(samples, st.integers(0, 40), st.data())
def test_arrays_that_are_read_where_they_lie_are_the_same(message: Sample, offset: int, data: st.DataObject):
    """Also what is wrong with a message is the same, whatever its size."""
    body = bytearray(codec.encode(message))
    if data.draw(st.booleans()):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    memory = memoryview(bytes(offset) + body)[offset:]
    with mock.patch.object(codec, "IN_PLACE_BYTES", 0):
        there = read_or_refuse(memory)
    assert bytes_of(there) == bytes_of(read_or_refuse(bytes(body)))


def bytes_of(read: Sample | str) -> bytes | str:
    return read if isinstance(read, str) else codec.encode(read)


@given(samples)
def test_a_draft_is_what_its_envelope_is(message: Sample):
    draft = codec.draft(message, id="camera.sample#4", lineage="camera.sample#4", time_ns=5, causes=("a.b#1",))
    assert codec.pack(draft.envelope) == draft.payload
    assert codec.decode(Sample, draft.envelope.body).image.tobytes() == message.image.tobytes()


def test_large_arrays_of_a_draft_are_copied_once_and_cannot_be_changed():
    image, square = np.zeros((200, 300, 3), np.uint8), np.asfortranarray(np.eye(100))
    message = Sample(image=image, square=square, mask=np.ones(70_000, bool), things=(), scale=1.0)
    draft = codec.draft(message, id="a.b#1", lineage="a.b#1", time_ns=5, causes=())
    plain = msgspec.msgpack.Encoder(enc_hook=codec._to_wire).encode(message)
    assert codec.encode(message) == plain == bytes(draft.envelope.body)
    read = codec.decode(Sample, draft.envelope.body)
    assert np.shares_memory(read.image, np.frombuffer(draft.payload, np.uint8)) and not read.image.flags.writeable


def read_or_refuse(body: bytes | memoryview) -> Sample | str:
    try:
        read = codec.decode(Sample, msgspec.Raw(body))
    except CodecError as error:
        return str(error)
    assert not read.image.flags.writeable and read.image.flags.aligned
    return read


def test_large_arrays_are_not_copied_and_others_are_aligned():
    image, square = np.zeros((200, 300, 3), np.uint8), np.eye(100)
    body = codec.encode(Sample(image=image, square=square, mask=None, things=(), scale=1.0))
    for offset in range(16):
        memory = memoryview(bytes(offset) + body)[offset:]
        read = codec.decode(Sample, msgspec.Raw(memory))
        assert np.shares_memory(read.image, np.frombuffer(memory, np.uint8))
        assert read.square is not None and read.square.ctypes.data % codec.ALIGNMENT == 0
        np.testing.assert_array_equal(read.square, square)


@pytest.mark.parametrize("payload", [b"\x91" * 100_000, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc1", b""])
def test_hostile_bytes_are_refused(payload: bytes):
    with pytest.raises(CodecError):
        codec.unpack(Envelope, payload)


@pytest.mark.parametrize(
    ("changes", "place", "reason"),
    [
        ({"image": np.zeros((2, 3), np.uint8)}, "image", r"expected shape \(H, W, 3\), got \(2, 3\)"),
        ({"image": np.zeros((2, 3, 3))}, "image", "expected uint8, got float64"),
        ({"square": np.zeros((2, 3))}, "square", r"expected shape \(N, N\)"),
        ({"square": np.full((1, 1), np.nan)}, "square", "NaN or infinity in 1 elements"),
        ({"things": (Thing(pose=np.eye(2)), Thing(pose=np.ones((1, 2))))}, "things[1].pose", "expected shape"),
        ({"scale": "wide"}, "scale", "Expected `float`"),
        ({"image": np.array([object()])}, "image", "expected uint8, got object"),
        ({"square": np.zeros((1, 1), ">f8")}, "square", "expected float64, got >f8"),
    ],
)
def test_a_publisher_is_told_which_field_is_wrong(changes: dict[str, object], place: str, reason: str):
    with pytest.raises(CodecError, match=reason) as caught:
        codec.encode(sample(**changes))
    assert (caught.value.type, caught.value.field) == ("Sample", place)


@pytest.mark.parametrize("value", [np.array([object()]), np.zeros(1, ">f8"), object()])
def test_what_has_no_form_on_the_wire_is_refused(value: object):
    kind = msgspec.defstruct("Loose", [("value", Any)], bases=(Message,), frozen=True, kw_only=True)
    with pytest.raises(CodecError, match=r"Loose: .* cannot be encoded"):
        codec.encode(kind(value=value))


@pytest.mark.parametrize(
    ("array", "reason"),
    [
        (["object", [1], b"12345678"], "element type 'object' is not one of"),
        (["float64", [2], b"12345678"], "8 bytes do not fill"),
        (["float64", [-1], b""], "is not a list of at most"),
        (["float64", [1] * 9, b"12345678"], "is not a list of at most"),
        (["bool", [1], b"\x02"], "a bool is neither 0 nor 1"),
        ("text", "expected an array as"),
    ],
)
def test_a_malformed_array_is_refused(array: object, reason: str):
    with pytest.raises(CodecError, match=reason) as caught:
        codec.decode(Sample, msgpack.packb({"image": array}))
    assert caught.value.field == "image"


class Ball(Struct, frozen=True, kw_only=True, tag=True):
    radii: Mask


class Cube(Struct, frozen=True, kw_only=True, tag=True):
    sides: Square


@dataclass(frozen=True)
class Plate:
    corners: Square


class Pair(NamedTuple):
    left: Mask
    right: Square


class Shelf(TypedDict):
    boards: Required[tuple[Square, ...]]
    flags: NotRequired[Mask]


class Nest(Message, frozen=True, kw_only=True):
    """Arrays wherever they can be."""

    by_name: dict[str, Square] = msgspec.field(default_factory=dict)
    pair: tuple[Mask, Square] | None = None
    many: tuple[Square, ...] | Mapping[str, Square] = ()
    either: Ball | Cube | None = None
    deep: list[dict[str, tuple[Ball | Cube, ...]]] = msgspec.field(default_factory=list)
    plate: Plate | None = None
    named: Pair | None = None
    shelf: Shelf | None = None


masks = hnp.arrays(np.bool_, st.integers(0, 5))
shapes = st.builds(Ball, radii=masks) | st.builds(Cube, sides=squares)
several = st.lists(squares, max_size=3).map(tuple)
named = st.dictionaries(st.text(max_size=3), squares, max_size=3)
nests = st.builds(
    Nest,
    by_name=named,
    pair=st.none() | st.tuples(masks, squares),
    many=several | named,
    either=st.none() | shapes,
    deep=st.lists(
        st.dictionaries(st.text(max_size=3), st.lists(shapes, max_size=2).map(tuple), max_size=2), max_size=2
    ),
    plate=st.none() | st.builds(Plate, corners=squares),
    named=st.none() | st.builds(Pair, left=masks, right=squares),
    shelf=st.none() | st.fixed_dictionaries({"boards": st.tuples(squares)}, optional={"flags": masks}),
)
NOT_SQUARE, NOT_FINITE, NOT_FLOAT = np.zeros((1, 2)), np.full((1, 1), np.inf), np.zeros((2, 2), np.float32)


@given(nests)
def test_arrays_survive_wherever_they_are(message: Nest):
    assert codec.encode(codec.decode(Nest, codec.encode(message))) == codec.encode(message)


@given(st.sampled_from([NOT_SQUARE, NOT_FINITE, NOT_FLOAT]), nests, st.integers(0, 2))
def test_arrays_are_checked_wherever_they_are(wrong: np.ndarray, nest: Nest, number: int):
    """At the publisher, and at the consumer of bytes that were not checked."""
    first, flag = (np.eye(2),) * number, np.ones(1, bool)
    places: dict[str, dict[str, object]] = {
        "by_name['b']": {"by_name": {"a": np.eye(1), "b": wrong}},
        "pair[1]": {"pair": (flag, wrong)},
        f"many[{number}]": {"many": (*first, wrong)},
        "many['a']": {"many": {"a": wrong}},
        "either.sides": {"either": Cube(sides=wrong)},
        "plate.corners": {"plate": Plate(wrong)},
        "named.right": {"named": Pair(flag, wrong)},
        f"shelf['boards'][{number}]": {"shelf": {"flags": flag, "boards": (*first, wrong)}},
        f"deep[0]['a'][{number}].sides": {"deep": [{"a": (*(Ball(radii=flag) for _ in first), Cube(sides=wrong))}]},
    }
    for place, changes in places.items():
        assert refused(msgspec.structs.replace(nest, **changes)).field == place


def test_the_first_of_a_pair_is_not_what_the_second_is():
    assert refused(Nest(pair=(np.eye(2), np.eye(2)))).field == "pair[0]"
    assert refused(Nest(either=Ball(radii=np.eye(2)))).field == "either.radii"


def refused(message: Message) -> CodecError:
    with pytest.raises(CodecError) as caught:
        codec.encode(message)
    unchecked = msgspec.msgpack.Encoder(enc_hook=codec._to_wire).encode(message)
    with pytest.raises(CodecError) as read:
        codec.decode(type(message), unchecked)
    assert (read.value.field, read.value.reason) == (caught.value.field, caught.value.reason)
    return caught.value


def test_what_a_publisher_gives_in_place_of_a_struct_or_tuple_is_checked_as_what_it_becomes():
    with pytest.raises(CodecError, match="expected shape") as caught:
        codec.encode(sample(things=[{"pose": np.zeros((1, 2))}]))
    assert caught.value.field == "things[0].pose"


def test_a_payload_over_the_limit_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(codec, "MAX_BYTES", 10)
    with pytest.raises(CodecError, match="11 bytes are more than the limit of 10"):
        codec.unpack(Envelope, bytes(11))


@pytest.mark.parametrize("shape", [(300, 2**20, 3), (2**16, 2**17, 3)])
def test_an_array_over_the_limit_is_refused_where_it_is_published(shape: tuple[int, ...]):
    """Also one whose size msgpack cannot write."""
    size = np.prod(shape)
    with pytest.raises(CodecError, match=f"{size} bytes are more than the limit of {codec.MAX_BYTES}") as caught:
        codec.encode(sample(image=np.broadcast_to(np.uint8(0), shape)))
    assert (caught.value.type, caught.value.field) == ("Sample", "image")


@given(samples, st.integers(-200, 200))
def test_what_is_published_is_what_can_be_read(message: Sample, room: int):
    """The limit is that of the envelope, at both ends."""
    whole = codec.pack(sealed(message))
    with mock.patch.object(codec, "MAX_BYTES", len(whole) + room):
        try:
            payload = codec.pack(sealed(message))
        except CodecError as error:
            assert room < 0 and "bytes are more than the limit" in error.reason
            return
        assert codec.open_envelope(Sample, codec.unpack(Envelope, payload)).scale == message.scale


def test_a_record_over_the_limit_is_refused_where_it_is_published(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(codec, "MAX_BYTES", 100)
    with pytest.raises(CodecError, match=r"LogLine: 1.. bytes are more than the limit of 100"):
        codec.pack(LogLine("camera", 0, "info", "x" * 100, 0))


def test_what_utf_8_cannot_hold_is_spelled_out_in_a_record():
    line = LogLine("camera", 0, "info", "no d\udcffd.png", 0)
    assert codec.unpack(LogLine, codec.pack(line)).text == r"no d\udcffd.png"


def test_decoded_arrays_are_read_only():
    assert not codec.decode(Sample, codec.encode(sample())).image.flags.writeable


def test_numpy_scalars_become_plain_numbers():
    assert codec.decode(Sample, codec.encode(sample(scale=np.float32(0.5)))).scale == 0.5


def test_the_wire_is_one_plain_msgpack_map():
    payload = msgpack.unpackb(codec.pack(sealed(sample())))
    assert payload["id"] == "camera.sample#4"
    assert payload["body"]["image"] == ["uint8", [2, 3, 3], bytes(18)]


def test_an_envelope_of_another_type_is_refused():
    with pytest.raises(CodecError, match="expected Other, got 'Sample'"):
        codec.open_envelope(type("Other", (Message,), {}), sealed(sample()))


def test_the_schema_describes_what_is_on_the_wire():
    schema = codec.json_schema(Sample)
    jsonschema.Draft202012Validator.check_schema(schema)
    message = sample(square=np.eye(2), things=(Thing(pose=np.eye(3)),))
    wire = msgpack.unpackb(codec.pack(sealed(message)))
    text = json.loads(json.dumps(wire, default=lambda data: data.decode("latin-1")))
    jsonschema.validate(text, schema)
    assert schema["title"] == "Sample"


class Number(Message, frozen=True, kw_only=True):
    number: toys.Number


class Branch(Message, frozen=True, kw_only=True):
    name: str
    twigs: "tuple[Branch, ...]" = ()


def called(name: str, **fields: float) -> Message:
    """A message of a class with a name."""
    kinds = [(field, type(value)) for field, value in fields.items()]
    kind: Any = msgspec.defstruct(name, kinds, bases=(Message,), frozen=True, kw_only=True)
    return kind(**fields)


@pytest.mark.parametrize(
    "message",
    [
        Number(number=toys.Number(value=3)),
        called("Größe", höhe=0.5),
        called("Envelope", height=0.5),
        Branch(name="a", twigs=(Branch(name="b"),)),
    ],
    ids=["inside", "letters", "envelope", "itself"],
)
def test_any_class_has_a_schema(message: Message):
    """Also one that holds itself, or has the name of a class inside or of the record around it."""
    schema = codec.json_schema(type(message))
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(msgpack.unpackb(codec.pack(sealed(message))), schema)
    assert schema["title"] == type(message).__name__
