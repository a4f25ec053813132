"""Whatever arrives on whatever key: refused, counted and named; nothing crashes and the graph answers the same."""

import contextlib
import platform
import random
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from runner.graph.graph import Route, load_graph, node_entry
from runner.message.codec import CodecError, Envelope, Journal, LogLine, Pulse, Receipt, Step, envelope, pack, unpack
from runner.message.packet import RECORDER, Packet, Process
from runner.message.refusals import Refusals
from runner.process.children import last_lines, spawn
from runner.process.health import PULSE_SECONDS
from runner.process.stage_process import Assignment
from runner.recording.recording import Recording
from runner.recording.writer import Manifest
from runner.transport.bus import Bus, Presence
from runner.transport.session import free_endpoint
from tests.runner.survivors import Picture
from tests.runner.test_runs import TOYS, finish, processes_of, read_until, run, start
from tests.runner.test_survival import ALBUM, changed
from tests.runner.toys import Answer
from tests.runner.waiting import wait_until

MESSAGES = 10_000
KEYS = (
    *("m/counter/number", "m/worker/answer", "a/sink/finished", "m/nobody/nothing", "d/splitter/0/number"),
    *("d/worker/0/piece", "d/worker/1/number", "d/gatherer/0/answers", "d/gatherer/0/nothing", "d/sink/0/total"),
    *("s/splitter", "s/worker", "s/nobody", "j/splitter", "j/worker", "j/gatherer", "r/splitter", "r/worker", "r/sink"),
    *("l/worker", "l/supervisor", "l/recorder", "h/worker/0", "h/recorder/0", "h/nobody", "gone/worker/0/0", "gone/x"),
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
    records += [Receipt(port, id) for step in recording.steps for port, id in step.consumed]
    records += [Pulse(step.stage, step.replica, 0, 1, "here") for step in recording.steps]
    return [pack(record) for record in records]


def test_ten_thousand_bad_messages_change_nothing(tmp_path: Path):
    calm, rough = tmp_path / "calm", tmp_path / "rough"
    calm.mkdir()
    rough.mkdir()
    undisturbed = run(TOYS, calm)
    process = start(changed(TOYS, rough, Counter="GatedCounter"), rough, f"counter.go={rough / 'go'}")
    before = read_until(process, "processes are ready")
    stray = Stray(before)
    bad, keys = Mutator(payloads_of(undisturbed.recording), 1), random.Random(2)
    alive = processes_of(rough)
    meeting = {"recorder": "m/x/y", "counter": "r/splitter", "splitter": "d/splitter/0/number", "worker": "r/gatherer"}
    stray.meet(**meeting)
    for _ in range(MESSAGES):
        stray.publish(keys.choice(KEYS), bad())
    stray_tokens(stray)
    wait_until(lambda: min(stray.refused[who] for who in meeting) > 200)
    assert process.poll() is None and processes_of(rough) == alive, finish(process, rough, before).output
    (rough / "go").touch()
    ended = finish(process, rough, before)
    stray.close()
    assert (ended.code, ended.result) == (0, undisturbed.result), ended.output
    assert Recording(ended.recording).verdict.complete
    assert "restarts (" not in ended.output
    for who in ("supervisor", "recorder", "splitter"):
        assert re.search(rf"{who} +\S+: message refused \(100 so far\): ", ended.output), ended.output


class Stray(Bus):
    """Somebody who knows where a run is and not its secret; hears what its processes say they refused."""

    def __init__(self, seen: str) -> None:
        match = re.search(r"run (\S+) on (\S+)", seen)
        assert match is not None
        super().__init__(match[1], connect=match[2])
        self.run = match[1]
        self.refused: dict[str, int] = {}
        self.subscribe("h/**", self._on_pulse)

    def _on_pulse(self, packet: Packet) -> None:
        with contextlib.suppress(CodecError):
            pulse = unpack(Pulse, packet.payload)
            if pulse.host == platform.node():  # no mutation of ours
                self.refused[pulse.stage] = max(self.refused.get(pulse.stage, 0), pulse.refused)

    def meet(self, **keys: str) -> None:
        """Sends until every process has refused something: only then it is linked to all of them."""

        def met() -> bool:
            for stage, key in keys.items():
                if not self.refused.get(stage):
                    self.publish(key, b"\xc1")
            time.sleep(2 * PULSE_SECONDS)
            return all(self.refused.get(stage) for stage in keys)

        wait_until(met)


def stray_tokens(stray: Stray) -> None:
    """Presence of processes that there are not."""
    session: Any = vars(stray)["_session"]
    for path in ("present/worker/0/9", "present/worker/0/9/0011223344556677", "present/worker/7/0/x", "present/x"):
        session.liveliness().declare_token(f"{stray.run}/{path}")


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
        "not sent by a process of this run": good,
    }
    bad["element type 'object6' is not one of"] = bad.pop("element type 'object64' is not one of")
    process = start(changed(TOYS, tmp_path, Counter="GatedCounter"), tmp_path, f"counter.go={tmp_path / 'go'}")
    before = read_until(process, "processes are ready")
    stray = Stray(before)
    stray.meet(gatherer="d/gatherer/0/answers")
    for sealed in bad.values():
        stray.publish("d/gatherer/0/answers", pack(sealed))
    before += read_until(process, "element type 'object6'")
    (tmp_path / "go").touch()
    ended = finish(process, tmp_path, before)
    stray.close()
    assert (ended.code, len(ended.result)) == (0, 5), ended.output
    for reason in bad:
        assert reason in ended.output, (reason, ended.output)


def test_bad_messages_of_the_run_itself_crash_no_process(tmp_path: Path):
    """A faulty process knows the secret: what it sends is checked as closely."""
    endpoint, secret = free_endpoint(), "secret"
    graph = load_graph(ALBUM, (f"sink.path={tmp_path / 'out.txt'}",))
    bus = Bus("bad", listen=endpoint, secret=secret, process=Process("stray", 0))
    presence, pulses = Presence(), list[Pulse]()
    bus.watch(presence.update)
    bus.subscribe("h/glance/0", lambda packet: pulses.append(unpack(Pulse, packet.payload)))
    manifest = Manifest(
        "bad", endpoint, str(tmp_path / "bad.mcap"), '{"name": "bad", "seed": 0, "stages": {}}', (), {}, secret=secret
    )
    assignment = Assignment(
        run="bad",
        endpoint=endpoint,
        directory=str(tmp_path),
        stage="glance",
        entry=node_entry(graph.nodes["glance"]),
        seed=0,
        routes=(Route("nothing", "sink", "picture", "block", 4, shared=False, kept=0),),
        processes=(("glance", 0),),
        secret=secret,
    )
    recorder = spawn("runner.process.recorder", task=msgspec.json.encode(manifest), log=tmp_path / "recorder.txt")
    host = spawn("runner.process.stage_process", task=msgspec.json.encode(assignment), log=tmp_path / "host.txt")
    assert presence.wait_for([(RECORDER, 0), ("glance", 0)], lambda: host.poll() is not None)
    picture = Picture(pixels=np.zeros(100, np.uint8), last=False)
    good: list[Any] = [Receipt("picture", "camera.picture#1"), LogLine("glance", 0, "info", "text", 5)]
    good += [
        Step("glance", 0, 0, n, "on_picture", (("picture", f"camera.picture#{n}"),), (), 5, 1, 1, 1) for n in range(9)
    ]
    good += [
        envelope(picture, id=f"camera.picture#{n}", lineage=f"camera.picture#{n}", time_ns=5, causes=())
        for n in range(9)
    ]
    bad, keys = Mutator([pack(one) for one in good], 3), random.Random(4)
    straight = {"d/glance/0/picture": "glance", "m/camera/picture": RECORDER, "s/glance": RECORDER}
    for _ in range(MESSAGES):
        key = keys.choice(("j/sink", "r/sink", "l/glance", *straight, *straight))
        if key in straight and keys.random() < 0.5:
            assert bus.deliver((straight[key], 0), key, bad())
        else:
            bus.publish(key, bad())
    steps = max((pulse.steps for pulse in pulses), default=0)
    last = envelope(picture, id="camera.picture#500000", lineage="camera.picture#500000", time_ns=5, causes=())
    bus.publish("d/glance/0/picture", pack(last))
    wait_until(lambda: pulses and pulses[-1].refused > 1000 and pulses[-1].steps > min(steps, pulses[-1].steps - 1))
    assert bus.flush()
    for process in (host, recorder):
        process.terminate()
    assert (host.wait(60), recorder.wait(60)) == (0, 1), last_lines(tmp_path / "host.txt", 9)
    bus.close()
    assert "malformed" not in "".join(last_lines(tmp_path / "recorder.txt", 1))
    assert Recording(tmp_path / "bad.mcap").damage == []


@pytest.mark.parametrize("kind", [Envelope, Step, Receipt, LogLine, Pulse])
def test_a_record_is_read_or_refused(kind: type[Any], tmp_path: Path):
    """Ten thousand of each kind: nothing but CodecError is ever raised, and every refusal is counted."""
    good: list[Any] = [
        Step("a", 0, 0, 1, "on_b", (("b", "c.d#1"),), ("a.e#1",), 5, 1, 1, 1),
        Receipt("b", "c.d#1"),
        LogLine("a", 0, "info", "text", 5),
        Pulse("a", 0, 0, 1, "here"),
        envelope(Answer(index=0, count=1, samples=np.ones(2)), id="a.b#1", lineage="a.b#1", time_ns=5, causes=()),
    ]
    said: list[str] = []
    refusals = Refusals(said.append)
    bad = Mutator([pack(one) for one in good], 5)
    read = sum(refusals.read(kind, Packet("k", bad(), 0, 0)) is not None for _ in range(MESSAGES))
    assert refusals.count == MESSAGES - read
    assert 10 <= len(said) < 20
    with pytest.raises(CodecError, match="MessagePack"):
        unpack(kind, b"\xc1")
