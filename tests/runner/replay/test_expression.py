import contextlib

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.contract import Message, Refused, Struct
from runner.replay.expression import Expression
from tests.runner.common.toys import Answer, Number, Total


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
    "input": {"total": Total},
}
MESSAGES: dict[str, Message] = {
    "counter/number": Number(value=3),
    "worker/answer": Answer(index=1, count=4, samples=np.array([0.5, -2.0])),
    "gatherer/total": Total(samples=np.arange(3.0), last=True),
    "input/total": Total(samples=np.zeros(0), last=True),
    "ranker/scene": Scene(items=(Item(name="cup", cost=0.5), Item(name="box", cost=2.0)), by_name={"cup": 1}),
}


@pytest.mark.parametrize(
    "text",
    [
        "counter.number.value == 3",
        " 1 < counter.number.value < 4 and not counter.number.last",
        "counter.number.value in [1, 3]",
        "counter.number.value % 2 == 1 or counter.number.last",
        "any(worker.answer.samples < 0)",
        "np.abs(worker.answer.samples).max() == 2",
        "len(ranker.scene.items) == 2",
        "ranker.scene.items[1].name == 'box'",
        "any(item.cost > 1 for item in ranker.scene.items)",
        "[item.name for item in ranker.scene.items if item.cost < counter.number.value] == ['cup', 'box']",
        "ranker.scene.best is None",
        "ranker.scene.by_name['cup'] == 1",
        "gatherer.total.samples.size / 3 == 1",
        "gatherer.total.last",
        "counter.number.value > 2 and max(worker.answer.samples) < 1",
        "(value := counter.number.value) and value == 3",
        "max(ranker.scene.items, key=lambda item: item.cost).name == 'box'",
        "isinstance(counter.number, object)",
        "input.total.last",
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
        ("counter.number.valu > 1", "Number has no field 'valu'; did you mean 'value'"),
        ("counter.number.last and worker.answer.sample[0]", "Answer has no field 'sample'; did you mean 'samples'"),
        ("counter > 1", "'counter' alone is no message; did you mean 'counter.number'"),
        ("[counter for counter in ranker.scene.items]", "'counter' alone is no message"),
        ("ranker.scene.items[count].cost > 1", "'count' alone is no message; did you mean 'counter'"),
        ("1 > 0", "names no message"),
        ("counter.number.value >", "is no expression of Python: invalid syntax"),
        ("counter.number.value = 3", "is no expression of Python"),
        ("", "is no expression of Python"),
        ("counter.number.value" + " + 1" * 90_000, "is no expression of Python"),
    ],
)
def test_what_cannot_hold_is_refused_before_anything_runs(text: str, error: str):
    with pytest.raises(Refused) as refusal:
        Expression(text, PORTS)
    assert f"--break {text!r}: " in str(refusal.value)
    assert error in str(refusal.value)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("ranker.scene.items[0].cst > 1", "Item has no field 'cst'; did you mean 'cost'? valid: cost, name"),
        ("worker.answer.samples > 0", "ValueError: The truth value of an array"),
        ("worker.answer.samples[7] > 0", "IndexError"),
        ("counter.number.value / 0 > 0", "ZeroDivisionError"),
        ("counter.number > 3", "TypeError"),
        ("ranker.scene.best.cost > 3", "AttributeError: 'NoneType' object has no attribute 'cost'"),
    ],
)
def test_what_a_message_does_not_have_is_refused(text: str, error: str):
    with pytest.raises(Refused) as refusal:
        Expression(text, PORTS).holds(MESSAGES)
    assert error in str(refusal.value)


@given(
    st.text() | st.lists(st.sampled_from(("counter.number", ".value", "[", "]", "(", ")", " if ", "\0"))).map("".join)
)
def test_any_text_is_an_expression_or_refused(text: str):
    with contextlib.suppress(Refused):
        assert Expression(text, PORTS).topics == {"counter/number"}
