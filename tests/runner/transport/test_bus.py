"""A process on its way into its run, and out of it."""

import contextlib
import socket
import threading
from typing import Any

import pytest

from runner.transport import session
from runner.transport.bus import Bus
from runner.transport.session import Gateway, new_endpoint


@pytest.mark.parametrize("known", [False, True])
def test_what_is_being_sent_while_the_bus_closes_is_dropped(known: bool):
    bus = Bus("test", new_endpoint(), listen=True)
    if known:
        bus.publish("x/a", b"")
    sends, closed = threading.Event(), threading.Event()

    class Slow(dict[str, Any]):
        """Where a publisher looks for its way out."""

        def get(self, path: str, default: Any = None) -> Any:
            sends.set()
            closed.wait(10)
            return super().get(path, default)

    bus._publishers = Slow(bus._publishers)  # pyright: ignore
    raised: list[Exception] = []

    def send() -> None:
        try:
            bus.publish("x/a", b"")
        except Exception as error:
            raised.append(error)

    sender = threading.Thread(target=send)
    sender.start()
    assert sends.wait(10)
    bus.close()
    closed.set()
    sender.join(10)
    assert raised == []


def test_who_overhears_waits_for_a_gateway_that_does_not_take_the_call_at_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(session, "CALL_MS", 100)
    meeting, gateways = new_endpoint(), list[Gateway]()
    endpoint = new_endpoint(meeting)
    bus = Bus("test", meeting, gateway=endpoint, listen=True)
    late = threading.Timer(1, lambda: gateways.append(Gateway(endpoint, meeting, None, None)))
    late.start()
    bus.overhear("m/a/*", lambda _: None)
    late.join()
    bus.close()
    gateways[0].close()


@pytest.mark.slow
def test_who_calls_a_process_that_stands_still_waits_for_longer_than_zenoh_would():
    endpoint = new_endpoint()
    with socket.socket(socket.AF_UNIX) as still:
        still.bind(endpoint.partition("/")[2])
        still.listen()
        bus = Bus("test", endpoint)
        call, _ = still.accept()
        call.settimeout(12)
        with call, contextlib.suppress(TimeoutError):
            while call.recv(4096):
                pass
            pytest.fail("the call was given up")
    bus.close()
