"""What comes twice is taken once, however much has come since."""

import pytest

from runner.contract import Message
from runner.graph.reading import load_graph
from runner.message import codec
from runner.message.codec import Step
from runner.message.packet import Packet
from runner.message.refusals import Refusals
from runner.process.intake import Intake
from runner.supervise.child import Progress
from tests.runner.common.runs import TOYS
from tests.runner.common.toys import Number

MANY = 25_000
NODES = load_graph(TOYS, ("sink.path=out",)).nodes


def packet(message: Message, id: str) -> Packet:
    sealed = codec.envelope(message, id=id, lineage=id, time_ns=0, causes=())
    return Packet("key", codec.pack(sealed), 0, 0)


def intake(stage: str, progress: Progress | None = None) -> Intake:
    def complain(text: str) -> None:
        raise AssertionError(text)

    consumed = [one for _, one in progress.consumed()] if progress else ()
    return Intake(NODES[stage], Refusals(complain), consumed=consumed, is_new=True)


def test_of_many_messages_that_come_twice_each_is_taken_once() -> None:
    taking = intake("splitter")
    for _ in range(2):
        for number in range(MANY):
            taking.came("number", packet(Number(value=number), f"counter.number#{number}"))
    taking.take(wait=False)
    assert taking.waiting["number"] == MANY


@pytest.mark.parametrize("gap", [1, 2])
def test_a_successor_is_told_of_all_that_was_done(gap: int) -> None:
    """Where numbers come with gaps, as after messages that were left out, of the newest thousand."""
    progress = Progress()
    for number in range(0, gap * MANY, gap):
        progress.note(
            Step("splitter", 0, 0, number, "on_total", (("number", f"counter.number#{number}"),), (), 1, 0, 0, 0)
        )
    taking = intake("splitter", progress)
    last = gap * (MANY - 1)
    for number in (*((0,) if gap == 1 else ()), last - gap * 900, last, last + gap):
        taking.came("number", packet(Number(value=number), f"counter.number#{number}"))
    taking.take(wait=False)
    assert taking.waiting["number"] == 1
