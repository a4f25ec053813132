"""What a process says while it leaves its run."""

import threading
from typing import Any

import pytest

from runner.transport.bus import Bus
from runner.transport.session import new_endpoint


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
