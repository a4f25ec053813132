"""Whatever arrives on whatever key: refused, counted and named; nothing crashes and the graph answers the same."""

import contextlib
import json
import random
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh

from runner.graph.graph import Route, node_entry
from runner.graph.reading import load_graph
from runner.message.codec import CodecError, Deal, Envelope, Journal, LogLine, Lost, Pulse, Step, envelope, pack, unpack
from runner.message.packet import GATEWAY, RECORDER, Packet, Process
from runner.message.refusals import Refusals
from runner.process.children import last_lines, reason_in, spawn
from runner.process.stage_process import Assignment
from runner.recording.recording import Recording
from runner.recording.writer import Manifest
from runner.testing import read_until
from runner.transport.bus import Bus
from runner.transport.presence import Presence
from runner.transport.session import new_endpoint
from tests.runner.common.machines import free_address
from tests.runner.common.runs import ALBUM, TOYS, changed, finish, meeting_of, processes_of, run, start, wait_for_links
from tests.runner.common.survivors import Picture
from tests.runner.common.toys import Answer
from tests.runner.common.waiting import wait_until

MESSAGES = 10_000
KEYS = (
    *("m/counter/number", "m/worker/answer", "m/sink/finished", "m/nobody/nothing", "again/splitter/0/number"),
    *("again/worker/0/piece", "again/worker/1/number", "again/gatherer/0/answers", "again/gatherer/0/nothing"),
    *("s/splitter", "s/worker", "s/nobody", "j/splitter", "j/worker", "j/gatherer", "d/worker/0/piece", "d/worker/1/x"),
    *("l/worker", "l/supervisor", "l/recorder", "h/worker/0", "h/recorder/0", "h/nobody", "settled/worker/0/0"),
    *("x/worker", "x/sink", "e/counter/0/0", "e/worker/0/0", "e/x", "settled/x"),
)


class Mutator:
    """Makes bad payloads of good ones, always the same for one seed."""

    def __init__(self, good: list[bytes], seed: int) -> None:
        self._good = good
        self._random = random.Random(seed)
        self._ways: list[Callable[[bytearray], bytes]] = [
            self._noise, self._flip, self._flip, self._cut, self._extend, self._number, self._element, self._nest
        ]  # fmt: skip

    def __call__(self) -> bytes:
        return self._random.choice(self._ways)(bytearray(self._random.choice(self._good)))

    def _noise(self, _: bytearray) -> bytes:
        return self._random.randbytes(self._random.randrange(200))

    def _flip(self, payload: bytearray) -> bytes:
        for _ in range(self._random.randint(1, 4)):
            payload[self._random.randrange(len(payload))] = self._random.randrange(256)
        return bytes(payload)

    def _cut(self, payload: bytearray) -> bytes:
        return bytes(payload[: self._random.randrange(len(payload))])

    def _extend(self, payload: bytearray) -> bytes:
        return bytes(payload) + self._random.randbytes(self._random.randint(1, 50))

    def _number(self, payload: bytearray) -> bytes:
        """Another sequence number, or another version."""
        text = re.sub(rb"#(\d)", lambda _: b"#%d" % self._random.randrange(10), bytes(payload))
        return text.replace(b"version\x01", bytes([*b"version", self._random.randrange(2, 128)]))

    def _element(self, payload: bytearray) -> bytes:
        """Arrays of other elements, and NaN in them."""
        other = self._random.choice((b"object_", b"complex", b"float32", b"int64\0\0"))
        return bytes(payload).replace(b"float64", other).replace(b"\x3f", b"\xff")

    def _nest(self, _: bytearray) -> bytes:
        """Deep nesting, or a length that nothing follows."""
        return self._random.choice(
            (b"\x91" * self._random.randint(1, 20_000), b"\xc6\xff\xff\xff\xff", b"\xdf\x7f\xff\xff\xff")
        )


def payloads_of(path: Path) -> list[bytes]:
    """Every kind of payload that a run has sent."""
    recording = Recording(path)
    records: list[Any] = [*recording.envelopes(), *recording.steps, *recording.log]
    records += [Journal((step,)) for step in recording.steps]
    records += [Deal(id) for step in recording.steps for _, id in step.consumed]
    records += [Lost(step.stage, step.replica, step.incarnation, "killed", 5) for step in recording.steps]
    records += [Pulse(step.stage, step.replica, 0) for step in recording.steps]
    return [pack(record) for record in records]


def test_ten_thousand_messages_of_a_listener_change_nothing(tmp_path: Path):
    """Whoever listens at a public address may publish whatever it likes: nobody hears it."""
    calm, rough = tmp_path / "calm", tmp_path / "rough"
    calm.mkdir()
    rough.mkdir()
    undisturbed = run(TOYS, calm)
    address = public_address()
    graph, settings = changed(TOYS, rough, Counter="GatedCounter"), (f"counter.go={rough / 'go'}", f"listen={address}")
    process = start(graph, rough, *settings)
    before = read_until(process, "processes are ready")
    bad, keys, alive = Mutator(payloads_of(undisturbed.recording), 1), random.Random(2), processes_of(rough)
    with stranger(address) as session:
        name = run_of(before)
        heard: list[str] = []
        session.declare_subscriber(f"{name}/h/**", lambda sample: heard.append(str(sample.key_expr)))
        tokens = [
            session.liveliness().declare_token(f"{name}/present/{path}")
            for path in ("worker/0/9", "worker/7/0", "x", "gateway/0/1")
        ]
        for _ in range(MESSAGES):
            session.put(f"{name}/{keys.choice(KEYS)}", bad(), congestion_control=zenoh.CongestionControl.BLOCK)
        asked = [reply.ok for word in ("down", "status") for reply in session.get(f"{name}/q/{word}", timeout=0.5)]
        assert not any(asked)
        wait_until(lambda: heard)
        assert process.poll() is None and processes_of(rough) == alive, finish(process, rough, before).output
        (rough / "go").touch()
        ended = finish(process, rough, before)
        del tokens
    assert (ended.code, ended.result) == (0, undisturbed.result), ended.output
    assert Recording(ended.recording).verdict.complete
    assert "restarts (" not in ended.output
    assert "refused" not in ended.output


def public_address() -> str:
    return f"tcp/{free_address()}"


@contextlib.contextmanager
def stranger(address: str) -> Iterator[zenoh.Session]:
    """Plain Zenoh, as a client of a run."""
    config = zenoh.Config()
    settings = {"mode": "client", "connect/endpoints": [address], "scouting/multicast/enabled": False}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


def run_of(seen: str) -> str:
    match = re.search(r"run (\S+) on ", seen)
    assert match is not None
    return match[1]


def test_what_is_wrong_is_named(tmp_path: Path):
    samples = np.zeros(3)
    good = envelope(
        Answer(index=0, count=4, samples=samples),
        id="worker.answer#0",
        lineage="counter.number#0",
        time_ns=0,
        causes=(),
    )
    body = bytes(good.body)
    change: Callable[..., Envelope] = msgspec.structs.replace
    bad = {
        "type: expected Answer, got 'Number'": change(good, type="Number"),
        "version: expected Answer 1, got 2": change(good, version=2),
        "element type 'object64' is not one of": change(
            good, body=msgspec.Raw(body.replace(b"float64", b"object64"[:7]))
        ),
        "NaN or infinity in 1 elements": change(good, body=msgspec.Raw(body[:-8] + np.float64(np.nan).tobytes())),
        "do not fill shape": change(good, body=msgspec.Raw(body.replace(b"\x91\x03", b"\x91\x04"))),
    }
    bad["element type 'object6' is not one of"] = bad.pop("element type 'object64' is not one of")
    process = start(changed(TOYS, tmp_path, Counter="GatedCounter"), tmp_path, f"counter.go={tmp_path / 'go'}")
    before = read_until(process, "processes are ready")
    match = re.search(r"run (\S+) on (\S+)", before)
    assert match is not None
    stray = Bus(match[1], meeting_of(match[2]))
    wait_for_links(stray, ("gatherer", 0))
    for number, sealed in enumerate(bad.values()):
        stray.publish("again/gatherer/0/answers", pack(change(sealed, id=f"worker.answer#{1000 + number}")))
    before += read_until(process, "element type 'object6'")
    (tmp_path / "go").touch()
    ended = finish(process, tmp_path, before)
    stray.close()
    assert (ended.code, len(ended.result)) == (0, 5), ended.output
    for reason in bad:
        assert reason in ended.output, (reason, ended.output)


def test_bad_messages_of_the_run_itself_crash_no_process(tmp_path: Path):
    """Of one user all may speak: what they send is checked all the same."""
    endpoint = new_endpoint()
    graph = load_graph(ALBUM, (f"sink.path={tmp_path / 'out.txt'}",))
    bus = Bus("bad", endpoint, process=Process(GATEWAY, 0), listen=True)
    presence, pulses = Presence(), list[Pulse]()
    bus.watch(presence.update)
    bus.subscribe("h/glance/0", lambda packet: pulses.append(unpack(Pulse, packet.payload)))
    picture = Picture(pixels=np.zeros(100, np.uint8), last=False)
    last = envelope(picture, id="camera.picture#500000", lineage="camera.picture#500000", time_ns=5, causes=())
    handled = threading.Event()
    bus.subscribe("s/glance", lambda packet: handled.set() if last.id.encode() in bytes(packet.payload) else None)
    bus.announce()
    graph_text = '{"name": "bad", "seed": 0, "stages": {}}'
    manifest = Manifest("bad", endpoint, str(tmp_path / "bad.mcap"), graph_text, (), {})
    assignment = Assignment(
        run="bad",
        endpoint=endpoint,
        directory=str(tmp_path),
        stage="glance",
        entry=node_entry(graph.nodes["glance"]),
        seed=0,
        routes=(Route("nothing", "sink", "picture", "block", 4, shared=False, kept=0),),
        processes=(("glance", 0),),
    )
    recorder = spawn("runner.process.recorder", task=msgspec.json.encode(manifest), log=tmp_path / "recorder.txt")
    host = spawn("runner.process.stage_process", task=msgspec.json.encode(assignment), log=tmp_path / "host.txt")
    assert presence.wait_for([(RECORDER, 0), ("glance", 0)], lambda: host.poll() is not None)
    good: list[Any] = [Lost("sink", 0, 0, "killed", 5), LogLine("glance", 0, "info", "text", 5)]
    good += [
        Step("glance", 0, 0, n, "on_picture", (("picture", f"camera.picture#{n}"),), (), 5, 1, 1, 1) for n in range(9)
    ]
    good += [
        envelope(picture, id=f"camera.picture#{n}", lineage=f"camera.picture#{n}", time_ns=5, causes=())
        for n in range(9)
    ]
    bad, keys = Mutator([pack(one) for one in good], 3), random.Random(4)
    own = ("j/sink", "x/sink", "e/sink/0/0", "l/glance", "again/glance/0/picture", "m/camera/picture", "s/glance")
    for _ in range(MESSAGES):
        bus.publish(keys.choice(own), bad())
    bus.publish("again/glance/0/picture", pack(last))
    wait_until(lambda: handled.is_set() and pulses and pulses[-1].refused > 1000)
    bus.publish("e/supervisor/0/0", b"")
    for process in (host, recorder):
        process.terminate()
    assert (host.wait(60), recorder.wait(60)) == (0, 1), last_lines(tmp_path / "host.txt", 9)
    bus.close()
    assert "malformed" not in reason_in(tmp_path / "recorder.txt")
    assert Recording(tmp_path / "bad.mcap").damage == []


@pytest.mark.parametrize("kind", [Envelope, Step, Deal, Lost, LogLine, Pulse])
def test_a_record_is_read_or_refused(kind: type[Any], tmp_path: Path):
    """Ten thousand of each kind: nothing but CodecError is ever raised, and every refusal is counted."""
    good: list[Any] = [
        Step("a", 0, 0, 1, "on_b", (("b", "c.d#1"),), ("a.e#1",), 5, 1, 1, 1),
        Deal("c.d#1"),
        Lost("a", 0, 0, "killed", 5),
        LogLine("a", 0, "info", "text", 5),
        Pulse("a", 0, 0),
        envelope(Answer(index=0, count=1, samples=np.ones(2)), id="a.b#1", lineage="a.b#1", time_ns=5, causes=()),
    ]
    said: list[str] = []
    refusals = Refusals(said.append)
    bad = Mutator([pack(one) for one in good], 5)
    noted: list[msgspec.Struct] = []
    take = refusals.reading(kind, lambda record, _: noted.append(record))
    for _ in range(MESSAGES):
        take(Packet("k", bad(), 0, 0))
    assert refusals.count == MESSAGES - len(noted)
    assert 10 <= len(said) < 20
    with pytest.raises(CodecError, match="MessagePack"):
        unpack(kind, b"\xc1")
