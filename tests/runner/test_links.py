"""The straight way between two processes: in order, complete, whoever dies, and closed to strangers."""

import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from runner.message.packet import Packet, Process
from runner.transport.arena import Store
from runner.transport.links import INLINE_BYTES, Door, Link, address_of
from tests.runner.waiting import wait_until

SECRET = "secret"


class Consumer:
    """A door, what came through it and what was refused."""

    def __init__(self) -> None:
        self.address = address_of(f"test-{os.getpid()}", SECRET, "", Process("consumer", random.randrange(10**9)))
        self.packets: list[Packet] = []
        self.refused: list[str] = []
        self.links: list[Link] = []
        self.door = Door(
            self.address, SECRET, self.packets.append, lambda key, error: self.refused.append(f"{key}: {error}")
        )

    def link(self, store: Store, secret: str = SECRET) -> Link:
        self.links.append(Link(self.address, secret, f"publisher/{len(self.links)}/0", store))
        return self.links[-1]

    def close(self) -> None:
        self.door.close()
        for link in self.links:
            link.close()

    def take(self, count: int) -> list[Packet]:
        wait_until(lambda: self.door.look(wait=False) or len(self.packets) >= count)
        taken, self.packets[:] = self.packets[:], []
        return taken


@pytest.fixture
def consumer() -> Iterator[Consumer]:
    made = Consumer()
    yield made
    made.close()


def test_messages_of_all_sizes_arrive_in_order(consumer: Consumer):
    link = consumer.link(Store())
    sizes = [0, 1, INLINE_BYTES, INLINE_BYTES + 1, 10**6, 5, 10**7, 3]
    sent = [random.Random(size).randbytes(size) for size in sizes]
    assert all(link.send(f"d/consumer/0/port{number}", data) for number, data in enumerate(sent))
    taken = consumer.take(len(sent))
    assert [bytes(packet.payload) for packet in taken] == sent
    assert [packet.end for packet in taken] == [f"port{number}" for number in range(len(sent))]
    assert all(packet.near and packet.genuine and 0 < packet.sent_ns <= packet.arrived_ns for packet in taken)


def test_a_full_link_blocks_and_loses_nothing(consumer: Consumer):
    link, count = consumer.link(Store()), 3000
    sent = threading.Thread(
        target=lambda: [link.send("k", number.to_bytes(4, "big") * 500) for number in range(count)], daemon=True
    )
    sent.start()
    time.sleep(0.2)
    assert sent.is_alive()
    taken: list[Packet] = []
    while len(taken) < count:
        taken += consumer.take(1)
    assert [int.from_bytes(bytes(packet.payload[:4]), "big") for packet in taken] == list(range(count))
    sent.join(10)


def test_memory_comes_back_when_the_reader_lets_go(consumer: Consumer):
    store = Store()
    link = consumer.link(store)
    first = store.write([bytes(100_000)])
    place = first.place
    link.send("k", first)
    del first
    taken = consumer.take(1)
    assert link.collect() and store.write([bytes(100_000)]).place != place
    del taken
    assert link.collect() and store.write([bytes(100_000)]).place == place


def test_memory_comes_back_when_the_reader_is_gone():
    store, reader = Store(), Consumer()
    link = reader.link(store)
    place = store.write([bytes(100_000)]).place
    link.send("k", store.write([bytes(100_000)]))
    reader.door.close()
    assert not link.collect() and not link.send("k", b"nobody")
    assert store.write([bytes(100_000)]).place == place
    link.close()


PUBLISHER = """
import sys, time
from runner.transport.arena import Store
from runner.transport.links import Link
link = Link(bytes.fromhex(sys.argv[1]), "secret", "publisher/0/0", Store())
for number in range(40):
    link.send("k", number.to_bytes(4, "big") * (10 if number % 2 else 5000))
print("sent", flush=True)
time.sleep(60)
"""


def test_what_was_sent_arrives_from_a_publisher_that_was_killed(consumer: Consumer):
    """Also where it left unread what the reader gave back: the system then calls the link reset."""
    command = [sys.executable, "-c", PUBLISHER, consumer.address.hex()]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=Path.cwd()) as publisher:
        assert publisher.stdout is not None
        taken: list[Packet] = []
        taken += consumer.take(5)
        del taken[0]
        assert publisher.stdout.readline() == b"sent\n"
        publisher.send_signal(signal.SIGKILL)
        publisher.wait()
    held = len(taken)
    while held < 39:
        taken += consumer.take(1)
        held = len(taken)
    assert [int.from_bytes(bytes(packet.payload[:4]), "big") for packet in taken] == list(range(1, 40))
    wait_until(lambda: consumer.door.look(wait=False) or not consumer.door._guests)
    assert consumer.refused == []


def test_strangers_are_refused_named_and_let_go(consumer: Consumer):
    noise = random.Random(1)
    good = consumer.link(Store())
    good.send("k", b"before")
    wrong = consumer.link(Store(), "another secret")
    wrong.send("k", b"never")
    for length in (1, 5, 11, 12, 40, 9000, 20_000):
        stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        stranger.connect(consumer.address)
        stranger.send(noise.randbytes(length))
        stranger.close()
    good.send("k", b"after")
    assert [bytes(packet.payload) for packet in consumer.take(2)] == [b"before", b"after"]
    wait_until(lambda: consumer.door.look(wait=False) or len(consumer.refused) == 8)
    assert all("not sent by a process of this run" in one or "packet" in one for one in consumer.refused)
    assert not wrong.collect()


def test_a_place_that_is_not_there_is_refused(consumer: Consumer):
    """A faulty publisher that knows the secret."""
    link = consumer.link(Store())
    link._put(2, "k", b"\xff" * 20)
    wait_until(lambda: consumer.door.look(wait=False) or consumer.refused)
    assert consumer.refused[0].startswith("publisher/0/0: ") and "malformed packet" in consumer.refused[0]


def test_nobody_is_at_home():
    with pytest.raises(OSError):
        Link(b"\0runner/nobody", SECRET, "publisher/0/0", Store())
