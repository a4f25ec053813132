"""Joins and gathers depend on lineage alone, never on the order of arrival."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from runner.contract import Message
from runner.graph.graph import Node
from runner.graph.reading import load_graph
from runner.message import codec
from runner.process.inbox import Inbox, Mismatched
from runner.process.step import Arrival, receive
from tests.runner.common.runs import TOYS
from tests.runner.common.toys import Answer, Number, Piece


def node(name: str, *settings: str) -> Node:
    return load_graph(TOYS, ("sink.path=out", *settings)).nodes[name]


def arrival(node: Node, port: str, message: Message, id: str, lineage: str) -> Arrival:
    envelope = codec.envelope(message, id=id, lineage=lineage, time_ns=0, causes=())
    return receive(node.type.inputs[port], envelope)


def answer(gatherer: Node, index: int, *, lineage: int = 0, count: int = 3) -> Arrival:
    message = Answer(index=index, count=count, samples=np.zeros(1))
    return arrival(gatherer, "answers", message, f"worker.answer#{lineage * 10 + index}", f"counter.number#{lineage}")


def number(consumer: Node, lineage: int = 0) -> Arrival:
    return arrival(consumer, "number", Number(value=lineage), f"counter.number#{lineage}", f"counter.number#{lineage}")


def piece(worker: Node, index: int, lineage: int = 0) -> Arrival:
    message = Piece(index=index, count=4, value=lineage)
    return arrival(worker, "piece", message, f"splitter.piece#{lineage * 4 + index}", f"counter.number#{lineage}")


def steps(inbox: Inbox) -> list[list[str]]:
    ready = iter(inbox.pop, None)
    return [[arrival.envelope.id for arrival in step.arrivals] for step in ready]


@pytest.mark.parametrize("order", list(itertools.permutations(range(4))))
def test_a_gather_is_sorted_whatever_the_order_of_arrival(order: tuple[int, ...]):
    gatherer = node("gatherer")
    arrivals = [answer(gatherer, 0), answer(gatherer, 1), answer(gatherer, 2), number(gatherer)]
    inbox = Inbox(gatherer)
    for position in order:
        assert not inbox.has_ready
        inbox.add(arrivals[position])
    assert steps(inbox) == [["worker.answer#0", "worker.answer#1", "worker.answer#2", "counter.number#0"]]


def test_lineages_do_not_mix():
    gatherer = node("gatherer")
    inbox = Inbox(gatherer)
    for index in range(3):
        inbox.add(answer(gatherer, index, lineage=index))
        inbox.add(number(gatherer, index))
    assert not inbox.has_ready
    assert [lacking for _, _, lacking in inbox.incomplete()] == [["answers"]] * 3


def test_gathers_keep_the_order_in_which_their_lineages_began():
    gatherer = node("gatherer")
    inbox = Inbox(gatherer)
    for lineage in range(3):
        inbox.add(number(gatherer, lineage))
    for lineage in (2, 1):
        inbox.add(answer(gatherer, 0, lineage=lineage, count=1))
        assert not inbox.has_ready
    inbox.add(answer(gatherer, 0, lineage=0, count=1))
    assert [step[-1] for step in steps(inbox)] == [f"counter.number#{lineage}" for lineage in range(3)]


@pytest.mark.parametrize("number_at", range(3))
def test_every_part_is_joined_with_what_its_lineage_shares(number_at: int):
    worker = node("worker")
    arrivals = [piece(worker, 0), piece(worker, 1)]
    arrivals.insert(number_at, number(worker))
    inbox = Inbox(worker)
    for one in arrivals:
        inbox.add(one)
    assert steps(inbox) == [["splitter.piece#0", "counter.number#0"], ["splitter.piece#1", "counter.number#0"]]


def test_what_parts_share_is_forgotten_oldest_first():
    worker = node("worker")
    limit = 2 * max(edge.queue for edge in worker.inputs.values())
    inbox = Inbox(worker)
    for lineage in range(limit + 1):
        inbox.add(number(worker, lineage))
    inbox.add(piece(worker, 0, lineage=0))
    assert not inbox.has_ready
    inbox.add(piece(worker, 0, lineage=limit))
    assert len(steps(inbox)) == 1


@pytest.mark.parametrize(
    ("index", "count", "reason"), [(0, 3, "index 0 again"), (1, 4, "one of 4, but"), (3, 3, "index 3 of 3")]
)
def test_parts_that_contradict_each_other_are_refused(index: int, count: int, reason: str):
    gatherer = node("gatherer")
    inbox = Inbox(gatherer)
    inbox.add(answer(gatherer, 0))
    with pytest.raises(Mismatched, match=reason):
        inbox.add(answer(gatherer, index, count=count))
    assert not inbox.has_ready


def test_an_edge_of_policy_latest_keeps_the_newest(tmp_path: Path):
    path = tmp_path / "graph.yaml"
    path.write_text(
        TOYS.read_text().replace("{number: counter.number}", "{number: {from: counter.number, policy: latest}}", 1)
    )
    splitter = load_graph(path, ("sink.path=out",)).nodes["splitter"]
    inbox = Inbox(splitter)
    for lineage in range(3):
        inbox.add(number(splitter, lineage))
    assert steps(inbox) == [["counter.number#2"]]
    assert not any(inbox.waiting.values())
