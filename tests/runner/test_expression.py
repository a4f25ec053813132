import sys

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.contract import Message, Refused, Struct
from runner.replay.expression import MAX_LENGTH, Expression
from tests.runner.toys import Answer, Number, Total


class Item(Struct, frozen=True, kw_only=True):
    name: str
    cost: float


class Scene(Message, frozen=True, kw_only=True):
    items: tuple[Item, ...]
    by_name: dict[str, int] = msgspec.field(default_factory=dict)
    best: Item | None = None


PORTS = {
    "counter": {"number": Number},
    "worker": {"answer": Answer},
    "gatherer": {"total": Total},
    "ranker": {"scene": Scene},
}
MESSAGES: dict[str, Message] = {
    "counter/number": Number(value=3),
    "worker/answer": Answer(index=1, count=4, samples=np.array([0.5, -2.0])),
    "gatherer/total": Total(samples=np.arange(3.0), last=True),
    "ranker/scene": Scene(items=(Item(name="cup", cost=0.5), Item(name="box", cost=2.0)), by_name={"cup": 1}),
}


@pytest.mark.parametrize(
    "text",
    [
        "counter.number.value == 3",
        "1 < counter.number.value < 4 and not counter.number.last",
        "counter.number.value in [1, 3]",
        "counter.number.value % 2 == 1 or counter.number.last",
        "-counter.number.value + 4 == 1",
        "any(worker.answer.samples < 0)",
        "worker.answer.samples[0] > worker.answer.samples[1]",
        "abs(min(worker.answer.samples)) == 2",
        "len(ranker.scene.items) == 2",
        "ranker.scene.items[1].name == 'box'",
        "any(ranker.scene.items.cost > 1)",
        "all(ranker.scene.items.name != 'tray')",
        "'cup' in ranker.scene.items.name",
        "ranker.scene.best is None",
        "ranker.scene.by_name['cup'] == 1",
        "gatherer.total.samples.size / 3 == 1",
        "gatherer.total.last",
        "counter.number.value > 2 and max(worker.answer.samples) < 1",
    ],
)
def test_holds(text: str):
    assert Expression(text, PORTS).holds(MESSAGES)


def test_knows_the_topics_it_needs_and_does_not_hold_before_they_are_there():
    both = Expression("counter.number.value > 2 and max(worker.answer.samples) < 1", PORTS)
    assert both.topics == {"counter/number", "worker/answer"}
    assert not both.holds({"counter/number": Number(value=3)})


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("countr.number.value > 1", "no stage 'countr'; did you mean 'counter'"),
        ("counter.nmber.value > 1", "counter has no output 'nmber'; did you mean 'number'"),
        ("counter > 1", "'counter' alone is no message; valid: counter.number"),
        ("1 > 0", "names no message"),
        ("counter.number.value >", "is no expression"),
        ("", "is no expression"),
        ("x" * (MAX_LENGTH + 1), "longer than"),
        ("counter.number.value" + " + 1" * 60, "nested deeper"),
        ("print(counter.number)", "'print(counter.number)' is not in the language; valid: len, abs"),
        ("counter.number.value.__class__()", "is not in the language"),
        ("[x for x in counter.number]", "is not in the language"),
        ("(lambda: counter.number)()", "is not in the language"),
        ("counter.number.value ** 9", "is not in the language"),
        ("f'{counter.number}'", "is not in the language"),
        ("len(counter.number, 2)", "of one value"),
        ("(x := counter.number.value)", "is not in the language"),
    ],
)
def test_what_is_not_in_the_language_is_refused_before_anything_runs(text: str, error: str):
    with pytest.raises(Refused) as refusal:
        Expression(text, PORTS)
    assert error in str(refusal.value)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("counter.number.valu > 1", "Number has no field 'valu'; did you mean 'value'"),
        ("counter.number.__class__ is None", "Number has no field '__class__'"),
        ("worker.answer.samples.tofile is None", "ndarray has no field 'tofile'"),
        ("worker.answer.samples.__class__ is None", "ndarray has no field '__class__'"),
        ("worker.answer.samples > 0", "is many values; valid: any(...)"),
        ("worker.answer.samples[7] > 0", "IndexError"),
        ("worker.answer.samples[None] > 0", "None is no index"),
        ("counter.number.value / 0 > 0", "ZeroDivisionError"),
        ("counter.number.value + 'x' == 0", "str is no number"),
        ("'x' * counter.number.value == 0", "str is no number"),
        ("counter.number.value[0] == 0", "a int has no items"),
        ("counter.number > 3", "TypeError"),
    ],
)
def test_what_a_message_does_not_have_is_refused(text: str, error: str):
    with pytest.raises(Refused) as refusal:
        Expression(text, PORTS).holds(MESSAGES)
    assert error in str(refusal.value)


WORDS = (
    *("counter.number.value", "worker.answer.samples", "ranker.scene", "items", "[0]", "len(", "any(", ")", "("),
    *("not ", " and ", " in ", " < ", " == ", " + ", " * ", "'x'", "3", "-", "[", "]", "None", ".", ",", "**"),
    *("__class__", "__import__('os').system('x')", "lambda: ", "exec(", "eval(", "open('x')", ":=", "f'{1}'", "~", "@"),
)
"""Pieces that random text would rarely put together."""


FORBIDDEN = ("exec", "open", "os.", "subprocess.", "socket.", "ctypes.", "pty.", "shutil.")
"""Audit events of the interpreter that would betray that something else than the expression runs."""
caught: list[str] = []
watching = False


def note(event: str, _: object) -> None:
    if watching and event.startswith(FORBIDDEN):
        caught.append(event)


sys.addaudithook(note)


def refused_or_judged(text: str) -> None:
    global watching  # noqa: PLW0603 - an audit hook cannot be removed
    watching = True
    try:
        Expression(text, PORTS).holds(MESSAGES)
    except Refused as refusal:
        assert str(refusal).startswith("--break ")
    finally:
        watching = False
    assert caught == []


def test_the_watch_sees_what_is_executed():
    global watching  # noqa: PLW0603
    watching = True
    exec("1")
    watching = False
    assert caught == ["exec"]
    caught.clear()


@given(st.text())
def test_random_text_never_executes_anything(text: str):
    refused_or_judged(text)


@given(st.lists(st.sampled_from(WORDS), max_size=12).map("".join))
def test_random_pieces_never_execute_anything(text: str):
    refused_or_judged(text)
