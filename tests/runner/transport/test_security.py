"""With keys, only the hosts of a graph take part: whoever else tries everything publishes, hears and calls nothing."""

import json
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zenoh

from runner.graph.placement import Credentials, Host, Network
from runner.hosts.keys import add_keys, credentials, make_keys
from runner.message.packet import Process
from runner.transport.bus import Bus
from runner.transport.session import Gateway, new_endpoint, open_session
from tests.runner.common.waiting import wait_until

NAMES = ("head", "worker1", "worker2")
PIECE = "again/worker/0/piece"
NUMBER = "m/counter/number"
STRANGER = "present/stranger/0/0"


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of the hosts of a graph, and of one that is not in the graph."""
    folder = tmp_path_factory.mktemp("own") / "keys"
    make_keys(folder, [Host(name, "127.0.0.1") for name in NAMES])
    add_keys(folder, [Host("elsewhere", "127.0.0.1")])
    return folder


@pytest.fixture(scope="module")
def foreign_keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of the same names from another authority."""
    folder = tmp_path_factory.mktemp("foreign") / "keys"
    make_keys(folder, [Host(name, "127.0.0.1") for name in NAMES])
    return folder


@dataclass
class Table:
    """The head and a worker of a run, with all that reaches the worker and all that the head is asked."""

    endpoint: str
    head: Bus
    worker: Bus
    arrived: list[tuple[str, bytes]] = field(default_factory=list)
    present: list[str] = field(default_factory=list)
    asked: list[bytes] = field(default_factory=list)


@pytest.fixture(params=["direct", "routed"])
def table(keys: Path, request: pytest.FixtureRequest) -> Iterator[Table]:
    endpoint = new_endpoint("tls/127.0.0.1:0")
    routed = request.param == "routed"
    own, other = (
        Network(name, "head", NAMES, "tls/127.0.0.1:0", routed, credentials(keys, name)) for name in NAMES[:2]
    )
    router = [open_session([endpoint], [], own, mode="router")] if routed else []
    head = Bus("run", endpoint, network=own, process=Process("counter", 0), listen=not routed)
    made = Table(endpoint, head, Bus("run", endpoint, network=other))
    made.worker.subscribe("**", lambda packet: made.arrived.append((packet.key, packet.payload)))
    made.worker.watch(lambda process, _: made.present.append(f"present/{process.path}"))
    head.serve("status", lambda question: made.asked.append(question) or b"up")
    assert made.worker.ask("status", b"worker1", 10) == b"up"
    yield made
    for session in (made.worker, made.head, *router):
        session.close()


@dataclass
class Peer:
    """Somebody with Zenoh and whatever credentials, who keeps to no rules of the runner."""

    session: zenoh.Session
    heard: list[bytes] = field(default_factory=list)
    seen: list[str] = field(default_factory=list)
    answers: list[bytes] = field(default_factory=list)


def call_in(endpoint: str, shown: Credentials | None, trusted: str, mode: str = "peer") -> zenoh.Session:
    tls = {"root_ca_certificate": trusted}
    if shown is not None:
        tls |= {f"{side}_private_key": shown.key for side in ("listen", "connect")}
        tls |= {f"{side}_certificate": shown.certificate for side in ("listen", "connect")}
        tls |= {"enable_mtls": True}
    listen = "tcp/127.0.0.1:0" if shown is None else "tls/127.0.0.1:0"
    config = zenoh.Config()
    listened = [] if mode == "client" else [listen]
    settings = {"mode": mode, "connect/endpoints": [endpoint], "listen/endpoints": listened}
    for key, value in {**settings, "scouting/multicast/enabled": False, "transport/link/tls": tls}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def try_everything(table: Table, session: zenoh.Session, seconds: float) -> Peer:
    """Subscribes, declares itself present, publishes and asks, while the run goes on; tries again for a while."""
    peer = Peer(session)
    keep = [
        session.declare_subscriber("run/m/**", lambda sample: peer.heard.append(sample.payload.to_bytes())),
        session.liveliness().declare_subscriber(
            "run/present/**", lambda sample: peer.seen.append(str(sample.key_expr)), history=True
        ),
        session.liveliness().declare_token(f"run/{STRANGER}"),
    ]
    table.head.announce()
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and not succeeded(table, peer):
        table.head.publish(NUMBER, b"number")
        session.put(f"run/{PIECE}", b"piece")
        replies = session.get("run/q/status", payload=b"stranger", timeout=0.5)
        peer.answers += [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
        time.sleep(0.1)
    for declared in keep:
        declared.undeclare()
    return peer


def succeeded(table: Table, peer: Peer) -> bool:
    """Whether all of it had an effect."""
    published = (PIECE, b"piece") in table.arrived and STRANGER in table.present
    seen = any(key.startswith("run/present/counter/") for key in peer.seen)
    return published and seen and b"number" in peer.heard and b"up" in peer.answers


def test_a_host_of_the_graph_does_all_of_it(table: Table, keys: Path):
    own = credentials(keys, "worker2")
    with call_in(table.endpoint, own, own.ca) as session:
        assert succeeded(table, try_everything(table, session, seconds=30))


@pytest.mark.parametrize("kind", ["no certificate", "another authority", "a host that is not in the graph"])
def test_anybody_else_does_nothing_of_it(table: Table, keys: Path, foreign_keys: Path, kind: str):
    shown = {
        "no certificate": None,
        "another authority": credentials(foreign_keys, "worker1"),
        "a host that is not in the graph": credentials(keys, "elsewhere"),
    }[kind]
    with call_in(table.endpoint, shown, str(keys / "ca.pem")) as session:
        peer = try_everything(table, session, seconds=2)
        own = {f"run/{STRANGER}"}
        assert (peer.heard, set(peer.seen) - own, peer.answers) == ([], set(), [])
        wait_until(lambda: (NUMBER, b"number") in table.arrived)
        assert (PIECE, b"piece") not in table.arrived
        assert STRANGER not in table.present
        assert b"stranger" not in table.asked


def test_whoever_speaks_no_tls_is_not_let_in(table: Table, keys: Path):
    with call_in(table.endpoint.replace("tls/", "tcp/"), None, str(keys / "ca.pem")) as session:
        assert try_everything(table, session, seconds=1).heard == []
        assert (PIECE, b"piece") not in table.arrived


@dataclass
class Meeting:
    """The place where the hosts of a graph meet: the head, one that listens and one that does as it likes."""

    head: Bus
    worker: Bus
    other: Bus

    @property
    def stranger(self) -> zenoh.Session:
        return self.other._session  # pyright: ignore


@pytest.fixture
def meeting(keys: Path, request: pytest.FixtureRequest) -> Iterator[Meeting]:
    endpoint = new_endpoint("tls/127.0.0.1:0")
    networks = [Network(name, "head", NAMES, "tls/127.0.0.1:0", False, credentials(keys, name)) for name in NAMES]
    run = getattr(request, "param", "hosts/toys")
    head = Bus(run, endpoint, network=networks[0], listen=True)
    made = Meeting(head, *(Bus(run, endpoint, network=network) for network in networks[1:]))
    yield made
    for bus in (made.other, made.worker, made.head):
        bus.close()


ORDER = "hosts/toys/order/worker1/1"


@pytest.mark.parametrize(
    "key", [ORDER, "hosts/toys/order/**", "hosts/toys/*/worker1/1", "*/toys/order/worker1/1", "**"]
)
def test_only_the_head_gives_orders(meeting: Meeting, key: str):
    orders: list[bytes] = []
    reports: list[bytes] = []
    meeting.worker.subscribe("order/worker1/1", lambda packet: orders.append(packet.payload))
    meeting.worker.subscribe("report/*/*", lambda packet: reports.append(packet.payload))
    take = meeting.worker.channel("order/worker1/1")

    def all_arrived() -> bool:
        meeting.stranger.put(key, b"from worker2")
        meeting.stranger.delete(key)
        meeting.other.publish("report/worker2/1", b"from worker2")
        meeting.head.publish("order/worker1/1", b"from the head")
        return b"from the head" in orders and b"from worker2" in reports

    wait_until(all_arrived)
    assert set(orders) == {b"from the head"}
    assert {packet.payload for packet in take()} == {b"from the head"}


QUESTION = "hosts/toys/q/join"
ANSWERS = [
    *(("hosts/toys", served, answered) for served in (QUESTION, "hosts/**") for answered in (QUESTION, "hosts/**")),
    ("run", "run/q/join", "run/q/join"),
    ("run", "**", "run/q/**"),
]


@pytest.mark.parametrize(("meeting", "served", "answered"), ANSWERS, indirect=["meeting"])
def test_only_the_head_answers(meeting: Meeting, served: str, answered: str):
    asked = threading.Event()

    def answer(query: zenoh.Query) -> None:
        with query:
            asked.set()
            query.reply(answered, b"worker2")

    meeting.head.serve("join", lambda _: b"head")
    queryable = meeting.stranger.declare_queryable(served, answer)
    deadline = time.monotonic() + 2
    answers: set[bytes] = set()
    while time.monotonic() < deadline and not asked.is_set():
        answers.add(meeting.worker.ask("join", b"", 10))
    answers |= {meeting.worker.ask("join", b"", 10) for _ in range(20)}
    queryable.undeclare()
    assert answers == {b"head"}


def test_who_has_the_reader_s_certificate_hears_and_says_nothing(keys: Path):
    meeting, public = (new_endpoint("tls/127.0.0.1:0") for _ in range(2))
    network, other = (
        Network(name, "head", NAMES, "tls/127.0.0.1:0", False, credentials(keys, name)) for name in NAMES[:2]
    )
    head = Bus("run", meeting, network=network, process=Process("counter", 0), listen=True)
    gateway = Gateway(new_endpoint(), meeting, network, public)
    worker = Bus("run", meeting, network=other)
    arrived: list[str] = []
    worker.subscribe("**", lambda packet: arrived.append(packet.key))
    heard: dict[str, list[bytes]] = {}
    sessions: list[zenoh.Session] = []
    for name in ("reader", "elsewhere"):
        own = credentials(keys, name)
        session = call_in(public, own, own.ca, mode="client")
        sessions.append(session)
        heard[name] = []
        session.declare_subscriber(
            "run/m/**", lambda sample, found=heard[name]: found.append(sample.payload.to_bytes())
        )

    def told() -> bool:
        head.publish(NUMBER, b"number")
        for session in sessions:
            session.put(f"run/{PIECE}", b"piece")
        return bool(heard["reader"]) and NUMBER in arrived

    wait_until(told)
    assert heard["elsewhere"] == []
    assert set(arrived) == {NUMBER}
    for session in sessions:
        session.close()
    worker.close()
    gateway.close()
    head.close()
