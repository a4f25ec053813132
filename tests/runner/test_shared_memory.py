"""Large messages between processes: the same bytes to everybody, and nothing left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import zenoh

from runner import shared_memory
from runner.bus import Bus, free_endpoint
from runner.shared_memory import FROM_BYTES, YOUNG_SECONDS, SharedMemory, sweep
from tests.runner.waiting import wait_until

SHARED = Path("/dev/shm")
LEAVE = """
import os, signal, zenoh
from runner.shared_memory import SharedMemory
held = SharedMemory().place((b"x" * 1_000_000,))
print(held is not None, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_parts_lie_one_after_the_other():
    memory = SharedMemory()
    placed = memory.place((b"head", b"b" * FROM_BYTES))
    assert placed is not None
    assert placed.to_bytes() == b"head" + b"b" * FROM_BYTES


def test_what_finds_no_room_travels_otherwise(monkeypatch):
    monkeypatch.setattr(shared_memory, "FREE_SHARE", 2**60)
    assert SharedMemory().place((b"b" * FROM_BYTES,)) is None
    bus = Bus("alone")
    try:
        assert bus.load(b"head", b"b" * FROM_BYTES) == b"head" + b"b" * FROM_BYTES
    finally:
        bus.close()


def test_one_payload_reaches_several_keys_unchanged():
    endpoint, heard = free_endpoint(), []
    here = Bus("shared", listen=endpoint)
    there = Bus("shared", connect=endpoint)
    try:
        for path in ("m/a/b", "d/c/0/b"):
            there.subscribe(path, lambda packet: heard.append((packet.key, packet.payload)))
        body = os.urandom(3_000_000)
        payload = here.load(b"head", body)
        assert isinstance(payload, zenoh.ZBytes)
        wait_until(lambda: _published(here, payload) and len(heard) >= 2)
        assert {key for key, _ in heard} == {"m/a/b", "d/c/0/b"}
        assert all(received == b"head" + body for _, received in heard)
    finally:
        there.close()
        here.close()


def _published(bus: Bus, payload: zenoh.ZBytes) -> bool:
    """Publishes again until the other side has declared its subscriptions."""
    for path in ("m/a/b", "d/c/0/b"):
        bus.publish(path, payload)
    time.sleep(0.1)
    return True


def test_what_a_killed_process_left_is_swept():
    before = set(SHARED.glob("*.zenoh"))
    done = subprocess.run([sys.executable, "-c", LEAVE], capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == ("True\n", -signal.SIGKILL)
    assert set(SHARED.glob("*.zenoh")) - before
    time.sleep(YOUNG_SECONDS + 0.1)
    sweep()
    assert not set(SHARED.glob("*.zenoh")) - before
