"""Messages survive the wire bit for bit, and nothing malformed gets past it."""

import json
from typing import Annotated
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
def test_parts_are_what_a_whole_is(message: Sample):
    whole = codec.pack(sealed(message))
    with mock.patch.object(codec, "IN_PLACE_BYTES", 0):
        draft = codec.draft(message, id="camera.sample#4", lineage="camera.sample#4", time_ns=5, causes=("a.b#1",))
    assert len(draft.parts()) >= 2 and codec.pack(draft.sealed()) == b"".join(draft.parts())
    assert codec.decode(Sample, draft.sealed().body).image.tobytes() == message.image.tobytes()
    assert len(whole) <= len(b"".join(draft.parts()))  # of short arrays the length is written in one byte


def test_large_arrays_are_parts_of_their_own():
    image, square = np.zeros((200, 300, 3), np.uint8), np.asfortranarray(np.eye(100))
    message = Sample(image=image, square=square, mask=np.ones(70_000, bool), things=(), scale=1.0)
    draft = codec.draft(message, id="a.b#1", lineage="a.b#1", time_ns=5, causes=())
    assert [np.shares_memory(image, np.frombuffer(part, np.uint8)) for part in draft.parts()].count(True) == 1
    assert [len(part) for part in draft.parts()[2::2]] == [180_000, 80_000, 70_000]
    plain = msgspec.msgpack.Encoder(enc_hook=codec._to_wire).encode(message)
    assert codec.encode(message) == plain == b"".join(draft.body)


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
        ({"image": np.array([object()])}, "", "an array of object cannot be encoded"),
        ({"image": np.zeros(1, ">f8")}, "", "an array of >f8 cannot be encoded"),
    ],
)
def test_a_publisher_is_told_which_field_is_wrong(changes: dict[str, object], place: str, reason: str):
    with pytest.raises(CodecError, match=reason) as caught:
        codec.encode(sample(**changes))
    assert (caught.value.type, caught.value.field) == ("Sample", place)


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


def test_a_payload_over_the_limit_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(codec, "MAX_BYTES", 10)
    with pytest.raises(CodecError, match="more than the limit of 10"):
        codec.unpack(Envelope, bytes(11))


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
