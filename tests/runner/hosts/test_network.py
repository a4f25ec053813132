"""Hosts in graph files: what is read from them, what is refused as unsafe, and what never crosses."""

import re
import signal
import socket
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import psutil
import pytest
import zenoh

from runner.contract import Refused
from runner.graph.document import Document, read_document
from runner.graph.graph import Graph, graph_to_json, node_entry
from runner.graph.placement import Host, Layout, read_layout, read_owners
from runner.graph.reading import graph_from_json, load_graph, node_from_entry
from runner.hosts.head import ABSENT_SECONDS, Hello, Hosts, RemoteChild, differences
from runner.message.packet import Process
from runner.process.children import spawn
from runner.recording.provenance import portable
from runner.supervise.child import Child
from runner.testing import read_until
from runner.transport import bus
from runner.transport.bus import Bus
from runner.transport.presence import Presence
from runner.transport.session import new_endpoint
from tests.runner.common.machines import HOSTS, free_address
from tests.runner.common.runs import DOUBLES, finish, start

OUT = "sink.path=out.txt"
LINE = "hosts: {head: 127.0.0.1:7447, worker1: 127.0.0.1, worker2: 127.0.0.1}"
PLACED = "host: {worker1: 1, worker2: 1}"


def load(folder: Path, *settings: str, old: str = "", new: str = "") -> Graph:
    assert old in HOSTS.read_text()
    path = folder / "graph.yaml"
    path.write_text(HOSTS.read_text().replace(old, new) if old else HOSTS.read_text())
    return load_graph(path, (OUT, *settings))


def layout(**values: object) -> Layout:
    return read_layout(Document("graph.yaml", Path("/lab"), values))


# ---------------------------------------------------------------------------------------------- placement


def test_each_process_has_its_host(tmp_path: Path):
    graph = load(tmp_path)
    assert graph.layout.names == ("head", "worker1", "worker2")
    assert graph.nodes["worker"].replicas == 2
    assert {key: graph.host_of(*key) for key in graph.processes()} == {
        ("counter", 0): "head",
        ("splitter", 0): "head",
        ("worker", 0): "worker1",
        ("worker", 1): "worker2",
        ("gatherer", 0): "worker2",
        ("sink", 0): "head",
    }


def test_all_replicas_go_to_one_host_that_is_named(tmp_path: Path):
    graph = load(tmp_path, old=PLACED, new="host: worker2\n    replicas: 3")
    assert graph.nodes["worker"].placement == ("worker2",) * 3


def test_hosts_and_places_may_be_set(tmp_path: Path):
    graph = load(tmp_path, "hosts.head=127.0.0.1:9000", "gatherer.host=worker1")
    assert graph.layout.endpoint == "tcp/127.0.0.1:9000"
    assert graph.host_of("gatherer", 0) == "worker1"


def test_a_graph_may_run_here_and_is_read_back_for_one_machine(tmp_path: Path):
    graph = load(tmp_path)
    assert (graph.here().layout.hosts, graph.here().host_of("worker", 1)) == ((), None)
    read = graph_from_json(graph_to_json(graph))
    assert (read.layout.hosts, read.nodes["worker"].replicas) == ((), 2)
    assert node_from_entry("worker", node_entry(graph.nodes["worker"])).placement == ()


# ---------------------------------------------------------------------------------------------- refusals

OPEN = "is not loopback, and without keys anybody who reaches it could take part; type: runner keys init .*, and add"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (LINE, LINE.replace("worker1: 127.0.0.1", "worker1: 10.0.0.2"), f":3: hosts.worker1: 10.0.0.2 {OPEN}"),
        (LINE, LINE.replace("head: 127.0.0.1:7447", "head: lab.local:7447"), f":3: hosts.head: lab.local {OPEN}"),
        (LINE, f"{LINE}\nrouter: 10.0.0.9:7447", f":4: router: 10.0.0.9 {OPEN}"),
        (LINE, LINE.replace(":7447", ""), ":3: hosts.head: the others must know where to call; add a port: head: 127"),
        (LINE, LINE.replace("127.0.0.1:7447", "0.0.0.0:7447"), ":3: hosts.head: nobody can call 0.0.0.0"),
        (LINE, LINE.replace("7447", "74470"), ":3: hosts.head: 74470 is no port"),
        (LINE, LINE.replace("head: 127.0.0.1:7447", "head: 'tcp/127.0.0.1:7447'"), ":3: hosts.head: .* is no address"),
        (LINE, LINE.replace("head:", "Head:"), ":3: hosts.Head: a host's name is lower case"),
        (LINE, f"{LINE}\nrouter: worker1", ":4: router: 'worker1' is not the head; valid: head, or ADDRESS:PORT"),
        (LINE, f"{LINE}\nrouter: 127.0.0.1", ":4: router: the port is missing"),
        (LINE, "hosts: [head]", ":3: hosts: Expected `object "),
        (PLACED, "host: wrker1", ":12: stages.worker.host: no host 'wrker1'; did you mean 'worker1'"),
        (PLACED, "host: {worker1: 0}", ":12: stages.worker.host"),
        (PLACED, f"{PLACED}\n    replicas: 3", ":13: stages.worker.replicas: 3, but host places 2"),
        (
            PLACED,
            f"{PLACED}\n    replicas: auto",
            ":13: stages.worker.replicas: the cores of worker1 are not known here",
        ),
        ("host: worker2", "host: {worker1: 1, worker2: 1}", ":18: stages.gatherer.host: .* takes no Part"),
    ],
)
def test_what_cannot_work_or_is_not_safe_is_one_line(tmp_path: Path, old: str, new: str, message: str):
    with pytest.raises(Refused, match=message) as caught:
        load(tmp_path, old=old, new=new)
    assert "\n" not in str(caught.value)


def test_an_address_that_was_set_is_refused_where_it_was_set(tmp_path: Path):
    with pytest.raises(Refused, match=f"--set hosts.worker1: 10.0.0.2 {OPEN}"):
        load(tmp_path, "hosts.worker1=10.0.0.2")


def test_keys_say_nothing_without_hosts():
    with pytest.raises(Refused, match="keys: says nothing without hosts"):
        layout(keys="keys")


def test_with_keys_every_endpoint_is_tls(tmp_path: Path):
    made = layout(hosts={"head": "10.0.0.1:7447", "worker1": "[fe80::2]"}, keys="keys")
    assert (made.endpoint, made.keys) == ("tls/10.0.0.1:7447", Path("/lab/keys"))
    assert made.network("worker1", None).listen == "tls/[fe80::2]:0"
    assert not made.network("worker1", None).routed


def test_a_router_is_where_all_meet():
    hosts = {"head": "127.0.0.1:7447", "worker1": "127.0.0.1"}
    assert layout(hosts=hosts, router="head").endpoint == "tcp/127.0.0.1:7447"
    elsewhere = layout(hosts={**hosts, "head": "127.0.0.1"}, router="127.0.0.1:9000")
    assert (elsewhere.endpoint, elsewhere.router_is_head) == ("tcp/127.0.0.1:9000", False)
    assert elsewhere.network("worker1", None).hosts == ("head", "worker1", "router")


def test_owners_of_keys_come_from_a_graph_or_the_command_line(tmp_path: Path):
    path = tmp_path / "graph.yaml"
    path.write_text(HOSTS.read_text().replace(LINE, LINE.replace("worker1: 127.0.0.1", "worker1: 10.0.0.2")))
    read, folder = read_owners([str(path)])
    assert (read.names, folder) == (("head", "worker1", "worker2"), tmp_path / "keys")
    assert read_owners(["head=10.0.0.1", "arm=lab.local"])[0].hosts == (
        Host("head", "10.0.0.1"),
        Host("arm", "lab.local"),
    )
    with pytest.raises(Refused, match="expected one graph file, or hosts as NAME=ADDRESS"):
        read_owners(["head=10.0.0.1", "arm"])
    with pytest.raises(Refused, match=r"^\.\./arm: expected .* names of lower case letters, digits"):
        read_owners(["../arm=10.0.0.1"])


# ---------------------------------------------------------------------------------------------- between hosts


def test_two_graph_files_are_compared_key_by_key():
    own = read_document(HOSTS).values
    theirs = {**own, "seed": 8, "view": "x:Y", "stages": {**own["stages"], "sink": {}}}
    assert {key for key, _, _ in differences(own, theirs)} == {
        "seed",
        "view",
        "stages.sink.stage",
        "stages.sink.config",
        "stages.sink.inputs",
    }
    assert list(differences(own, own)) == []


def test_paths_of_the_head_become_paths_of_the_host():
    entry = {"config": {"catalogue": "/lab/head/stages/x.yaml", "data": ["/data/ycb", "/lab/headless"], "n": 3}}
    assert portable(entry, {"/lab/head": "/home/a"}) == {
        "config": {"catalogue": "/home/a/stages/x.yaml", "data": ["/data/ycb", "/lab/headless"], "n": 3}
    }


def test_two_graphs_on_one_machine_never_meet():
    """Not even where both have the same run id and the same keys."""
    heard: dict[str, list[bytes]] = {"one": [], "two": []}
    buses: list[Bus] = []
    for name, packets in heard.items():
        endpoint = new_endpoint()
        listener, speaker = Bus("same", endpoint, listen=True), Bus("same", endpoint)
        listener.subscribe("**", lambda packet, packets=packets: packets.append(packet.payload))
        buses += [speaker, listener]
        deadline = time.monotonic() + 30
        while not packets and time.monotonic() < deadline:
            speaker.publish("m/counter/number", name.encode())
            time.sleep(0.02)
    for speaker, text in zip(buses[::2], ("one", "two"), strict=True):
        speaker.publish("m/counter/last", text.encode())
    time.sleep(0.3)
    for session in buses:
        session.close()
    assert {name: set(packets) for name, packets in heard.items()} == {"one": {b"one"}, "two": {b"two"}}


def test_times_of_another_clock_are_not_taken():
    for clock, sent_ns in ((bus._CLOCK, 5), (bus._CLOCK ^ 1, 0)):
        sample = SimpleNamespace(attachment=zenoh.ZBytes(bus._SENT.pack(5, clock)))
        assert bus._sent_ns(cast("zenoh.Sample", sample)) == sent_ns


# ---------------------------------------------------------------------------------------------- who is cut off


def test_a_replica_is_there_while_one_of_its_processes_is():
    presence = Presence()
    for process, present in ((Process("worker", 0, 0), True), (Process("worker", 0, 1), True)):
        presence.update(process, present)
    presence.update(Process("worker", 0, 0), False)
    assert presence.wait_for([("worker", 0)], lambda: True)


def test_a_host_that_stays_away_ends_what_runs_nowhere_else(tmp_path: Path):
    graph = load(tmp_path, f"hosts.head={free_address()}")
    said: list[str] = []
    hosts = Hosts("hosts", tmp_path / "graph.yaml", graph.layout, lambda text, _: said.append(text))
    there = Hello("worker2", 1, "", "", "", "", "")
    hosts._places["worker2"].hello = there
    hosts._places["worker1"].lost_at = time.monotonic() - ABSENT_SECONDS / 2
    assert hosts.overdue({"sink": {"worker1"}}) is None
    hosts._places["worker1"].lost_at = time.monotonic() - ABSENT_SECONDS - 1
    assert hosts.overdue(graph.hosts_of_stages()) is None  # worker has a replica on worker2
    assert hosts.overdue({"sink": {"worker1"}}) == "host worker1 has been cut off for 60 s, and sink runs nowhere else"
    hosts._places["worker2"].hello = None
    hosts.close(0, "")


def test_the_kernel_of_this_machine_is_not_blamed_for_a_process_on_another(tmp_path: Path):
    log = tmp_path / "log.txt"
    elsewhere = RemoteChild(Process("worker", 0), log, lambda _: None, lambda: None)
    elsewhere.end(-signal.SIGKILL, "")
    here = spawn("code", task=b"", log=log)
    here.kill()
    here.wait()
    killed = [Child(Process("worker", 0), handle, log, oom_kills=-1).reason() for handle in (elsewhere, here)]
    assert killed == ["killed by SIGKILL", "killed by SIGKILL: the kernel was out of memory"]


@pytest.mark.parametrize("opens", [False, True])
def test_nothing_listens_where_others_could_call_unless_the_graph_says_so(tmp_path: Path, opens: bool):
    address = f"tcp/{free_address()}"
    settings = ("counter.count=100000", "counter.period=0.005", "sink.count=100000")
    opened = (f"listen={address}",) if opens else ()
    process = start(DOUBLES, tmp_path, *settings, *opened)
    before = read_until(process, "processes are ready")
    runner = psutil.Process(process.pid)
    addresses = [address for one in [runner, *runner.children(recursive=True)] for address in listening(one)]
    process.terminate()
    finish(process, tmp_path, before)
    assert {f"tcp/{one.ip}:{one.port}" for one in addresses} == ({address} if opens else set())


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("tcp/0.0.0.0:7447", "nobody can call 0.0.0.0"),
        ("tcp/192.168.0.3:7447", "not loopback, and without keys anybody who reaches it could listen"),
        ("tls/127.0.0.1:7447", "TLS needs hosts and keys; valid: tcp/127.0.0.1:7447"),
        ("tcp/127.0.0.1", "the port is missing; valid: tcp/127.0.0.1:7447"),
        ("127.0.0.1:7447", "valid: tcp/127.0.0.1:7447, or with keys tls/ADDRESS:PORT"),
    ],
)
def test_where_others_listen_is_checked(value: str, reason: str):
    with pytest.raises(Refused, match=re.escape(reason)):
        load_graph(DOUBLES, ("sink.path=x", f"listen={value}"))


def listening(process: psutil.Process) -> list[Any]:
    """The addresses of everything that a process would answer to: TCP listeners and bound UDP sockets."""
    sockets = process.net_connections("inet")
    return [one.laddr for one in sockets if one.status == psutil.CONN_LISTEN or one.type == socket.SOCK_DGRAM]
