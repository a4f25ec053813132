"""Runs a graph: starts one process per stage and replica, restarts what crashes, and ends everything together."""

import contextlib
import itertools
import os
import queue
import secrets
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from runner import codec
from runner.backpressure import skipped
from runner.bus import RECORDER, Bus, Packet, Presence, Process, free_endpoint
from runner.calls import CallQuestion, CallRequest, Calls
from runner.children import DUMP, last_lines, signal_group, spawn
from runner.codec import CodecError, Envelope, LogLine, Pulse, Receipt, Step
from runner.contract import Finished, Level, Message, Refused, Restarted
from runner.delivery import Delivery
from runner.document import suggest
from runner.family import Child, Progress, end_all
from runner.graph import FINISHED, SUPERVISOR, Graph, graph_to_json, node_entry
from runner.health import Pulses, Watch
from runner.host import EXIT_REFUSED, Assignment
from runner.hosts import Hosts
from runner.info import stage_times
from runner.network import ALONE
from runner.ports import port_name
from runner.recorder import Manifest, topic
from runner.refusals import Refusals, admit, require_genuine
from runner.registry import Entry, Registration, runs
from runner.status import ProcessStatus, Rates, RunStatus, topics_of
from runner.terminal import Terminal

STAGE_GRACE_SECONDS = 2.0
"""What a stage may take to finish its step before it is killed."""
RECORDER_GRACE_SECONDS = 30.0
"""What the recorder may take to write what waits for the disk."""
TICK_SECONDS = 0.05
DUMP_SECONDS = 0.5
"""What a hung process gets to print where it hangs before it is killed."""
SETTLE_SECONDS = 30.0
"""How long a successor waits at most for the recorder's word that it has all that the dead process has sent."""
RETIRE_SECONDS = 30.0
"""What a process that is asked to restart may take for its present step; a killed step is done again."""
ASKED = "asked to restart"
SHOWN_LINES = 16
EXIT_INCOMPLETE = 3


@dataclass(frozen=True, slots=True)
class End:
    """Why the graph ended."""

    code: int
    reason: str


class Supervisor:
    """One run of a graph."""

    def __init__(
        self,
        graph: Graph,
        *,
        file: Path,
        recordings: Path,
        settings: tuple[str, ...],
        terminal: Terminal,
        steps_only: bool = False,
    ):
        """Makes the folder of the run and lists it; raises Refused where that is not possible.

        ``file`` is where the graph was read from. Where it names hosts, this machine is the head. With ``steps_only``
        no messages are recorded.
        """
        self._graph = graph
        self._settings = settings
        self._steps_only = steps_only
        self._terminal = terminal
        self._hosts = None if graph.layout == ALONE else Hosts(graph.name, file, graph.layout, self._say)
        self._run, self.recording = _new_recording(recordings, graph.name)
        self.directory = self.recording.with_suffix("")
        self._network = self._hosts.network if self._hosts else None
        self._endpoint = self._hosts.endpoint if self._hosts else free_endpoint()
        listen, connect = (self._hosts.listen(), self._endpoint) if self._hosts else (self._endpoint, None)
        self._secret = secrets.token_hex(16)
        self._bus = Bus(self._run, listen=listen, connect=connect, network=self._network, secret=self._secret)
        self._entry = Entry(
            run=self._run,
            endpoint=listen or self._endpoint,
            pid=os.getpid(),
            graph=str(file.absolute()),
            recording=str(self.recording.absolute()),
            started=time.time(),
            secret=self._secret,
            network=self._network,
        )
        self._registration = Registration(self._entry)
        self._stopping = threading.Event()
        self._delivery = Delivery(graph.routes(SUPERVISOR), self._bus.publish, self._warn, self._stopping.is_set)
        self._events: queue.SimpleQueue[End] = queue.SimpleQueue()
        self._progress: dict[str, Progress] = defaultdict(Progress)
        self._steps: list[Step] = []
        self._children: dict[tuple[str, int], Child] = {}
        self._recorder: Child | None = None
        self._viewer: Child | None = None
        self._presence = Presence()
        self._pulses = Pulses()
        self._refusals = Refusals(self._complain)
        self._rates = Rates()
        self._settled: set[Process] = set()
        """Dead processes of which the recorder has everything."""
        self._numbers: dict[str, int] = defaultdict(int)
        """Next sequence number by output port of the supervisor."""
        self._numbering = threading.Lock()
        self._calls = Calls(graph, self._publish)
        self._absent = set(graph.processes())
        self._was_ready = False

    def run(self, *, view: bool = False) -> End:
        """Runs the graph to its end, with the viewer if wanted, and leaves no process behind."""
        for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signum != signal.SIGHUP or signal.getsignal(signum) != signal.SIG_IGN:  # which nohup has asked for
                signal.signal(signum, lambda number, _: self._events.put(End(128 + number, "interrupted")))
        self._connect()
        self._terminal.show(SUPERVISOR, f"run {self._run} on {self._endpoint}")
        try:
            self._recorder = self._start_recorder()
            if view and self._presence.wait_for([(RECORDER, 0)], self._recorder_died):
                self._viewer = self._start_viewer()
            if self._hosts is not None:
                self._hosts.open(self._run, self.recording)
            for stage, replica in self._graph.processes():
                self._children[stage, replica] = self._start(Process(stage, replica))
            end = self._watch()
        finally:
            verdict = self._stop()
        return self._dismiss(self._conclude(end, verdict))

    # ------------------------------------------------------------------------------------------ what is heard

    def _connect(self) -> None:
        for consumer in {route.consumer for route in self._graph.routes(SUPERVISOR)}:
            self._bus.subscribe(f"r/{consumer}", self._on_receipt)
        self._bus.subscribe("j/*", self._on_step)
        self._bus.subscribe("l/*", self._on_log)
        self._bus.subscribe(f"m/*/{FINISHED}", self._on_finished)
        self._bus.subscribe("gone/**", self._on_gone)
        self._bus.subscribe("h/**", self._on_pulse)
        for key in self._calls.answer_keys:
            self._bus.subscribe(f"m/{key}", self._on_answer)
        self._serve()
        self._bus.watch(self._on_presence, self._refusals.refuse)

    def _on_step(self, packet: Packet) -> None:
        step = self._refusals.read(Step, packet)
        if step is not None:
            self._progress[step.stage].note(step)
            self._steps.append(step)
            if step.outcome == "done":
                self._delivery.acknowledge(step.stage, step.consumed)
                self._calls.note_step(step)

    def _on_answer(self, packet: Packet) -> None:
        envelope = self._refusals.read(Envelope, packet)
        if envelope is not None:
            self._calls.note_answer(envelope.id, packet.payload)

    def _on_receipt(self, packet: Packet) -> None:
        receipt = self._refusals.read(Receipt, packet)
        if receipt is not None and receipt.consumed:
            self._delivery.acknowledge(packet.end, [(receipt.port, receipt.id)])

    def _on_log(self, packet: Packet) -> None:
        line = self._refusals.read(LogLine, packet)
        if line is not None:
            self._calls.note_log(line)
            if line.stage != SUPERVISOR and line.level != "debug":
                self._terminal.show(self._name_of(line.stage, line.replica), line.text, line.level)

    def _on_finished(self, packet: Packet) -> None:
        try:
            finished = codec.open_envelope(Finished, admit(Envelope, packet))
        except CodecError as error:
            self._refusals.refuse(packet.key, error)
        else:
            self._events.put(End(finished.code, finished.reason))

    def _on_gone(self, packet: Packet) -> None:
        try:
            require_genuine(packet)
            self._settled.add(Process.of(packet.key))
        except (CodecError, Refused) as error:
            self._refusals.refuse(packet.key, error)

    def _on_pulse(self, packet: Packet) -> None:
        pulse = self._refusals.read(Pulse, packet)
        if pulse is not None:
            self._pulses.note(pulse)
            self._rates.note(pulse, packet.arrived_ns)

    def _on_presence(self, process: Process, present: bool) -> None:
        self._delivery.update(process, present)
        self._presence.update(process, present)
        if present and self._recorder is not None and process == self._recorder.process:
            self._recorder.announced = True
            self._say_when_all_are_ready()
        child = self._children.get((process.stage, process.replica))
        if not present or child is None or child.process != process:
            return
        child.ready_after = time.monotonic() - child.started
        child.announced = True
        self._terminal.show(self._name_of(process.stage, process.replica), f"ready after {child.ready_after:.1f} s")
        self._absent.discard((process.stage, process.replica))
        self._say_when_all_are_ready()

    def _say_when_all_are_ready(self) -> None:
        if not self._was_ready and self._is_ready():
            self._was_ready = True
            self._terminal.show(SUPERVISOR, f"all {len(self._children)} processes are ready")

    # ------------------------------------------------------------------------------------------ processes

    def _start_recorder(self) -> Child:
        topics = {
            f"{stage}/{port}": topic(kind)
            for stage in (*self._graph.nodes, SUPERVISOR)
            for port, kind in self._graph.outputs_of(stage).items()
        }
        graph = graph_to_json(self._graph)
        task = Manifest(
            self._run,
            self._endpoint,
            str(self.recording),
            graph,
            self._settings,
            topics,
            network=self._network,
            secret=self._secret,
            steps_only=self._steps_only,
        )
        return self._spawn(Process(RECORDER, 0), "runner.recorder", msgspec.json.encode(task))

    def _start(self, process: Process) -> Child:
        progress = self._progress[process.stage]
        task = Assignment(
            run=self._run,
            endpoint=self._endpoint,
            directory=str(self.directory.absolute()),
            stage=process.stage,
            entry=node_entry(self._graph.nodes[process.stage]),
            seed=self._graph.seed,
            routes=tuple(self._graph.routes(process.stage)),
            processes=tuple(self._graph.processes()),
            replica=process.replica,
            incarnation=process.incarnation,
            numbers=progress.numbers,
            started=progress.started,
            consumed=tuple(progress.consumed),
            network=self._network,
            secret=self._secret,
            past=str(self.recording.absolute()) if process.incarnation > 0 and self._remembers(process.stage) else "",
        )
        host = self._graph.host_of(process.stage, process.replica)
        if self._hosts is not None and host is not None and host != self._hosts.network.host:
            log = self._log_of(process)
            child = Child(process, self._hosts.start(host, process, task, log), log)
        else:
            child = self._spawn(process, "runner.host", msgspec.json.encode(task))
        child.watch = self._watch_of(process)
        return child

    def _watch_of(self, process: Process) -> Watch:
        return Watch(self._graph.nodes[process.stage].limits)

    def _remembers(self, stage: str) -> bool:
        kind = self._graph.nodes[stage].type.cls
        return kind.stateful and not kind.device

    def _spawn(self, process: Process, module: str, task: bytes) -> Child:
        log = self._log_of(process)
        log_from = log.stat().st_size if log.exists() else 0
        return Child(process, spawn(module, task=task, log=log), log, log_from=log_from)

    def _log_of(self, process: Process) -> Path:
        return self.directory / "log" / f"{process.stage}-{process.replica}.txt"

    def _start_viewer(self) -> Child:
        log = self.directory / "log" / "viewer.txt"
        handle = spawn("runner.cli", "view", "--live", str(self.recording), task=b"", log=log)
        self._terminal.show(SUPERVISOR, f"the viewer opens; without a display its address is in {log}")
        return Child(Process("viewer", 0), handle, log)

    def _recorder_died(self) -> bool:
        return self._recorder is not None and self._recorder.handle.poll() is not None

    def _watch(self) -> End:
        """Waits for the end, and replaces what crashes meanwhile."""
        while True:
            with contextlib.suppress(queue.Empty):
                end = self._events.get(timeout=TICK_SECONDS)
                self._name_the_dead()
                return end
            end = self._look_after_children()
            if end is not None:
                return end

    def _name_the_dead(self) -> None:
        """Of what died just before the end, and is not replaced."""
        for child in self._children.values():
            if child.handle.poll() and child.heir is None:
                name = self._name_of(child.process.stage, child.process.replica)
                self._say(f"{name} died meanwhile: {child.reason(self._pulses.of(child.process))}", "warning")
                self._show_output(child)

    def _look_after_children(self) -> End | None:
        if self._recorder is not None:
            self._check(self._recorder)
            if self._recorder_died():
                return End(1, f"the recorder {self._recorder.reason()}")
        for child in list(self._children.values()):
            if child.handle.poll() is None:
                self._check(child)
            elif child.heir is not None:
                self._succeed(child, *child.heir)
            elif (end := self._replace(child)) is not None:
                return end
        return None if self._hosts is None else self._look_after_hosts(self._hosts)

    def _look_after_hosts(self, hosts: Hosts) -> End | None:
        """Says who is waited for; ends the graph where one that is needed stays away."""
        for child in self._children.values():
            if hosts.waits(child.process):
                child.started, child.watch = time.monotonic(), self._watch_of(child.process)
        hosts.remind()
        reason = hosts.overdue(self._graph.hosts_of_stages())
        return None if reason is None else End(1, reason)

    def _check(self, child: Child) -> None:
        """Kills a process that hangs or has grown too large, after it has said where it is."""
        now, name = time.monotonic(), self._name_of(child.process.stage, child.process.replica)
        change = child.watch.look(now, self._pulses.of(child.process), ready=child.announced)
        if change:
            self._say(f"{name} {change}", "warning")
        if not child.condemned and (fault := child.watch.fault()):
            child.condemned, child.dies_at = fault, now + DUMP_SECONDS
            self._say(f"{name} is killed: {fault}", "warning")
            child.handle.send_signal(DUMP)
        if now > min(child.dies_at, child.retires_by or child.dies_at):
            signal_group(child.handle, signal.SIGKILL)

    def _replace(self, child: Child) -> End | None:
        """Restarts a dead process within its budget; otherwise says why the graph ends."""
        process, name = child.process, self._name_of(child.process.stage, child.process.replica)
        reason = child.reason(self._pulses.of(process))
        if child.handle.returncode == EXIT_REFUSED:
            return End(EXIT_REFUSED, f"{name}: {reason}")
        if child.retires_by is not None and not child.condemned:
            self._say(f"{name} was {ASKED}", "info")
            self._mourn(child, ASKED, child.crashes)
            return None
        # What a stage remembers is rebuilt from recorded messages.
        forgets = self._steps_only and self._remembers(process.stage)
        budget = 0 if forgets else self._graph.nodes[process.stage].restarts
        if (process.stage, process.replica) in self._absent or child.crashes >= budget:
            when = "at start-up" if (process.stage, process.replica) in self._absent else f"after {budget} restarts"
            self._show_output(child)
            return End(1, f"{name} failed {when}: {reason}")
        self._say(f"{name} restarts ({child.crashes + 1} of {budget}): {reason}", "warning")
        self._show_output(child)
        self._mourn(child, reason, child.crashes + 1)
        return None

    def _mourn(self, child: Child, reason: str, crashes: int) -> None:
        """Tells everybody that a process is replaced. What it leaves behind must be known first."""
        child.heir, child.dies_at = (reason, crashes), time.monotonic()
        self._publish_restart(child.process, reason)

    def _succeed(self, child: Child, reason: str, crashes: int) -> None:
        """Puts a new process in the place of one that has gone, once the recorder has all that it has sent."""
        process = child.process
        waits = child.announced and process not in self._settled
        if waits and time.monotonic() < child.dies_at + SETTLE_SECONDS:
            return
        successor = self._start(Process(process.stage, process.replica, process.incarnation + 1))
        successor.restarted_because, successor.crashes = reason, crashes
        self._children[process.stage, process.replica] = successor

    def _publish_restart(self, process: Process, reason: str) -> None:
        self._publish(port_name(Restarted), Restarted(stage=process.stage, replica=process.replica, reason=reason))

    def _publish(self, port: str, message: Message, say: Callable[[str], object] = lambda _: None) -> None:
        """Sends a message of the supervisor's own; ``say`` is told its id before anybody else."""
        with self._numbering:
            own = f"{SUPERVISOR}.{port}#{self._numbers[port]}"
            self._numbers[port] += 1
        say(own)
        envelope = codec.envelope(message, id=own, lineage=own, time_ns=time.time_ns(), causes=())
        payload = codec.pack(envelope)
        self._bus.publish(f"m/{SUPERVISOR}/{port}", payload)
        self._delivery.publish(port, envelope, payload)

    # ------------------------------------------------------------------------------------------ the end

    def _stop(self) -> str:
        """Stops the stages, then the recorder, and returns the recorder's verdict."""
        self._stopping.set()
        self._calls.close()
        end_all(list(self._children.values()), STAGE_GRACE_SECONDS)
        end_all([self._recorder] if self._recorder else [], RECORDER_GRACE_SECONDS)
        end_all([self._viewer] if self._viewer else [], STAGE_GRACE_SECONDS)
        self._bus.close()
        self._registration.close()
        return "" if self._recorder is None else self._recorder.reason()

    def _conclude(self, end: End, verdict: str) -> End:
        complete = self._recorder is not None and self._recorder.handle.returncode == 0
        if self._steps:
            self._terminal.plain("", *stage_times(self._steps), *skipped(self._graph, self._steps), "")
        self._terminal.plain(f"recording {verdict}")
        return end if complete or end.code else End(EXIT_INCOMPLETE, "the recording is INCOMPLETE")

    def _dismiss(self, end: End) -> End:
        """Tells the other hosts how it ended."""
        if self._hosts is not None:
            self._hosts.close(end.code, end.reason)
        return end

    # ------------------------------------------------------------------------------------------ what is asked

    def _serve(self) -> None:
        """Answers the live tools."""
        serve = self._bus.serve
        serve("status", lambda _: msgspec.json.encode(self._status()))
        serve("commands", lambda _: msgspec.json.encode(self._calls.types()))
        serve("call", lambda text: self._call(msgspec.json.decode(text, type=CallRequest)).encode())
        serve(
            "progress",
            lambda text: msgspec.json.encode(self._calls.progress(msgspec.json.decode(text, type=CallQuestion))),
        )
        serve("restart", lambda text: self._restart(text.decode()).encode())
        serve("down", self._down)

    def _down(self, _: bytes) -> bytes:
        self._events.put(End(0, "ended by runner down"))
        return b""

    def _call(self, request: CallRequest) -> str:
        if not self._is_ready():
            waited_for = sorted(self._name_of(*key) for key in self._absent) or [RECORDER]
            raise Refused(f"the graph is not ready yet: it waits for {', '.join(waited_for)}")
        return self._calls.call(request)

    def _restart(self, name: str) -> str:
        """Asks one process to finish and waits for its successor; returns what to tell the user."""
        found = {self._name_of(*key): key for key in self._graph.processes()}
        if name not in found:
            raise Refused(f"no process {name!r}{suggest(name, found)}")
        old = self._children.get(found[name])
        if old is None or not old.announced:
            raise Refused(f"{name} is not ready yet")
        old.retires_by = time.monotonic() + RETIRE_SECONDS
        old.handle.send_signal(signal.SIGUSR1)
        while (new := self._children[found[name]]) is old or not new.announced:
            if self._stopping.is_set():
                raise Refused(f"the graph ended before {name} was back")
            time.sleep(TICK_SECONDS)
        return f"{name} is back: process {new.handle.pid}, ready after {new.ready_after:.1f} s"

    def _is_ready(self) -> bool:
        """Whether everybody is there who must hear what is published, the recorder first."""
        return not self._absent and self._presence.wait_for([(RECORDER, 0)], lambda: True)

    def _status(self) -> RunStatus:
        children = [*filter(None, [self._recorder]), *list(self._children.values())]
        return RunStatus(
            run=self._run,
            graph=self._entry.graph,
            recording=self._entry.recording,
            endpoint=self._endpoint,
            started=self._entry.started,
            ready=self._is_ready(),
            processes=tuple(map(self._process_status, children)),
            topics=topics_of(self._graph),
            published={f"{SUPERVISOR}/{port}": number for port, number in list(self._numbers.items())},
        )

    def _process_status(self, child: Child) -> ProcessStatus:
        process = child.process
        pulse = self._pulses.of(process)
        state = self._rates.state(process.stage, process.replica) if pulse and child.announced else "starting"
        return ProcessStatus(
            stage=process.stage,
            replica=process.replica,
            name=self._name_of(process.stage, process.replica),
            state=state if child.handle.poll() is None else "ended",
            pid=child.handle.pid,
            restarts=process.incarnation,
            reason=child.restarted_because,
            pulse=pulse,
            cpu=self._rates.cpu(process.stage, process.replica),
            steps_per_second=self._rates.steps(process.stage, process.replica),
            sent=self._rates.sent(process.stage, process.replica),
        )

    # ------------------------------------------------------------------------------------------ what is said

    def _say(self, text: str, level: Level) -> None:
        self._terminal.show(SUPERVISOR, text, level)
        line = LogLine(SUPERVISOR, 0, level, text, time.time_ns())
        self._bus.publish(f"l/{SUPERVISOR}", codec.pack(line))

    def _complain(self, text: str) -> None:
        self._say(text, "error")

    def _warn(self, text: str) -> None:
        self._say(text, "warning")

    def _show_output(self, child: Child) -> None:
        name = self._name_of(child.process.stage, child.process.replica)
        for line in last_lines(child.log, SHOWN_LINES, child.log_from):
            self._terminal.show(name, f"| {line}", "error")

    def _name_of(self, stage: str, replica: int) -> str:
        node = self._graph.nodes.get(stage)
        return f"{stage}.{replica}" if node is not None and node.replicated else stage


def _new_recording(folder: Path, name: str) -> tuple[str, Path]:
    """A run id that is not taken and its recording; its folder is made."""
    base = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    taken = {entry.run for entry in runs()}
    for attempt in itertools.count():
        run = f"{base}-{attempt}" if attempt else base
        if run in taken:
            continue
        try:
            (folder / run / "log").mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise Refused(f"{folder / run}: {error.strerror}") from None
        return run, folder / f"{run}.mcap"
    raise AssertionError
