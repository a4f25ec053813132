"""A publisher waits when it must, deals parts to replicas and hands those of the dead to the living."""

import subprocess
import sys
import threading
import time
from typing import Any

import msgspec
import pytest

from runner.graph.graph import Route
from runner.message.codec import Deal, Envelope, unpack
from runner.message.packet import Process
from runner.process.delivery import PREFETCH, Delivery, Stopped
from tests.runner.common.waiting import wait_until


class Wire:
    """Records what is sent, and what is dealt as (replica, id)."""

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.dealt: list[tuple[int, str]] = []
        self.stopping = threading.Event()
        self.standing_still = threading.Lock()

    def publish(self, key: str, payload: bytes) -> None:
        match key.split("/"):
            case ["m", "counter", "number"]:
                self.sent.append(payload.decode())
            case ["d", "worker", replica, "input"]:
                with self.standing_still:
                    self.dealt.append((int(replica), unpack(Deal, payload).id))
            case _:
                raise AssertionError(key)

    def take(self, count: int) -> list[tuple[int, str]]:
        """Waits for what is dealt: that many, and no more."""
        wait_until(lambda: len(self.dealt) >= count)
        time.sleep(0.02)
        dealt, self.dealt = self.dealt, []
        return dealt


def make(**changes: Any) -> tuple[Delivery, Wire]:
    route = Route("number", "worker", "input", "block", queue=4, shared=False, kept=0)
    wire = Wire()
    routes = [msgspec.structs.replace(route, **changes)]
    stopping = wire.stopping.is_set
    return Delivery("counter", routes, wire.publish, lambda _: None, stopping=stopping), wire


def unanswered(delivery: Delivery) -> list[int]:
    return [len(edge.unanswered) for edge in delivery._edges]  # pyright: ignore


def publish(delivery: Delivery, wire: Wire, number: int, lineage: int | None = None) -> str:
    own = f"counter.number#{number}"
    root = own if lineage is None else f"counter.number#{lineage}"
    cover = Envelope(own, root, 0, "Number", 1, (), msgspec.Raw(b""))
    delivery.publish("number", cover, own.encode())
    return own


def test_every_message_is_sent_once_whoever_is_there():
    delivery, wire = make()
    ids = [publish(delivery, wire, number) for number in range(3)]
    delivery.appeared(Process("worker", 0))
    delivery.lost(Process("worker", 0))
    delivery.appeared(Process("worker", 0, 1))
    assert wire.sent == ids
    assert wire.dealt == []


def test_parts_are_shared_and_each_replica_holds_few():
    delivery, wire = make(shared=True)
    for replica in (0, 1):
        delivery.appeared(Process("worker", replica))
    ids = [publish(delivery, wire, number, lineage=0) for number in range(6)]
    assert [replica for replica, _ in wire.take(4)] == [0, 1] * PREFETCH
    delivery.answered("worker", 0, [("input", ids[1])])
    assert wire.take(1) == [(1, ids[4])]


def test_parts_wait_until_there_is_a_replica():
    delivery, wire = make(shared=True)
    first = publish(delivery, wire, 0)
    assert (wire.sent, wire.take(0)) == ([first], [])
    delivery.appeared(Process("worker", 1))
    assert wire.take(1) == [(1, first)]


def test_parts_of_a_dead_replica_go_to_a_live_one():
    delivery, wire = make(shared=True)
    for replica in (0, 1):
        delivery.appeared(Process("worker", replica))
    first, second = publish(delivery, wire, 0), publish(delivery, wire, 1)
    assert wire.take(2) == [(0, first), (1, second)]
    delivery.lost(Process("worker", 0))
    assert wire.take(1) == [(1, first)]


def test_a_death_that_is_heard_of_late_takes_nothing_from_the_successor():
    delivery, wire = make(shared=True)
    delivery.appeared(Process("worker", 0))
    first = publish(delivery, wire, 0)
    assert wire.take(1) == [(0, first)]
    delivery.appeared(Process("worker", 0, 1))
    delivery.lost(Process("worker", 0, 0))
    assert wire.take(1) == [(0, first)]


def test_a_successor_deals_what_its_predecessor_has_sent():
    delivery, wire = make(shared=True)
    delivery.take_over([("worker", "input", "counter.number#7")])
    delivery.appeared(Process("worker", 0))
    assert wire.take(1) == [(0, "counter.number#7")]


def test_a_full_queue_blocks_until_an_acknowledgement():
    delivery, wire = make(queue=2)
    ids = [publish(delivery, wire, number) for number in range(2)]
    late = threading.Thread(target=publish, args=(delivery, wire, 2))
    late.start()
    late.join(0.2)
    assert late.is_alive()
    delivery.answered("worker", 0, [("input", ids[0])])
    late.join(5.0)
    assert not late.is_alive()
    assert len(wire.sent) == 3


@pytest.mark.parametrize(("kept", "after_one", "after_both"), [(0, 1, 0), (8, 0, 0)])
def test_what_every_replica_hears_is_awaited_from_each_unless_it_is_kept(kept: int, after_one: int, after_both: int):
    """What is kept is put aside late by one that gets none of its parts."""
    delivery, wire = make(replicas=2, kept=kept)
    id = publish(delivery, wire, 0)
    delivery.answered("worker", 1, [("input", id)])
    delivery.lost(Process("worker", 0))
    assert unanswered(delivery) == [after_one]
    delivery.answered("worker", 0, [("input", id)])
    assert unanswered(delivery) == [after_both]


def test_a_queue_is_counted_in_lineages_so_that_a_gather_cannot_starve():
    delivery, wire = make(queue=1)
    for number in range(20):
        publish(delivery, wire, number, lineage=0)


def test_a_lineage_counts_until_its_last_message_is_answered_however_often_it_was_sent():
    delivery, wire = make(queue=1)
    ids = [publish(delivery, wire, number, lineage=0) for number in (0, 0, 1)]
    for id in ids[1:]:
        assert not delivery._edges[0].has_room("another")  # pyright: ignore
        delivery.answered("worker", 0, [("input", id)])
    assert delivery._edges[0].has_room("another")  # pyright: ignore


def test_stopping_frees_a_blocked_publisher():
    delivery, wire = make(queue=1)
    publish(delivery, wire, 0)
    threading.Timer(0.1, wire.stopping.set).start()
    with pytest.raises(Stopped):
        publish(delivery, wire, 1)
    assert len(wire.sent) == 2


def test_an_edge_of_policy_latest_never_blocks():
    delivery, wire = make(policy="latest", queue=1)
    ids = [publish(delivery, wire, number) for number in range(50)]
    assert wire.sent == ids
    assert unanswered(delivery) == [0]


def test_a_consumer_that_stands_still_holds_up_no_acknowledgement_of_others():
    """All acknowledgements come on one thread."""
    wire = Wire()
    shared = Route("number", "worker", "input", "block", queue=50, shared=True, kept=0)
    alone = Route("number", "printer", "input", "block", queue=50, shared=False, kept=0)
    delivery = Delivery("counter", [shared, alone], wire.publish, lambda _: None, stopping=wire.stopping.is_set)
    ids = [publish(delivery, wire, number) for number in range(2)]

    def hear() -> None:
        delivery.appeared(Process("worker", 0))
        delivery.answered("printer", 0, [("input", ids[0])])
        delivery.lost(Process("worker", 1))
        delivery.answered("printer", 0, [("input", ids[1])])

    with wire.standing_still:
        caller = threading.Thread(target=hear)
        caller.start()
        caller.join(5)
        assert not caller.is_alive()
        assert unanswered(delivery) == [2, 0]
        assert publish(delivery, wire, 2) == wire.sent[-1]
    assert wire.take(2) == [(0, ids[0]), (0, ids[1])]


FAILS = """
import time
from runner.graph.graph import Route
from runner.message.packet import Process
from runner.process.delivery import Delivery

def publish(key, payload):
    raise MemoryError("no room to deal")

route = Route("number", "worker", "input", "block", queue=4, shared=True, kept=0)
delivery = Delivery("counter", [route], publish, print, stopping=bool)
delivery.take_over([("worker", "input", "counter.number#0")])
delivery.appeared(Process("worker", 0))
time.sleep(60)
"""


def test_a_process_that_can_deal_no_more_ends_and_says_why():
    ended = subprocess.run([sys.executable, "-c", FAILS], check=False, capture_output=True, text=True, timeout=50)
    assert (ended.returncode, ended.stderr.splitlines()[-1]) == (1, "MemoryError: no room to deal")
