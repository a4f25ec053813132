"""A publisher keeps what is not acknowledged, hands parts of the dead to the living and waits when it must."""

import threading
from typing import Any

import msgspec
import pytest

from runner.graph.graph import Route
from runner.message.codec import Envelope
from runner.message.packet import Process
from runner.process.delivery import PREFETCH, Delivery, Payload, Stopped
from tests.runner.waiting import wait_until


class Wire:
    """Records what is sent, as (replica, id)."""

    def __init__(self, *, near: bool = False) -> None:
        self._near = near
        self.sent: list[tuple[int, str]] = []
        self.stopping = threading.Event()
        self.standing_still = threading.Lock()
        self.sending = ""

    def send(self, to: tuple[str, int], key: str, payload: Payload) -> bool:
        assert isinstance(payload, bytes) and key == f"d/{to[0]}/{to[1]}/input"
        self.sending = payload.decode()
        with self.standing_still:
            self.sent.append((to[1], payload.decode()))
        return self._near

    def take(self) -> list[tuple[int, str]]:
        sent, self.sent = self.sent, []
        return sent


def make(*, near: bool = False, **changes: Any) -> tuple[Delivery, Wire]:
    route = Route("number", "worker", "input", "block", queue=4, shared=False, kept=0)
    wire = Wire(near=near)
    routes = [msgspec.structs.replace(route, **changes)]
    return Delivery(routes, wire.send, lambda _: None, wire.stopping.is_set), wire


def publish(delivery: Delivery, number: int, lineage: int | None = None) -> str:
    own = f"counter.number#{number}"
    root = own if lineage is None else f"counter.number#{lineage}"
    delivery.publish("number", Envelope(own, root, 0, "Number", 1, (), msgspec.Raw(b"")), own.encode())
    return own


def test_what_is_sent_before_the_consumer_is_there_waits_for_it():
    delivery, wire = make()
    ids = [publish(delivery, number) for number in range(3)]
    assert wire.take() == []
    delivery.update(Process("worker", 0), True)
    assert wire.take() == [(0, own) for own in ids]


def test_a_restarted_consumer_gets_what_it_has_not_acknowledged():
    delivery, wire = make()
    delivery.update(Process("worker", 0), True)
    first, second = publish(delivery, 0), publish(delivery, 1)
    delivery.acknowledge("worker", [("input", first)])
    wire.take()
    delivery.update(Process("worker", 0), False)
    third = publish(delivery, 2)
    delivery.update(Process("worker", 0, 1), True)
    assert wire.take() == [(0, second), (0, third)]


def test_what_joins_share_is_sent_again_though_acknowledged():
    delivery, wire = make(kept=4)
    first = publish(delivery, 0)
    delivery.acknowledge("worker", [("input", first)])
    delivery.update(Process("worker", 1), True)
    assert wire.take() == [(1, first)]


def test_parts_are_shared_and_each_replica_holds_few():
    delivery, wire = make(shared=True)
    for replica in (0, 1):
        delivery.update(Process("worker", replica), True)
    ids = [publish(delivery, number, lineage=0) for number in range(6)]
    sent = wire.take()
    assert [replica for replica, _ in sent] == [0, 1] * PREFETCH
    delivery.acknowledge("worker", [("input", ids[1])])
    assert wire.take() == [(1, ids[4])]


def test_parts_of_a_dead_replica_go_to_a_live_one():
    delivery, wire = make(shared=True)
    for replica in (0, 1):
        delivery.update(Process("worker", replica), True)
    first, second = publish(delivery, 0), publish(delivery, 1)
    assert wire.take() == [(0, first), (1, second)]
    delivery.update(Process("worker", 0), False)
    assert wire.take() == [(1, first)]


def test_a_full_queue_blocks_until_an_acknowledgement():
    delivery, wire = make(queue=2)
    delivery.update(Process("worker", 0), True)
    ids = [publish(delivery, number) for number in range(2)]
    late = threading.Thread(target=publish, args=(delivery, 2))
    late.start()
    late.join(0.2)
    assert late.is_alive()
    delivery.acknowledge("worker", [("input", ids[0])])
    late.join(5.0)
    assert not late.is_alive()
    assert len(wire.take()) == 3


def test_a_queue_is_counted_in_lineages_so_that_a_gather_cannot_starve():
    delivery, _ = make(queue=1)
    for number in range(20):
        publish(delivery, number, lineage=0)


def test_stopping_frees_a_blocked_publisher():
    delivery, wire = make(queue=1)
    publish(delivery, 0)
    threading.Timer(0.1, wire.stopping.set).start()
    with pytest.raises(Stopped):
        publish(delivery, 1)


def test_an_edge_of_policy_latest_never_blocks_and_keeps_the_newest():
    delivery, wire = make(policy="latest", queue=1)
    ids = [publish(delivery, number) for number in range(5)]
    delivery.update(Process("worker", 0), True)
    wait_until(lambda: len(wire.sent) > 0)
    assert wire.take() == [(0, ids[-1])]


def test_a_consumer_of_policy_latest_that_stands_still_holds_nobody_up():
    delivery, wire = make(policy="latest", queue=1)
    delivery.update(Process("worker", 0), True)
    with wire.standing_still:
        first = publish(delivery, 0)
        wait_until(lambda: wire.sending == first)
        ids = [publish(delivery, number) for number in range(1, 100)]
    wait_until(lambda: len(wire.sent) == 2)
    assert wire.take() == [(0, first), (0, ids[-1])]


def test_a_step_is_journalled_once_its_messages_have_arrived():
    delivery, _ = make()
    journal: list[str] = []
    ids = [publish(delivery, number) for number in range(2)]
    delivery.after_arrival((ids[0],), lambda: journal.append("first"))
    delivery.after_arrival((ids[1],), lambda: journal.append("second"))
    delivery.after_arrival((), lambda: journal.append("third"))
    delivery.receive("worker", "input", ids[1])
    assert journal == []
    delivery.receive("worker", "input", ids[0])
    assert journal == ["first", "second", "third"]


def test_a_part_that_no_replica_has_is_not_safe_yet():
    delivery, _ = make(shared=True)
    journal: list[str] = []
    delivery.update(Process("worker", 0), True)
    first = publish(delivery, 0)
    delivery.receive("worker", "input", first)
    delivery.update(Process("worker", 0), False)
    delivery.after_arrival((first,), lambda: journal.append("done"))
    assert journal == []
    delivery.close()
    assert journal == ["done"]
