"""Graphs on several hosts: the same bytes as on one, whoever strays in and whoever is cut off."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import zenoh

from runner.cli.main import main
from runner.contract import EXIT_REFUSED
from runner.graph.document import read_document
from runner.graph.placement import Host, read_layout
from runner.hosts.head import Dismiss, Ended, Hello, RemoteChild, Report, Start, control, network_of
from runner.hosts.keys import make_keys
from runner.message.packet import Packet, Process
from runner.process.stage_process import Assignment
from runner.recording.recording import Recording
from runner.testing import read_until
from runner.transport.bus import Bus
from runner.transport.session import private
from tests.runner.common.machines import (
    HOSTS,
    NAMES,
    Machines,
    Party,
    free_address,
    in_namespaces,
    on_loopback,
    run_here,
)
from tests.runner.common.runs import Run, changed, processes_of
from tests.runner.common.waiting import wait_until

SUMS = """
name: sums
hosts: {head: 127.0.0.1:7447, worker1: 127.0.0.1}
stages:
  counter:
    stage: tests.runner.common.toys:Counter
  adder:
    stage: tests.runner.common.survivors:Adder
    config:
      marks: ???
    inputs: {number: counter.number}
    host: worker1
  sink:
    stage: tests.runner.common.toys:DoubleSink
    config:
      path: ???
    inputs: {double: adder.double}
"""
SLOW_PIECES = ("worker.seconds=0.3",)


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run_here(tmp_path_factory.mktemp("here"))


@pytest.fixture(scope="module")
def namespaces() -> Iterator[Machines]:
    with in_namespaces() as machines:
        yield machines


@pytest.fixture
def parties() -> Iterator[Callable[..., Party]]:
    made: list[Party] = []

    def make(machines: Machines, folder: Path, options: tuple[str, ...] = (), graph: Path = HOSTS) -> Party:
        made.append(Party(machines, folder, options, graph))
        return made[-1]

    yield make
    for party in made:
        party.close()


def gated(folder: Path) -> Path:
    """The graph, of which the last number waits for the file of ``gate``."""
    return changed(HOSTS, folder, Counter="GatedCounter")


def gate(folder: Path) -> str:
    return f"counter.go={folder / 'go'}"


def with_keys(machines: Machines, folder: Path) -> tuple[str, ...]:
    """Makes keys for the machines; the options that turn them on."""
    addresses = {name: machines.addresses.get(name, "127.0.0.1").partition(":")[0] for name in NAMES}
    make_keys(folder, [Host(name, address) for name, address in addresses.items()])
    return ("--set", f"keys={folder}")


def bodies(finished: Run) -> dict[str, bytes]:
    """Every message of the stages."""
    envelopes = Recording(finished.recording).envelopes()
    return {sealed.id: bytes(sealed.body) for sealed in envelopes if not sealed.id.startswith("supervisor.")}


def assert_same_result(head: Run, here: Run) -> None:
    assert head.code == 0, head.output
    assert Recording(head.recording).verdict.complete
    assert (head.folder.parent / "out.txt").read_text() == (here.folder / "out.txt").read_text()
    assert bodies(head) == bodies(here)


# ---------------------------------------------------------------------------------------------- on loopback


def test_three_hosts_with_keys_give_the_bytes_of_one(here: Run, parties, tmp_path: Path):
    machines = on_loopback()
    party = parties(machines, tmp_path, with_keys(machines, tmp_path / "keys"))
    party.start_all()
    head = party.end("head")
    assert_same_result(head, here)
    workers = [party.end(name) for name in NAMES[1:]]
    assert [(worker.code, worker.output.splitlines()[-1]) for worker in workers] == [(0, "all totals written")] * 2
    assert "starts gatherer.0" in workers[1].output
    assert processes_of(tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--set", "router=head")], ids=["direct", "routed"])
def test_hosts_may_be_started_in_any_order_without_keys_on_loopback(here: Run, parties, tmp_path: Path, options):
    party = parties(on_loopback(), tmp_path, options)
    for name in reversed(NAMES):
        party.start(name)
    assert_same_result(party.end("head"), here)


@pytest.mark.slow
def test_the_head_says_whom_it_waits_for(parties, tmp_path: Path):
    party = parties(on_loopback(), tmp_path)
    head = party.start("head")
    seen = read_until(head, "waiting for host worker2")
    assert f"waiting for host worker1: runner up {HOSTS} --host worker1" in seen
    os.kill(head.pid, signal.SIGINT)
    assert party.end("head").code == 130


@pytest.mark.slow
def test_a_host_with_another_graph_is_refused_with_the_difference(parties, tmp_path: Path):
    party = parties(on_loopback(), tmp_path)
    party.start("head")
    other = tmp_path / "other.yaml"
    other.write_text(HOSTS.read_text().replace("seed: 7", "seed: 8"))
    party.hosts["worker1"] = party.machines.start("worker1", tmp_path, graph=other)
    refused = party.end("worker1")
    assert refused.code == 2
    assert "host worker1 has another graph: seed: 8 at worker1, 7 at the head" in refused.output
    party.start("worker1")
    party.start("worker2")
    assert party.end("head").code == 0


def orders_to_worker1(party: Party, run: str, process: Process) -> tuple[str, list[Report]]:
    """What it prints and reports to a head that has it start one process and, once that has ended, end itself."""
    document = read_document(HOSTS)
    document.values["hosts"] |= party.machines.addresses
    layout = read_layout(document)
    name, own = document.values["name"], Process("head", 0, 1)
    endpoint = private(layout.endpoint)
    head = Bus(control(name), endpoint, network=network_of(layout, "head"), process=own, listen=True)
    reports: list[Report] = []

    def join(text: bytes) -> bytes:
        session = msgspec.json.decode(text, type=Hello).session
        order = f"order/worker1/{session}"

        def heard(packet: Packet) -> None:
            reports.append(msgspec.json.decode(packet.payload, type=Report))
            if isinstance(reports[-1], Ended):
                head.publish(order, msgspec.json.encode(Dismiss(0, "the end")))

        head.subscribe(f"report/worker1/{session}", heard)
        task = Assignment(run, "", "", process.stage, {}, 0, (), ())
        head.publish(order, msgspec.json.encode(Start(process, task)))
        return run.encode()

    head.serve("join", join)
    head.announce()
    party.start("worker1")
    output = party.hosts["worker1"].communicate(timeout=60)[0]
    head.close()
    return output, reports


@pytest.mark.slow
@pytest.mark.parametrize(("run", "stage"), [("../elsewhere", "worker"), ("toys-1", "../../elsewhere/worker")])
def test_a_host_writes_nowhere_but_in_its_folder(parties, tmp_path: Path, run: str, stage: str):
    """Whatever its head calls a run or a stage."""
    (tmp_path / "worker1" / "elsewhere").mkdir(parents=True)
    party: Party = parties(on_loopback(), tmp_path)
    output = orders_to_worker1(party, run, Process(stage, 0))[0]
    wrong = stage if "/" in stage else run
    assert f"the head names {wrong!r}; valid: letters, digits, _ and -" in output
    assert party.hosts["worker1"].returncode == EXIT_REFUSED
    assert list(tmp_path.rglob("elsewhere/*")) == []


@pytest.mark.slow
def test_what_cannot_be_started_is_reported_with_the_reason(parties, tmp_path: Path):
    log = tmp_path / "worker1" / "toys-1" / "log" / "worker-0.txt"
    log.mkdir(parents=True)
    party: Party = parties(on_loopback(), tmp_path)
    output, reports = orders_to_worker1(party, "toys-1", Process("worker", 0))
    assert reports == [Ended(Process("worker", 0), 1, f"it cannot be started: [Errno 21] Is a directory: '{log}'\n")]
    assert (party.hosts["worker1"].returncode, output.splitlines()[-1]) == (0, "the end")


@pytest.mark.slow
def test_a_host_that_can_keep_nothing_says_so(parties, tmp_path: Path):
    (tmp_path / "worker1").touch()
    party: Party = parties(on_loopback(), tmp_path)
    output = orders_to_worker1(party, "toys-1", Process("worker", 0))[0]
    assert output.splitlines()[-1].endswith(f"{tmp_path / 'worker1' / 'toys-1'}: Not a directory"), output
    assert party.hosts["worker1"].returncode == EXIT_REFUSED


@pytest.mark.slow
def test_a_host_hears_the_end_while_a_stage_prepares(parties, tmp_path: Path):
    graph = tmp_path / "sums.yaml"
    graph.write_text(SUMS.replace("survivors:Adder", "survivors:Preparing"))
    party: Party = parties(on_loopback(), tmp_path, graph=graph)
    party.start("head", f"adder.marks={tmp_path}")
    party.start("worker1")
    wait_until((tmp_path / "prepares").exists)
    began = time.monotonic()
    party.hosts["head"].send_signal(signal.SIGINT)
    assert party.end("head").code == 130
    assert party.end("worker1").output.splitlines()[-1] == "interrupted"
    assert time.monotonic() - began < 30, "it has waited for the stage"
    wait_until(lambda: processes_of(tmp_path) == [])


def test_a_killed_host_loses_nothing(here: Run, parties, tmp_path: Path):
    party = parties(on_loopback(), tmp_path, graph=gated(tmp_path)).start_all(*SLOW_PIECES, gate(tmp_path))
    before = read_until(party.hosts["head"], "sum")
    party.hosts["worker1"].kill()
    before += read_until(party.hosts["head"], "is cut off")
    (tmp_path / "go").touch()
    head = party.end("head", before)
    assert "host worker1 is cut off, with 1 processes" in head.output
    assert_same_result(head, here)
    assert processes_of(tmp_path / "worker1") == []


@pytest.mark.slow
def test_a_host_that_is_started_again_takes_part_again(here: Run, parties, tmp_path: Path):
    party = parties(on_loopback(), tmp_path, graph=gated(tmp_path)).start_all("worker.seconds=0.6", gate(tmp_path))
    before = read_until(party.hosts["head"], "sum")
    party.hosts["worker1"].kill()
    before += read_until(party.hosts["head"], "is cut off")
    party.hosts.pop("worker1").communicate()
    party.start("worker1")
    before += read_until(party.hosts["head"], "host worker1 is back")
    (tmp_path / "go").touch()
    head = party.end("head", before)
    assert_same_result(head, here)


def test_a_process_elsewhere_has_gone_even_where_its_last_words_cannot_be_kept():
    """The disk is full."""
    child = RemoteChild(Process("worker", 0), Path("/dev/full"), lambda order: None, lambda: None)
    child.end(1, "last words")
    assert child.poll() == 1


@pytest.mark.slow
def test_hosts_end_with_their_head(parties, tmp_path: Path):
    party = parties(on_loopback(), tmp_path, graph=gated(tmp_path)).start_all(gate(tmp_path))
    read_until(party.hosts["head"], "processes are ready")
    party.hosts["head"].kill()
    for name in NAMES[1:]:
        ended = party.end(name)
        assert (ended.code, "the connection to head is gone" in ended.output) == (1, True), ended.output
    wait_until(lambda: processes_of(tmp_path) == [])


@pytest.mark.slow
def test_a_device_comes_to_rest_where_its_head_has_gone(parties, tmp_path: Path):
    graph = tmp_path / "moves.yaml"
    graph.write_text(SUMS.replace("tests.runner.common.survivors:Adder", "tests.runner.common.endings:Mover"))
    party = parties(on_loopback(), tmp_path, graph=graph)
    party.start("head", f"adder.marks={tmp_path}")
    party.start("worker1")
    wait_until((tmp_path / "moves").exists)
    party.hosts["head"].kill()
    assert party.end("worker1").code == 1
    assert (tmp_path / "rests").exists()


@pytest.mark.slow
def test_a_host_that_stands_still_does_not_keep_the_head_from_its_end(parties, tmp_path: Path):
    party = parties(on_loopback(), tmp_path).start_all("worker.seconds=0.05", "counter.count=1000")
    before = read_until(party.hosts["head"], "sum")
    party.hosts["worker1"].send_signal(signal.SIGSTOP)
    party.hosts["head"].send_signal(signal.SIGINT)
    head = party.end("head", before)
    assert head.code == 130
    assert "host worker1 is cut off, with 1 processes" in head.output
    (lost,) = Recording(head.recording).lost
    assert (lost.stage, lost.reason) == ("worker", "killed: not at its end after 2 s")
    party.hosts["worker1"].send_signal(signal.SIGCONT)
    assert "the head was not answered for 10 s; start this host again" in party.end("worker1").output
    assert processes_of(tmp_path) == []


def test_a_graph_of_several_hosts_asks_which_this_is(capfd: pytest.CaptureFixture[str]):
    assert main(["up", str(HOSTS)]) == 2
    assert "runs on head, worker1, worker2: say which this machine is with --host NAME" in capfd.readouterr().err
    assert main(["up", str(HOSTS), "--host", "wrker1"]) == 2
    assert "no such host; did you mean 'worker1'?" in capfd.readouterr().err
    assert main(["up", str(HOSTS), "--host", "worker1", "--set", "seed=8"]) == 2
    assert "settings are the head's" in capfd.readouterr().err


@pytest.mark.slow
def test_a_stateful_stage_gets_its_state_back_on_its_host(parties, tmp_path: Path):
    graph = tmp_path / "sums.yaml"
    graph.write_text(SUMS)
    results: list[str] = []
    for folder, deaths in ((tmp_path / "plain", "[]"), (tmp_path / "killed", "[2, 3]")):
        folder.mkdir()
        party = parties(on_loopback(), folder, graph=graph)
        party.start("head", f"adder.marks={folder}", f"adder.die_at={deaths}")
        party.start("worker1")
        head = party.end("head")
        assert head.code == 0, head.output
        results.append((folder / "out.txt").read_text())
    assert (results[0], head.output.count("adder restarts")) == (results[1], 2)


@pytest.mark.slow
@pytest.mark.parametrize("fragile", ["splitter", "relay"])
def test_what_a_publisher_took_with_it_is_sent_again_to_every_host(parties, tmp_path: Path, fragile: str):
    """Killed between what it journals and what it sends, again and again: the replicas of each host get all parts, and
    what every replica is to hear."""
    if fragile == "splitter":
        graph = changed(HOSTS, tmp_path, Splitter="FragileSplitter")
    else:
        relay = "relay: {stage: tests.runner.common.survivors:FragileRelay, inputs: {number: counter.number}}"
        relayed = HOSTS.read_text().replace("counter.number", "relay.number")
        graph = tmp_path / HOSTS.name
        graph.write_text(relayed.replace("stages:\n", f"stages:\n  {relay}\n"))
    results: list[str] = []
    for name in ("calm", "rough"):
        folder = tmp_path / name
        folder.mkdir()
        if name == "calm":
            for number in range(20):
                (folder / str(number)).touch()
        party = parties(on_loopback(), folder, graph=graph)
        party.start_all("counter.count=20", f"{fragile}.marks={folder}", f"{fragile}.restarts=20")
        head = party.end("head")
        assert head.code == 0, head.output
        assert Recording(head.recording).verdict.complete
        results.append((folder / "out.txt").read_text())
    assert (results[0], head.output.count(f"{fragile} restarts (")) == (results[1], 10)


@pytest.mark.slow
def test_a_process_elsewhere_is_explained_by_what_it_said_itself(parties, tmp_path: Path):
    graph = tmp_path / "graph.yaml"
    text = HOSTS.read_text().replace("toys:Worker", "survivors:Troubled")
    graph.write_text(text.replace("{worker1: 1, worker2: 1}", "worker1"))
    party = parties(on_loopback(), tmp_path, graph=graph)
    party.start_all(f"worker.marks={tmp_path}", "worker.crash_at=0", "worker.exit_at=1")
    head = party.end("head")
    assert "worker restarts (1 of 3): killed by SIGSEGV" in head.output, head.output
    assert "worker restarts (2 of 3): ended with exit code 3" in head.output, head.output
    assert head.output.count("| Fatal Python error") == 1


@pytest.mark.slow
def test_hosts_meet_at_a_router_that_is_none_of_them(here: Run, parties, tmp_path: Path):
    graph, endpoint = tmp_path / "graph.yaml", free_address()
    graph.write_text(f"router: {endpoint}\n{HOSTS.read_text()}")
    assert main(["keys", "init", str(graph)]) == 0
    router = zenoh.open(zenoh.Config.from_file(str(tmp_path / "keys" / "router" / "zenohd.json5")))
    party = parties(on_loopback(), tmp_path, ("--set", f"keys={tmp_path / 'keys'}"), graph=graph).start_all()
    assert_same_result(party.end("head"), here)
    router.close()


# ---------------------------------------------------------------------------------------------- in namespaces


@pytest.mark.slow
@pytest.mark.parametrize("router", [(), ("--set", "router=head")], ids=["direct", "routed"])
def test_three_machines_with_keys_give_the_bytes_of_one(here, namespaces, parties, tmp_path: Path, router):
    options = (*with_keys(namespaces, tmp_path / "keys"), *router)
    party = parties(namespaces, tmp_path, options).start_all()
    head = party.end("head")
    assert_same_result(head, here)
    steps = Recording(head.recording).steps
    assert not any(step.travelled_ns for step in steps if step.stage == "worker")  # clocks of two are not compared
    assert any(step.travelled_ns for step in steps if step.stage != "worker")
    assert [party.end(name).code for name in NAMES[1:]] == [0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("router", [(), ("--set", "router=head")], ids=["direct", "routed"])
def test_a_machine_that_is_cut_off_in_mid_frame_loses_nothing(here, namespaces, parties, tmp_path: Path, router):
    options = (*with_keys(namespaces, tmp_path / "keys"), *router)
    party = parties(namespaces, tmp_path, options, gated(tmp_path)).start_all(*SLOW_PIECES, gate(tmp_path))
    before = read_until(party.hosts["head"], "sum")
    namespaces.cut("worker1")
    try:
        before += read_until(party.hosts["head"], "is cut off")
        (tmp_path / "go").touch()
        head = party.end("head", before)
        worker = party.end("worker1")
    finally:
        namespaces.mend("worker1")
    assert "host worker1 is cut off, with 1 processes" in head.output
    assert_same_result(head, here)
    assert (worker.code, "the connection to head is gone" in worker.output) == (1, True), worker.output
    assert processes_of(tmp_path) == []


@pytest.mark.slow
def test_a_machine_that_comes_back_disturbs_nobody(here, namespaces, parties, tmp_path: Path):
    party = parties(namespaces, tmp_path, with_keys(namespaces, tmp_path / "keys"), gated(tmp_path))
    party.start_all("worker.seconds=1.2", gate(tmp_path))
    before = read_until(party.hosts["head"], "sum")
    namespaces.cut("worker1")
    before += read_until(party.hosts["head"], "host worker1 is cut off")
    namespaces.mend("worker1")
    cut_off = party.hosts.pop("worker1")
    party.start("worker1")
    before += read_until(party.hosts["head"], "host worker1 is back")
    (tmp_path / "go").touch()
    head = party.end("head", before)
    assert_same_result(head, here)
    assert cut_off.wait(60) == 1
    cut_off.communicate()
    assert processes_of(tmp_path) == []
