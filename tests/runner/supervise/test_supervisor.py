"""What the supervisor does at the end, also while one of its links stands still."""

import errno
import os
import re
import signal
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from runner.contract import Refused, Restarted
from runner.graph.ports import port_name
from runner.graph.reading import load_graph
from runner.message.codec import Step
from runner.message.packet import Process
from runner.supervise.calls import CallQuestion, CallRequest, Calls
from runner.supervise.child import Child
from runner.supervise.registry import runs
from runner.supervise.supervisor import Supervisor
from runner.terminal import Terminal
from tests.runner.common.runs import ACCOUNT, TOYS


def supervisor_of(file: Path, folder: Path, *settings: str) -> Any:
    forks = cast("Any", SimpleNamespace(close=lambda: None))
    graph = load_graph(file, settings)
    return Supervisor(graph, file=file, recordings=folder, settings=(), terminal=Terminal(), forks=forks)


def test_a_run_that_is_refused_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "file").touch()
    with pytest.raises(Refused, match=r"file/account-.*: Not a directory"):
        supervisor_of(ACCOUNT, tmp_path / "file")
    assert [path.name for path in (tmp_path / "runner").iterdir()] == ["naming"]


def test_a_process_that_cannot_be_started_ends_the_graph_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    supervisor = supervisor_of(ACCOUNT, tmp_path)

    def start(*_: object, log: Path, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(log))

    supervisor._guardian._launch._forks.start = start
    end = supervisor.run()
    reason = rf"recorder cannot be started: .* No space left on device: '{tmp_path}/.*/log/recorder-0.txt'"
    assert end.code == 2
    assert re.fullmatch(reason, end.reason)
    assert supervisor.id not in [entry.run for entry in runs()]


def test_why_a_process_ended_that_had_no_room_to_say_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "log").touch()
    child = Child(Process("recorder", 0), cast("Any", SimpleNamespace(returncode=2)), tmp_path / "log")
    assert child.reason() == "ended with exit code 2"
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=0))
    assert child.reason() == f"ended with exit code 2: the disk of {tmp_path / 'log'} is full"


def test_a_call_that_ends_the_graph_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("runner.supervise.calls.PATIENCE_SECONDS", 0)
    supervisor, id = supervisor_of(ACCOUNT, tmp_path), "supervisor.account_add#0"
    calls = supervisor._calls = Calls(load_graph(ACCOUNT), lambda port, command, say: say(id) or id)
    calls.call(CallRequest("account", "add", {"amount": "1"}))

    def end() -> None:
        assert not calls.progress(CallQuestion(id, 0)).done
        calls.note_step(Step("account", 0, 0, 0, "on_add", (("add", id),), ("account.sum#0",), 1, 0, 0, 0))

    supervisor._guardian.end = end
    supervisor._stop()
    assert calls.progress(CallQuestion(id, 0)).emitted == ("account.sum#0",)


def test_a_device_that_is_asked_to_restart_is_not_killed_in_its_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("runner.supervise.guardian.RETIRE_SECONDS", -1)
    supervisor, process, signals = supervisor_of(ACCOUNT, tmp_path), Process("counter", 0), list[int]()
    guardian = supervisor._guardian
    handle: Any = SimpleNamespace(poll=lambda: None, returncode=None, send_signal=signals.append)
    guardian._children["counter", 0], guardian._ready[process] = Child(process, handle, tmp_path / "log"), 0.1
    (tmp_path / "log").touch()
    with pytest.raises(Refused, match=r"^counter is a device, whose step is not cut off"):
        guardian.restart("counter", lambda: False)
    guardian._check(guardian._children["counter", 0])
    assert signals == [signal.SIGUSR1]
    handle.poll, handle.returncode = (lambda: -signal.SIGKILL), -signal.SIGKILL
    end = guardian._replace(guardian._children["counter", 0])
    assert end.reason == "counter failed after 0 restarts: killed by SIGKILL"
    guardian._children.clear()
    supervisor._stop()


def test_the_end_does_not_wait_for_a_step_that_cannot_be_sent(tmp_path: Path):
    supervisor = supervisor_of(TOYS, tmp_path, f"sink.path={tmp_path / 'out.txt'}")
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
