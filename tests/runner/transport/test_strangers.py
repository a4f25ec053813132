"""Who may listen to a run, and speak: everybody hears everything where the graph says so, and forges nothing."""

import contextlib
import json
import os
import pwd
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from runner.cli.main import main
from runner.graph.reading import load_graph
from runner.hosts.head import control
from runner.message.codec import pack
from runner.recording.recording import Recording
from runner.testing import read_until
from runner.transport.session import private
from tests.runner.common.machines import Party, on_loopback
from tests.runner.common.runs import ACCOUNT, ALBUM, TOYS, changed, finish, meeting_of, start
from tests.runner.common.waiting import wait_until
from tests.runner.transport.test_bad_input import public_address, run_of, stranger

EXAMPLE = Path(__file__).parents[3] / "examples" / "listen.py"


def test_a_stranger_hears_every_recorded_message_once_and_byte_for_byte(tmp_path: Path):
    address = public_address()
    graph = changed(TOYS, tmp_path, Counter="GatedCounter")
    settings = (f"counter.go={tmp_path / 'go'}", "counter.count=50", "counter.waits=0")
    process = start(graph, tmp_path, f"listen={address}", *settings)
    heard: list[tuple[str, bytes]] = []
    before = read_until(process, "run toys-")
    with stranger(address) as session:
        session.declare_subscriber(
            f"{run_of(before)}/**", lambda sample: heard.append((str(sample.key_expr), sample.payload.to_bytes()))
        )
        before += read_until(process, "processes are ready")
        graph_read = load_graph(graph, ("sink.path=x", *settings))
        processes = {f"{stage}/{replica}" for stage, replica in graph_read.processes()}
        wait_until(lambda: processes <= {key.partition("/h/")[2] for key, _ in heard})  # whose pulse comes knows us
        (tmp_path / "go").touch()
        ended = finish(process, tmp_path, before)
        recording = Recording(ended.recording)
        expected = {pack(one) for one in (*recording.envelopes(), *recording.steps)}
        wait_until(lambda: expected <= {payload for _, payload in heard})
    assert ended.code == 0, ended.output
    assert recording.verdict.complete
    messages = [(key.partition("/m/")[2], payload) for key, payload in heard if "/m/" in key]
    recorded = [(recording.messages[envelope.id].topic, pack(envelope)) for envelope in recording.envelopes()]
    assert len(recorded) == 50 * 10 + 1
    assert Counter(messages) == Counter(recorded)
    steps = Counter(payload for key, payload in heard if "/s/" in key)
    assert {pack(step): 1 for step in recording.steps}.items() <= steps.items()


@contextlib.contextmanager
def listening(address: str, run: str, graph: Path, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """The example, in a process of its own, with the schemas that ``runner schema`` prints."""
    schemas = folder / "schemas.json"
    with schemas.open("w") as file:
        described = [sys.executable, "-m", "runner.cli", "schema", str(graph), "--set", "sink.path=out"]
        subprocess.run(described, stdout=file, check=True)
    command = [sys.executable, str(EXAMPLE), address, run, str(schemas)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "listening\n"
        try:
            yield process
        finally:
            process.kill()


def test_a_stranger_that_stands_still_costs_nothing_and_one_that_does_not_still_hears(tmp_path: Path):
    """The next picture is sent when one of them has the last: who is slower than that may lose some, as docs say."""
    address, taken = public_address(), tmp_path / "taken"
    taken.touch()
    process = start(ALBUM, tmp_path, f"listen={address}", f"camera.go={tmp_path / 'go'}", f"camera.taken={taken}")
    before = read_until(process, "processes are ready")
    with (
        listening(address, run_of(before), ALBUM, tmp_path) as stopped,
        stranger(address) as session,
        taken.open("ab", 0) as heard,
    ):
        pulses: list[str] = []
        session.declare_subscriber(f"{run_of(before)}/m/camera/*", lambda _: heard.write(b"."))
        session.declare_subscriber(f"{run_of(before)}/h/camera/*", lambda pulse: pulses.append(str(pulse.key_expr)))
        wait_until(lambda: pulses)  # the camera knows of both
        os.kill(stopped.pid, signal.SIGSTOP)
        time.sleep(1)
        (tmp_path / "go").touch()
        ended = finish(process, tmp_path, before)
        wait_until(lambda: taken.stat().st_size == 60)
    assert (ended.code, len(ended.result)) == (0, 60), ended.output
    assert Recording(ended.recording).verdict.complete


def test_what_the_supervisor_says_is_described_too(capsys: pytest.CaptureFixture[str]):
    assert main(["schema", str(ACCOUNT)]) == 0
    topics = json.loads(capsys.readouterr().out)
    assert {"counter/number", "supervisor/account_add", "supervisor/restarted"} <= set(topics)


def test_the_example_shows_what_flows(tmp_path: Path):
    address = public_address()
    process = start(TOYS, tmp_path, f"listen={address}", "counter.count=100000", "counter.period=0.02")
    before = read_until(process, "processes are ready")
    with listening(address, run_of(before), TOYS, tmp_path) as listener:
        assert listener.stdout is not None
        shown = [listener.stdout.readline() for _ in range(50)]
    process.terminate()
    finish(process, tmp_path, before)
    assert any(
        re.fullmatch(r"splitter\.piece#\d+ Piece {'index': \d, 'count': 4, 'value': \d+}\n", one) for one in shown
    )


def test_the_example_shows_arrays(tmp_path: Path):
    address = public_address()
    process = start(ALBUM, tmp_path, f"listen={address}", "camera.size=3", "camera.count=100000")
    before = read_until(process, "processes are ready")
    with listening(address, run_of(before), ALBUM, tmp_path) as listener:
        assert listener.stdout is not None
        first = listener.stdout.readline()
    process.terminate()
    finish(process, tmp_path, before)
    heard, shown = first.split(" ", 1)
    # The first that was sent once the gateway knew of the listener.
    k = int(heard.removeprefix("camera.picture#")) % 256
    assert shown == f"Picture {{'pixels': array([{k}, {k}, {k}], dtype=uint8), 'last': False}}\n"


INTRUDER = """
import json, os, sys, zenoh
os.setuid(int(sys.argv[1]))
endpoint, run, patience_ms = sys.argv[2:]
config = zenoh.Config.from_json5(json.dumps(
    {"mode": "client", "connect": {"endpoints": [endpoint], "timeout_ms": int(patience_ms), "exit_on_failure": True}}
))
try:
    with zenoh.open(config) as session:
        session.put(f"{run}/m/sink/finished", b"nonsense")
        print("in")
except zenoh.ZError:
    print("out")
"""


def comes_in(endpoint: str, run: str, user: int) -> bool:
    """Whether a process of some user can call at an endpoint."""
    patience_ms = 30_000 if user == os.getuid() else 2_000
    command = [sys.executable, "-c", INTRUDER, str(user), endpoint, run, str(patience_ms)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return {"in": True, "out": False}[done.stdout.strip()]


@pytest.fixture
def other_user() -> int:
    if os.getuid() != 0:
        pytest.skip("needs the right to become another user")
    return pwd.getpwnam("nobody").pw_uid


def test_another_user_of_the_machine_comes_in_nowhere(tmp_path: Path, other_user: int):
    graph = changed(TOYS, tmp_path, Counter="GatedCounter")
    process = start(graph, tmp_path, f"counter.go={tmp_path / 'go'}")
    before = read_until(process, "processes are ready")
    gateway = before.partition(" on ")[2].split()[0]
    endpoints = (gateway, meeting_of(gateway))
    assert [comes_in(endpoint, run_of(before), os.getuid()) for endpoint in endpoints] == [True, True]
    assert [comes_in(endpoint, run_of(before), other_user) for endpoint in endpoints] == [False, False]
    (tmp_path / "go").touch()
    ended = finish(process, tmp_path, before)
    assert ended.code == 0, ended.output


@pytest.mark.slow
def test_another_user_of_the_machine_has_no_agent_start_anything(tmp_path: Path, other_user: int):
    """Hosts without keys, all on loopback, meet where the head's address is written: at a socket of their user."""
    machines = on_loopback()
    party = Party(machines, tmp_path).start_all("counter.count=100", "counter.period=0.1")
    try:
        before = read_until(party.hosts["head"], "processes are ready")
        address = f"tcp/{machines.addresses['head']}"
        assert comes_in(private(address), control("hosts"), os.getuid())
        assert not comes_in(private(address), control("hosts"), other_user)
        assert not comes_in(address, control("hosts"), os.getuid())
        assert party.end("head", before).code == 0
    finally:
        party.close()
