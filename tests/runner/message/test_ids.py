import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.contract import Refused
from runner.message.ids import IdText, MessageId
from runner.message.packet import Process

names = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
ids = st.builds(MessageId, names, names, st.integers(0, 10**15 - 1))


@given(ids)
def test_an_id_is_its_text(id: MessageId):
    assert MessageId.of(str(id)) == id
    assert msgspec.convert(str(id), IdText) == str(id)
    assert id.topic == f"{id.stage}/{id.port}"


def test_ids_are_sorted_by_port_and_number():
    texts = ["b.a#1", "a.b#10", "a.b#9", "a.a#11"]
    assert sorted(texts, key=MessageId.of) == ["a.a#11", "a.b#9", "a.b#10", "b.a#1"]


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ("", "", 0)),
        ("camera", ("camera", "", 0)),
        ("camera.frame", ("camera", "frame", 0)),
        ("camera.frame#x", ("camera", "frame", 0)),
        ("camera.frame#-1", ("camera", "frame", 0)),
        ("camera.frame#" + "9" * 5000, ("camera", "frame", 0)),
    ],
)
def test_what_is_malformed_is_empty(text: str, parts: tuple[str, str, int]):
    assert MessageId.of(text) == MessageId(*parts)


@pytest.mark.parametrize("key", ["", "camera/0", "camera/0/1\n", "camera/0/x", "h/0/1/camera"])
def test_a_key_that_ends_with_no_process_is_refused(key: str):
    assert Process.of(f"run/present/{Process('camera', 0, 1).path}") == Process("camera", 0, 1)
    with pytest.raises(Refused, match="names no process"):
        Process.of(key)


@given(st.text())
def test_any_text_can_be_read(text: str):
    assert MessageId.of(text).sequence >= 0


@pytest.mark.parametrize("text", ["", "camera", "camera.frame", "camera.frame#", "camera.frame#1\n", "a b.c#1"])
def test_on_the_wire_an_id_is_whole(text: str):
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(text, IdText)
