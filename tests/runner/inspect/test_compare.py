import msgspec
import numpy as np
import pytest

from runner.inspect.compare import differences, envelope_differences
from runner.message.codec import Envelope, pack, unpack
from tests.runner.common.toys import Answer


def answer(*samples: float, index: int = 0) -> Answer:
    return Answer(index=index, count=2, samples=np.array(samples, np.float64))


def test_equal_messages_do_not_differ_even_with_nan():
    assert list(differences(answer(1, np.nan), answer(1, np.nan))) == []


def test_names_the_field_the_first_element_and_the_extent():
    (found,) = differences(answer(1, 2, 3), answer(1, 2.5, 4))
    assert found.field == "samples[1]"
    assert (found.recorded, found.replayed) == ("2.0", "2.5")
    assert found.extent == "2 of 3 elements differ, by 1 at most"


def test_fields_come_in_the_order_of_declaration():
    assert [found.field for found in differences(answer(1), answer(2, index=1))] == ["index", "samples[0]"]


def test_the_sign_of_zero_is_a_difference():
    assert len(list(differences(answer(0.0), answer(-0.0)))) == 1
    assert len(list(differences(0.0, -0.0))) == 1


@pytest.mark.parametrize(
    ("recorded", "replayed", "text"),
    [
        (answer(1), answer(1, 2), "samples: recorded float64 (1,), replayed float64 (2,)"),
        ((1, 2), (1,), "recorded 2 items, replayed 1 items"),
        ({"a": 1}, {"b": 1}, "keys differ"),
        ({"a": 1, 2: 1}, {"a": 1}, "recorded ['a', 2], replayed ['a'] (keys differ)"),
        ({"a": [1, {"b": 2}]}, {"a": [1, {"b": 3}]}, "['a'][1]['b']: recorded 2, replayed 3"),
        (None, 1, "types differ"),
        ("x" * 200, "y", "..."),
    ],
)
def test_says_what_differs(recorded: object, replayed: object, text: str):
    assert text in str(next(differences(recorded, replayed)))


def test_finds_a_changed_element_of_an_empty_shape_and_of_integers():
    assert list(differences(np.zeros((0, 3)), np.zeros((0, 3)))) == []
    (found,) = differences(np.zeros((2, 2), np.uint8), np.array([[0, 0], [255, 0]], np.uint8))
    assert found.field == "[1, 0]"
    assert "255" in found.extent


def test_large_integers_differ_by_what_they_differ():
    stamp, lowest = 1_790_000_000_000_000_000, -(2**63)
    assert next(differences(stamp, stamp + 1)).largest == 1
    assert next(differences(np.array([stamp, lowest]), np.array([stamp + 1, lowest]))).largest == 1
    assert next(differences(np.array([lowest]), np.array([2**63 - 1]))).largest == 2.0**64


def test_the_same_values_in_other_bytes_are_a_difference():
    one, other = (
        Envelope("a.b#0", "a.b#0", 0, "B", 1, (), msgspec.Raw(msgspec.msgpack.encode({"tags": tags})))
        for tags in ({"a": 1, "b": 2}, {"b": 2, "a": 1})
    )
    (found,) = envelope_differences(one, unpack(Envelope, pack(other)), ("id",))
    assert str(found) == "body: recorded 13 bytes, replayed 13 bytes (the same values in other bytes)"
    assert list(envelope_differences(one, unpack(Envelope, pack(one)), ("id",))) == []
