"""What goes wrong is found, explained and repaired, and changes no byte of what a graph answers."""

import contextlib
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from runner.live.live import Live
from runner.message.ids import MessageId
from runner.process.children import DESCENT, Descendants
from runner.process.forks import clean_environment
from runner.recording.recording import Recording
from runner.supervise.registry import runs
from runner.testing import read_until
from tests.runner.common.machines import Party, on_loopback
from tests.runner.common.runs import ALBUM, DOUBLES, TOYS, Run, changed, finish, pid_of, processes_of, run, start
from tests.runner.common.survivors import lives, living
from tests.runner.common.waiting import wait_until
from tests.runner.replay.test_replay import verify

ENDLESS = ("counter.count=100000", "counter.period=0.005", "sink.count=100000")


def bodies(one: Run) -> dict[str, bytes]:
    return {envelope.id: bytes(envelope.body) for envelope in Recording(one.recording).envelopes()}


def test_every_trouble_is_explained_and_changes_no_byte(tmp_path: Path):
    calm, rough = tmp_path / "calm", tmp_path / "rough"
    calm.mkdir()
    rough.mkdir()
    undisturbed = run(TOYS, calm)
    troubles = [f"worker.{trouble}_at={at}" for at, trouble in enumerate(("crash", "kill", "stop", "loop", "grow"))]
    limits = ("worker.heartbeat=4", "worker.timeout=6", "worker.memory=0.3GB", "worker.restarts=9")
    disturbed = run(changed(TOYS, rough, Worker="Troubled"), rough, f"worker.marks={rough}", *troubles, *limits)
    assert (disturbed.code, disturbed.result) == (0, undisturbed.result), disturbed.output
    for reason in (
        r"killed by SIGSEGV",
        r"killed by SIGKILL",
        r"hung: no sign of life for 4 s \(heartbeat\)",
        r"hung: on_piece has computed for more than 6 s \(timeout\)",
        r"out of memory: it holds \d[^,]*, its limit is 0.3GB \(memory\)",
    ):
        assert re.search(rf"supervisor +worker\.\d (restarts \(\d of 9\)|is killed): {reason}", disturbed.output), (
            disturbed.output
        )
    assert "| Fatal Python error: Segmentation fault" in disturbed.output
    assert re.search(r'\| +File ".*survivors.py", line \d+ in loop', disturbed.output)
    recorded = bodies(disturbed)
    assert {id: recorded[id] for id in bodies(undisturbed)} == bodies(undisturbed)
    assert Recording(disturbed.recording).verdict.complete
    code, said = verify(disturbed.recording)
    assert code == 0, said
    assert processes_of(rough) == []


@pytest.mark.slow
def test_a_start_up_that_never_ends_is_ended(tmp_path: Path):
    graph = changed(DOUBLES, tmp_path, Doubler="NeverReady")
    graph.write_text(graph.read_text().replace("double: doubler.double", "double: other.double") + OTHER)
    stuck = run(graph, tmp_path, "doubler.startup=10")
    assert stuck.code == 1
    assert stuck.output.splitlines()[-1] == "doubler failed at start-up: start-up hung: not ready after 10 s (startup)"
    assert "| loading the weights" in stuck.output
    assert processes_of(tmp_path) == []


OTHER = """
  other:
    stage: tests.runner.common.toys:Doubler
    inputs: {number: counter.number}
"""


@pytest.mark.slow
def test_an_exit_without_a_word_is_an_error(tmp_path: Path):
    silent = run(
        changed(TOYS, tmp_path, Worker="Troubled"),
        tmp_path,
        f"worker.marks={tmp_path}",
        "worker.exit_at=1",
        "worker.replicas=1",
    )
    assert silent.code == 0, silent.output
    assert re.search(r"worker restarts \(1 of 3\): ended with exit code 3", silent.output)


SEEN_FIRST = """
import sys, threading
from runner.cli.main import main
from runner.message.packet import GATEWAY, RECORDER
from runner.process.fork_server import ForkServer
from runner.supervise.guardian import Guardian
start, note, seen = ForkServer.start, Guardian.note_presence, threading.Semaphore(0)
def start_late(self, module, name, **more):
    handle = start(self, module, name, **more)
    if name != RECORDER:  # which is there once all others are
        seen.acquire()
    return handle
def note_early(self, process, present):
    note(self, process, present)
    if process.stage not in (GATEWAY, RECORDER):
        seen.release()
ForkServer.start, Guardian.note_presence = start_late, note_early
sys.exit(main(sys.argv[1:]))
"""


def test_a_process_may_be_there_before_who_started_it_goes_on(tmp_path: Path):
    command = [sys.executable, "-c", SEEN_FIRST, "up", str(DOUBLES), "--verbose", "--recordings", str(tmp_path)]
    command += ["--set", f"sink.path={tmp_path / 'out.txt'}", "--set", "doubler.die_at=2"]
    done = subprocess.run(command, env=clean_environment(), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    ready = re.findall(r"(\w+) +ready after", done.stdout)
    assert sorted(ready) == ["counter", "doubler", "doubler", "sink"], done.stdout
    assert "all 3 processes are ready" in done.stdout


def test_without_its_recorder_a_graph_ends(tmp_path: Path):
    process = start(DOUBLES, tmp_path, *ENDLESS)
    before = read_until(process, "processes are ready")
    os.kill(pid_of(tmp_path, "recorder-0"), signal.SIGKILL)
    ended = finish(process, tmp_path, before)
    assert (ended.code, ended.output.splitlines()[-1]) == (1, "the recorder killed by SIGKILL")
    assert not Recording(ended.recording).verdict.complete
    assert processes_of(tmp_path) == []


@pytest.mark.parametrize("killed", [False, True])
def test_a_run_whose_folder_is_moved_ends_in_order(tmp_path: Path, killed: bool):
    folder, moved = tmp_path / "here", tmp_path / "there"
    folder.mkdir()
    period = 2.0 if killed else 0.05  # what a process sends as it is killed may be lost
    process = start(
        DOUBLES, folder, "counter.count=40", f"counter.period={period}", "sink.count=40", f"sink.path={os.devnull}"
    )
    before = read_until(process, "processes are ready")
    folder.rename(moved)
    if killed:
        doubler = pid_of(moved, "doubler-0")
        (recording,) = moved.glob("*.mcap")
        wait_until(lambda: "doubler.double#0" in Recording(recording).messages)
        os.kill(doubler, signal.SIGKILL)
    ended = finish(process, moved, before)
    match = re.search(r"run (\S+) on unixsock-stream/(\S+)", before)
    assert match is not None
    last = ended.output.splitlines()[-1]
    assert "Traceback" not in ended.output
    if killed:
        assert (ended.code, last.partition(": ")[0]) == (2, "doubler cannot be started"), ended.output
    else:
        assert (ended.code, last) == (0, "40 doubles"), ended.output
    assert Recording(ended.recording).verdict.complete
    assert match[1] not in [entry.run for entry in runs()]
    assert not Path(match[2]).parent.exists()
    assert processes_of(tmp_path) == []


def test_without_its_fork_server_a_graph_goes_on(tmp_path: Path):
    graph, go = changed(DOUBLES, tmp_path, Counter="GatedCounter"), tmp_path / "go"
    process = start(graph, tmp_path, f"counter.go={go}", "counter.count=60", "counter.period=0.05", "sink.count=60")
    before = read_until(process, "processes are ready")
    (server,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()[:1]
    assert "fork_server" in Path(f"/proc/{server}/cmdline").read_text()
    os.kill(int(server), signal.SIGKILL)
    os.kill(pid_of(tmp_path, "doubler-0"), signal.SIGKILL)
    go.touch()
    ended = finish(process, tmp_path, before)
    assert (ended.code, ended.result) == (0, [str(2 * number) for number in range(60)]), ended.output
    assert re.search("supervisor +the fork server killed by SIGKILL; from now on every process imports", ended.output)
    assert re.search(r"supervisor +doubler restarts \(1 of 3\): killed by SIGKILL", ended.output)
    assert Recording(ended.recording).verdict.complete
    assert processes_of(tmp_path) == []


def test_a_stage_that_remembers_gets_its_memory_back(tmp_path: Path):
    calm, rough = tmp_path / "calm", tmp_path / "rough"
    calm.mkdir()
    rough.mkdir()
    undisturbed = run(changed(DOUBLES, calm, Doubler="Adder"), calm, f"doubler.marks={calm}")
    disturbed = run(changed(DOUBLES, rough, Doubler="Adder"), rough, f"doubler.marks={rough}", "doubler.die_at=[2, 4]")
    assert (disturbed.code, disturbed.result) == (0, undisturbed.result), disturbed.output
    assert disturbed.output.count("restarts (") == 2
    assert all(body == bodies(undisturbed)[id] for id, body in bodies(disturbed).items() if "double" in id)
    code, said = verify(disturbed.recording)
    assert code == 0, said


def test_what_a_device_does_again_has_ids_of_its_own(tmp_path: Path):
    settings = ("counter.restarts=1", f"counter.taken={tmp_path / 'out.txt'}", "sink.count=6")
    ended = run(changed(DOUBLES, tmp_path, Counter="Starter"), tmp_path, *settings)
    assert (ended.code, ended.result) == (0, ["0", "2", "4", "20", "22", "24"]), ended.output
    recording = Recording(ended.recording)
    assert recording.verdict.complete, recording.verdict
    assert [id for id in recording.messages if "counter" in id] == [f"counter.number#{number}" for number in range(6)]
    code, said = verify(ended.recording)
    assert code == 0, said


DIES_WITH_ANOTHER = """
  other:
    stage: tests.runner.common.survivors:DiesWithAnother
    inputs: {restarted: {from: supervisor.restarted, queue: 1}}
"""


def test_who_replaces_the_dead_waits_for_none_of_them(tmp_path: Path):
    graph = tmp_path / "graph.yaml"
    graph.write_text(DOUBLES.read_text() + DIES_WITH_ANOTHER)
    settings = ("counter.count=60", "counter.period=0.05", "sink.count=60", "doubler.die_at=2")
    ended = run(graph, tmp_path, *settings)
    assert (ended.code, len(ended.result)) == (0, 60), ended.output
    assert re.findall(r"(\w+) restarts \(1 of 3\): killed by SIGKILL", ended.output) == ["doubler", "other"]
    assert Recording(ended.recording).verdict.complete


def test_a_successor_hears_what_every_replica_is_to_hear_though_another_one_has_heard_it(tmp_path: Path):
    graph = changed(TOYS, tmp_path, Worker="Listener", Counter="GatedCounter")
    pieces = "      piece: splitter.piece\n"
    graph.write_text(graph.read_text().replace(pieces, f"{pieces}      heard: counter.number\n"))

    def heard() -> list[tuple[int, str]]:
        """Of all numbers but the last, before which the graph may end."""
        steps = Recording(next(tmp_path.glob("*.mcap"))).steps
        consumed = [
            (step, id) for step in steps if step.outcome == "done" for port, id in step.consumed if port == "heard"
        ]
        return [(step.replica, id) for step, id in consumed if id != "counter.number#60"]

    process = start(graph, tmp_path, "counter.count=61", "counter.period=0.05", f"counter.go={tmp_path / 'go'}")
    before = read_until(process, "processes are ready")
    wait_until(lambda: len(heard()) >= 120)
    (tmp_path / "go").touch()
    ended = finish(process, tmp_path, before)
    assert (ended.code, len(ended.result)) == (0, 61), ended.output
    assert len(re.findall(r"worker\.\d restarts \(1 of 3\): killed by SIGKILL", ended.output)) == 1, ended.output
    recording = Recording(ended.recording)
    assert recording.verdict.complete, recording.verdict
    assert len(heard()) == len(set(heard())) == 120


@pytest.mark.parametrize("way", ["quit", "interrupt"])
def test_a_handler_that_leaves_the_process_has_failed(tmp_path: Path, way: str):
    left = run(changed(DOUBLES, tmp_path, Doubler="Quitter"), tmp_path, f"doubler.way={way}")
    name = {"quit": "SystemExit", "interrupt": "KeyboardInterrupt"}[way]
    assert (left.code, left.result) == (0, ["0", "2", "4", "6", "8"]), left.output
    assert re.search(rf"doubler restarts \(1 of 3\): {name}: 2 \(tests/runner/common/survivors.py:", left.output), (
        left.output
    )
    recording = Recording(left.recording)
    assert recording.verdict.complete
    assert [step.outcome for step in recording.steps if step.stage == "doubler"].count("failed") == 1


def test_what_a_publisher_took_with_it_is_sent_again(tmp_path: Path):
    """Killed right after it has sent, again and again: to some consumers it has, to others it has not."""
    calm, rough = tmp_path / "calm", tmp_path / "rough"
    calm.mkdir()
    rough.mkdir()
    undisturbed = run(TOYS, calm, "counter.count=20")
    graph = changed(TOYS, rough, Splitter="FragileSplitter")
    disturbed = run(graph, rough, "counter.count=20", f"splitter.marks={rough}", "splitter.restarts=20")
    assert (disturbed.code, disturbed.result) == (0, undisturbed.result), disturbed.output
    assert disturbed.output.count("splitter restarts (") == 10
    assert Recording(disturbed.recording).verdict.complete
    code, said = verify(disturbed.recording)
    assert code == 0, said


# ------------------------------------------------------------------------------------ back-pressure


def test_a_consumer_that_stands_still_for_longer_than_five_seconds_loses_nothing(tmp_path: Path):
    graph, go = changed(DOUBLES, tmp_path, Counter="GatedCounter"), tmp_path / "go"
    process = start(graph, tmp_path, f"counter.go={go}", "counter.count=60", "counter.waits=1", "sink.count=60")
    before = read_until(process, "processes are ready")
    doubler, began = pid_of(tmp_path, "doubler-0"), time.monotonic()
    os.kill(doubler, signal.SIGSTOP)
    go.touch()
    before += read_until(process, "doubler is slow")
    time.sleep(1.5)
    os.kill(doubler, signal.SIGCONT)
    before += read_until(process, "doubler goes on after")
    stood = time.monotonic() - began
    ended = finish(process, tmp_path, before)
    assert (ended.code, ended.result) == (0, [str(2 * number) for number in range(60)]), ended.output
    assert re.search(r"supervisor +doubler is slow: no sign of life for 5", ended.output), ended.output
    (silent,) = re.findall(r"supervisor +doubler goes on after ([\d.]+) s", ended.output)
    assert 6 < float(silent) < stood + 1, ended.output
    assert "restarts (" not in ended.output
    assert Recording(ended.recording).verdict.complete


def test_whoever_wants_the_latest_holds_nobody_up(tmp_path: Path):
    process = start(ALBUM, tmp_path, f"camera.go={tmp_path / 'go'}")
    before = read_until(process, "processes are ready")
    glance = pid_of(tmp_path, "glance-0")
    os.kill(glance, signal.SIGSTOP)
    (tmp_path / "go").touch()
    ended = finish(process, tmp_path, before)
    assert (ended.code, ended.result) == (0, [str(number) for number in range(60)]), ended.output
    assert "glance.picture: 60 of 60 messages skipped (policy latest)" in ended.output
    assert Recording(ended.recording).verdict.complete
    assert processes_of(tmp_path) == []


@pytest.mark.slow
def test_a_slow_consumer_of_the_latest_works_on_the_newest(tmp_path: Path):
    ended = run(ALBUM, tmp_path, "glance.seconds=0.5", "camera.size=100000", "camera.count=200")
    assert (ended.code, len(ended.result)) == (0, 200), ended.output
    assert re.search(r"glance.picture: 1\d\d of 200 messages skipped \(policy latest\)", ended.output)
    recording = Recording(ended.recording)
    assert recording.verdict.complete
    seen = [id for step in recording.steps if step.stage == "glance" for _, id in step.consumed]
    assert seen == sorted(seen, key=MessageId.of)


# ------------------------------------------------------------------------------------ shutdown


def test_a_graph_that_ends_before_a_successor_knows_what_is_left_lacks_nothing(tmp_path: Path):
    """It is to hear that once its publisher sends to it, which stands still."""
    process = start(DOUBLES, tmp_path, *ENDLESS, "doubler.seconds=2")
    before = read_until(process, "processes are ready")
    wait_until(lambda: "doubler.double#0" in Recording(next(tmp_path.glob("*.mcap"))).messages)
    os.kill(pid_of(tmp_path, "counter-0"), signal.SIGSTOP)
    os.kill(pid_of(tmp_path, "doubler-0"), signal.SIGKILL)
    before += read_until(process, "ready after")
    os.kill(process.pid, signal.SIGINT)
    ended = finish(process, tmp_path, before)
    recording = Recording(ended.recording)
    assert (ended.code, recording.verdict.complete) == (130, True), recording.verdict
    assert processes_of(tmp_path) == []


def test_an_interrupt_is_heard_while_a_stage_prepares(tmp_path: Path):
    process = start(changed(DOUBLES, tmp_path, Doubler="Preparing"), tmp_path, f"doubler.marks={tmp_path}")
    wait_until((tmp_path / "prepares").exists)
    with Live(next(entry for entry in runs() if Path(entry.recording).parent == tmp_path)) as live:
        wait_until(lambda: live.status().processes[0].pulse)  # so that the recorder hears the end
    (server,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()[:1]
    began = time.monotonic()
    os.kill(process.pid, signal.SIGINT)
    ended = finish(process, tmp_path)
    assert time.monotonic() - began < 30, "it has waited for the stage"
    recording = Recording(ended.recording)
    assert (ended.code, ended.output.splitlines()[-1]) == (130, "interrupted")
    assert recording.verdict.complete, recording.verdict
    assert not lives(int(server))
    assert processes_of(tmp_path) == []


def test_a_dying_terminal_ends_the_graph_in_order(tmp_path: Path):
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "runner.cli", "up", str(DOUBLES), "--verbose", "--recordings", str(tmp_path)]
    command += [part for setting in (f"sink.path={tmp_path / 'out.txt'}", *ENDLESS) for part in ("--set", setting)]
    script = "import fcntl, os, signal, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
    script += "signal.signal(signal.SIGHUP, signal.SIG_DFL); os.execv(sys.argv[1], sys.argv[1:])"
    process = subprocess.Popen(
        [sys.executable, "-c", script, *command], stdin=slave, stdout=slave, stderr=slave, start_new_session=True
    )
    os.close(slave)
    seen = b""
    while b"processes are ready" not in seen:
        seen += os.read(master, 4096)
    os.close(master)
    assert process.wait(60) == 128 + signal.SIGHUP
    assert Recording(next(tmp_path.glob("*.mcap"))).verdict.complete
    assert processes_of(tmp_path) == []


def test_a_recorder_outlives_its_supervisor_to_say_so(tmp_path: Path):
    process = start(DOUBLES, tmp_path, *ENDLESS)
    read_until(process, "processes are ready")
    recording = next(tmp_path.glob("*.mcap"))
    wait_until((tmp_path / "out.txt").exists)
    process.kill()
    process.communicate()
    wait_until(lambda: processes_of(tmp_path) == [])
    ended = Recording(recording)
    assert not ended.verdict.complete
    assert ended.verdict.reason.startswith("the supervisor died")
    # A message on its way to several is killed with its publisher, whose step follows it to each of them.
    assert not {id for step in ended.steps for id in step.emitted} & set(ended.verdict.missing)


def test_children_that_still_start_die_with_their_supervisor_too(tmp_path: Path):
    process = start(DOUBLES, tmp_path, *ENDLESS)
    wait_until(lambda: len(processes_of(tmp_path)) > 0)
    process.kill()
    process.communicate()
    wait_until(lambda: processes_of(tmp_path) == [])


def test_a_closed_pipe_does_not_end_the_graph(tmp_path: Path):
    process = start(DOUBLES, tmp_path, "counter.count=20", "counter.period=0.05", "sink.count=20")
    assert process.stdout is not None
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(60) == 0
    assert len((tmp_path / "out.txt").read_text().splitlines()) == 20
    assert Recording(next(tmp_path.glob("*.mcap"))).verdict.complete


def test_what_is_bound_to_a_process_dies_with_it():
    script = "import subprocess, time; from runner.process.children import bound; "
    script += "child = subprocess.Popen(bound(['sleep', '600'])); print(child.pid, flush=True); time.sleep(600)"
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    wait_until(lambda: "sleep" in Path(f"/proc/{child}/cmdline").read_text())
    parent.kill()
    parent.communicate()
    wait_until(lambda: not lives(child))


def test_what_a_stage_has_started_dies_with_the_stage_and_with_the_run(tmp_path: Path):
    graph = changed(DOUBLES, tmp_path, Doubler="Parent")
    done = run(graph, tmp_path, f"doubler.marks={tmp_path}", "doubler.die_at=[2]")
    assert (done.code, done.result) == (0, ["0", "2", "4", "6", "8"]), done.output
    assert len((tmp_path / "started").read_text().split()) == 6
    assert living(tmp_path) == []
    for name in ("doubler", "the stages"):
        (line,) = re.findall(rf"supervisor +{name} left behind, ended now: (.*)", done.output)
        assert {"1 x sleep 1000", "1 x sleep 2000"} < set(line.split(", ")), done.output


def test_what_stages_have_started_dies_with_a_killed_supervisor(tmp_path: Path):
    process = start(changed(DOUBLES, tmp_path, Doubler="Parent"), tmp_path, *ENDLESS, f"doubler.marks={tmp_path}")
    read_until(process, "processes are ready")
    assert len(living(tmp_path)) == 3
    process.kill()
    process.communicate()
    wait_until(lambda: living(tmp_path) == [] and processes_of(tmp_path) == [])


@pytest.mark.slow
def test_what_stages_have_started_dies_with_a_killed_host(tmp_path: Path):
    graph = changed(DOUBLES, tmp_path, Doubler="Parent")
    text = graph.read_text().replace("Parent\n", "Parent\n    host: worker1\n")
    graph.write_text(f"hosts: {{head: 127.0.0.1:7447, worker1: 127.0.0.1}}\n{text}")
    with contextlib.closing(Party(on_loopback(), tmp_path, graph=graph)) as party:
        head = party.start("head", *ENDLESS, f"doubler.marks={tmp_path}")
        agent = party.start("worker1")
        read_until(head, "processes are ready")
        assert len(living(tmp_path)) == 3
        agent.kill()
        wait_until(lambda: living(tmp_path) == [])


def test_descendants_are_ended_and_no_others():
    descendants, other = Descendants(), Descendants()
    marks = ("worker/0/1", "worker/0/10", "worker/1/0")
    own = [_sleeper(descendants.mark(path)) for path in marks]
    nested = _sleeper(f"{descendants.mark('worker/1/0')} {other.mark('worker/0/1')}")
    foreign = _sleeper(other.mark("worker/0/1"))
    assert descendants.end("worker/0/1") == ["sleep 600"]
    assert [child.wait() for child in own[:1]] == [-signal.SIGTERM]
    assert [child.poll() for child in (*own[1:], nested, foreign)] == [None] * 4
    assert descendants.close() == ["sleep 600"] * 3
    assert [child.wait() for child in (*own[1:], nested)] == [-signal.SIGTERM] * 3
    assert foreign.poll() is None
    assert other.close() == ["sleep 600"]
    foreign.wait()


def _sleeper(descent: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(["sleep", "600"], env={**os.environ, DESCENT: descent})


# ------------------------------------------------------------------------------------ memory of the machine


@pytest.fixture
def small_group() -> Iterator[Path]:
    """A control group of the kernel with little memory; skipped where this user may not make one."""
    for parent, limit in (
        (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes"),
        (Path("/sys/fs/cgroup"), "memory.max"),
    ):
        group = parent / f"runner-test-{os.getpid()}"
        try:
            group.mkdir()
            (group / limit).write_text(str(SMALL_BYTES))
        except OSError:
            continue
        yield group
        wait_until(lambda group=group: not (group / "cgroup.procs").read_text())
        group.rmdir()
        return
    pytest.skip("needs the right to make a control group with a limit of memory")


SMALL_BYTES = 900_000_000


@pytest.mark.slow
def test_a_process_that_the_kernel_kills_for_memory_is_named(small_group: Path, tmp_path: Path):
    graph = changed(TOYS, tmp_path, Worker="Troubled")
    procs = small_group / "cgroup.procs"
    settings = (f"worker.marks={tmp_path}", "worker.grow_at=2", "worker.grow_bytes=3000000000", "worker.replicas=1")
    script = "import os, sys; from pathlib import Path; Path(sys.argv[1]).write_text(str(os.getpid())); "
    script += "sys.argv = ['runner', *sys.argv[2:]]; from runner.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", script, str(procs), "up", str(graph), "--recordings", str(tmp_path)]
    command += [part for setting in (f"sink.path={tmp_path / 'out.txt'}", *settings) for part in ("--set", setting)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(
        r"restarts \(1 of 3\): killed by SIGKILL: the kernel was out of memory; it last held \d", done.stdout
    )
    assert len((tmp_path / "out.txt").read_text().splitlines()) == 5


# ------------------------------------------------------------------------------------ viewers


@pytest.mark.slow
def test_a_viewer_that_stands_still_changes_nothing_and_is_gone_at_the_end(tmp_path: Path):
    settings = ("view=tests.runner.common.toy_views:ToyViews", "counter.period=0.1")
    process = start(TOYS, tmp_path, *settings, flags=("--view",))
    before = read_until(process, "the viewer opens")
    os.kill(pid_of(tmp_path, "viewer"), signal.SIGSTOP)
    ended = finish(process, tmp_path, before)
    assert (ended.code, len(ended.result)) == (0, 5), ended.output
    assert Recording(ended.recording).verdict.complete
    assert processes_of(tmp_path) == []
