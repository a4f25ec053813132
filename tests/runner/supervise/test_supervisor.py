"""What the supervisor does while one of its links stands still."""

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from runner.contract import Restarted
from runner.graph.ports import port_name
from runner.graph.reading import load_graph
from runner.supervise.supervisor import Supervisor
from runner.terminal import Terminal
from tests.runner.common.runs import TOYS


def test_the_end_does_not_wait_for_a_step_that_cannot_be_sent(tmp_path: Path):
    graph = load_graph(TOYS, (f"sink.path={tmp_path / 'out.txt'}",))
    forks = cast("Any", SimpleNamespace(close=lambda: None))
    supervisor: Any = Supervisor(graph, file=TOYS, recordings=tmp_path, settings=(), terminal=Terminal(), forks=forks)
    publish, sends, goes_on, ends = supervisor._bus.publish, *(threading.Event() for _ in range(3))

    def publish_slowly(path: str, *more: Any) -> None:
        if path == "s/supervisor":
            sends.set()
            goes_on.wait(60)
        publish(path, *more)

    supervisor._bus.publish, supervisor._guardian.end = publish_slowly, ends.set
    message = Restarted(stage="worker", replica=0, reason="killed")
    speaker = threading.Thread(target=supervisor._publish, args=(port_name(Restarted), message))
    speaker.start()
    assert sends.wait(10)
    stopper = threading.Thread(target=supervisor._stop)
    stopper.start()
    assert ends.wait(10)
    goes_on.set()
    speaker.join(10)
    stopper.join(30)
    assert not stopper.is_alive()
