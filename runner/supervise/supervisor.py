"""Runs a graph: hears its processes, speaks and answers for the run, and ends everything together."""

import contextlib
import itertools
import os
import queue
import signal
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import msgspec

from runner.contract import EXIT_REFUSED, Finished, Level, Message, Refused, Restarted
from runner.graph.graph import FINISHED, SUPERVISOR, Graph, Route
from runner.graph.placement import ALONE
from runner.graph.ports import port_name
from runner.hosts.head import Hosts
from runner.inspect.info import StageTimes
from runner.inspect.skipped import Skipped
from runner.message import codec
from runner.message.codec import CodecError, Envelope, Journal, LogLine, Lost, Outcome, Pulse, Step
from runner.message.packet import GATEWAY, Packet, Process
from runner.message.refusals import Refusals
from runner.process.delivery import Delivery, Stopped
from runner.process.fork_server import ForkServer, Interrupted
from runner.process.stage_process import RECORDED_SECONDS
from runner.supervise.calls import CallQuestion, CallRequest, Calls
from runner.supervise.guardian import TICK_SECONDS, End, Guardian
from runner.supervise.launch import Run
from runner.supervise.registry import Entry, Registration, naming, runs
from runner.supervise.status import RunStatus, topics_of
from runner.terminal import Terminal
from runner.transport.bus import Bus
from runner.transport.session import Gateway, new_endpoint, remove_sockets

EXIT_INCOMPLETE = 3


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
        forks: ForkServer,
        steps_only: bool = False,
    ):
        """Makes the folder of the run and lists it; raises Refused where that is not possible.

        ``file`` is where the graph was read from. Where it names hosts, this machine is the head. ``forks`` starts the
        processes of this machine. With ``steps_only`` no messages are recorded.
        """
        self._graph = graph
        self._terminal = terminal
        self._hosts = None if graph.layout == ALONE else Hosts(graph.name, file, graph.layout, self._say)
        self._calls = Calls(graph, self._publish)
        with naming():
            self.id, recording = _new_recording(recordings, graph.name)
            endpoint, network = (self._hosts.endpoint, self._hosts.network) if self._hosts else (new_endpoint(), None)
            gateway = new_endpoint(endpoint if network is None else "")
            entry = Entry(
                run=self.id,
                gateway=gateway,
                pid=os.getpid(),
                graph=str(file.absolute()),
                recording=str(recording.absolute()),
                started=time.time(),
            )
            self._registration = Registration(entry)
        self._run = run = Run(self.id, graph, recording, settings, endpoint, gateway, network, steps_only)
        self._own = Process(SUPERVISOR, 0)
        self._bus = Bus(self.id, endpoint, network=network, process=self._own, listen=network is None)
        self._gateway = Gateway(gateway, endpoint, network, graph.listen)
        self._gateway.announce(f"{self.id}/present/{Process(GATEWAY, 0).path}")
        self._stopping = threading.Event()
        warn = partial(self._say, level="warning")
        stopping = self._stopping.is_set
        self._delivery = Delivery(SUPERVISOR, _own_routes(graph), self._bus.publish, warn, stopping=stopping)
        self._events: queue.SimpleQueue[End] = queue.SimpleQueue()
        self._times, self._skipped = StageTimes(), Skipped(graph)
        self._refusals = Refusals(partial(self._say, level="error"))
        self._guardian = Guardian(
            run,
            self._hosts,
            terminal,
            forks,
            say=self._say,
            announce=partial(self._publish, port_name(Restarted)),
            declare_lost=self._declare_lost,
            stopping=lambda: not self._events.empty(),
        )
        self._numbers: dict[str, int] = defaultdict(int)
        """Next sequence number by output port of the supervisor."""
        self._numbering = threading.Condition()
        self._publishing = 0
        """Messages of the supervisor's own that have a number and no step yet."""
        self._journalling = threading.Lock()
        """Held while a step is sent, for they are sent in the order of their numbers."""
        self._own_steps = 0
        self._has_ended = threading.Event()
        """Once the recorder has the supervisor's last step."""

    def run(self, *, view: bool = False) -> End:
        """Runs the graph to its end, with the viewer if wanted, and leaves no process behind."""
        for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signum != signal.SIGHUP or signal.getsignal(signum) != signal.SIG_IGN:  # which nohup has asked for
                signal.signal(signum, lambda number, _: self._events.put(End(128 + number, "interrupted")))
        self._connect()
        where = f"run {self.id} on {self._graph.listen or self._run.gateway}"
        self._terminal.show(SUPERVISOR, f"{where} starts {len(self._graph.processes())} processes")
        try:
            self._guardian.start_recorder(view=view)
            if self._hosts is not None:
                self._hosts.open(self.id, self._run.recording)
            with contextlib.suppress(Interrupted):
                self._guardian.start_stages()
            end = self._watch()
        except Refused as refusal:  # a process that cannot be started
            end = End(EXIT_REFUSED, str(refusal))
        finally:
            verdict = self._stop()
        end = self._conclude(end, verdict)
        if self._hosts is not None:
            self._hosts.close(end.code, end.reason)
        return end

    def _watch(self) -> End:
        """Waits for the end, and has looked after the processes meanwhile."""
        while True:
            with contextlib.suppress(queue.Empty):
                end = self._events.get(timeout=TICK_SECONDS)
                self._guardian.name_the_dead()
                return end
            with contextlib.suppress(Interrupted):
                if (end := self._guardian.look()) is not None:
                    return end

    # ------------------------------------------------------------------------------------------ what is heard

    def _connect(self) -> None:
        hear, reading = self._bus.subscribe, self._refusals.reading
        hear("j/*", reading(Journal, self._on_journal))
        hear("l/*", reading(LogLine, self._on_log))
        hear("h/**", reading(Pulse, lambda pulse, packet: self._guardian.pulses.note(pulse, packet.arrived_ns)))
        hear(f"m/*/{FINISHED}", reading(Envelope, self._on_finished))
        note_answer = reading(Envelope, lambda answer, packet: self._calls.note_answer(answer.id, packet.payload))
        for key in self._calls.answer_keys:
            hear(f"m/{key}", note_answer)
        hear("settled/**", self._refusals.naming(self._guardian.settled.add))
        hear("e/**", self._refusals.naming(self._guardian.quiet.add))
        self._serve()
        self._bus.watch(self._on_presence, self._refusals.refuse)

    def _on_journal(self, journal: Journal, packet: Packet) -> None:
        for replica, done in journal.done():
            self._delivery.answered(packet.end, replica, done)
        for step in journal.steps:
            if step.stage in self._graph.nodes:
                self._guardian.note_step(step)
                self._times.note(step)
                self._skipped.note(step)
                self._calls.note_step(step)
            elif step.outcome == "ended":
                self._has_ended.set()

    def _on_log(self, line: LogLine, _: Packet) -> None:
        self._calls.note_log(line)
        if line.stage != SUPERVISOR:
            who = self._run.name_of(Process(line.stage, line.replica))
            self._terminal.show(who, line.text, line.level, progress=line.stage)

    def _on_finished(self, envelope: Envelope, packet: Packet) -> None:
        try:
            finished = codec.open_envelope(Finished, envelope)
        except CodecError as error:
            self._refusals.refuse(packet.key, error)
        else:
            self._events.put(End(finished.code, finished.reason))

    def _on_presence(self, process: Process, present: bool) -> None:
        if present:
            self._delivery.appeared(process)
            if process.incarnation:
                self._bus.publish(f"knows/{process.path}", self._own.path.encode())
        self._guardian.note_presence(process, present)

    # ------------------------------------------------------------------------------------------ what is published

    def _publish(self, port: str, message: Message, say: Callable[[str], object] = lambda _: None) -> str:
        """Sends a message of the supervisor's own and returns its id; ``say`` is told that before anybody else."""
        with self._numbering:
            if self._stopping.is_set():
                raise Refused("the graph ends")
            own = f"{SUPERVISOR}.{port}#{self._numbers[port]}"
            envelope = codec.envelope(message, id=own, lineage=own, time_ns=time.time_ns(), causes=())
            self._numbers[port] += 1
            self._publishing += 1
        say(own)
        try:
            with contextlib.suppress(Stopped):  # nobody does it, but it has been sent, and is left by who should have
                self._delivery.publish(port, envelope, codec.pack(envelope))
        finally:
            self._journal((own,))
            with self._numbering:
                self._publishing -= 1
                self._numbering.notify_all()
        return own

    def _journal(self, emitted: tuple[str, ...], outcome: Outcome = "done") -> None:
        with self._journalling:
            step = Step(*self._own, self._own_steps, "", (), emitted, time.time_ns(), 0, 0, 0, outcome)
            self._own_steps += 1
            self._bus.publish(f"s/{SUPERVISOR}", codec.pack(step))

    def _declare_lost(self, process: Process, reason: str) -> None:
        """Tells everybody that a process is dead, and deals its parts to others."""
        lost = Lost(*process, reason, time.time_ns())
        self._bus.publish(f"x/{process.stage}", codec.pack(lost))
        self._delivery.lost(process)

    # ------------------------------------------------------------------------------------------ the end

    def _stop(self) -> str:
        """Ends all processes and what connects them, and returns the recorder's verdict."""
        with self._numbering:
            self._stopping.set()
            self._numbering.wait_for(lambda: not self._publishing, RECORDED_SECONDS)
        self._guardian.wait_for_recorder()
        self._bus.publish(f"e/{self._own.path}", b"")
        self._guardian.end()
        self._journal((), "ended")
        self._has_ended.wait(RECORDED_SECONDS)
        self._calls.close()  # the last steps of all have been noted
        verdict = self._guardian.end_recorder()
        self._gateway.close()
        self._bus.close()
        self._registration.close()
        remove_sockets(self._run.gateway)
        return verdict

    def _conclude(self, end: End, verdict: str) -> End:
        if times := self._times.lines():
            self._terminal.plain("", *times, *self._skipped.lines(), "")
        self._terminal.plain(f"recording {verdict}")
        return end if self._guardian.complete or end.code else End(EXIT_INCOMPLETE, "the recording is INCOMPLETE")

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
        serve("restart", lambda text: self._guardian.restart(text.decode(), self._stopping.is_set).encode())
        serve("down", self._down)

    def _down(self, _: bytes) -> bytes:
        self._events.put(End(0, "ended by runner down"))
        return b""

    def _call(self, request: CallRequest) -> str:
        if awaited := self._guardian.awaited():
            raise Refused(f"the graph is not ready yet: it waits for {', '.join(awaited)}")
        return self._calls.call(request)

    def _status(self) -> RunStatus:
        return RunStatus(
            endpoint=self._graph.listen or self._run.gateway,
            ready=not self._guardian.awaited(),
            processes=self._guardian.status(),
            topics=topics_of(self._graph),
            published={f"{SUPERVISOR}/{port}": number for port, number in list(self._numbers.items())},
        )

    # ------------------------------------------------------------------------------------------ what is said

    def _say(self, text: str, level: Level) -> None:
        self._terminal.show(SUPERVISOR, text, level)
        self._bus.log(text, level)


def _own_routes(graph: Graph) -> Iterator[Route]:
    """What the supervisor publishes: who replaces the dead must not wait until one of them has room."""
    for route in graph.routes(SUPERVISOR):
        waits = route.output in graph.commands()
        yield route if waits else msgspec.structs.replace(route, queue=sys.maxsize)


def _new_recording(folder: Path, name: str) -> tuple[str, Path]:
    """A run id that is not taken and its recording; its folder is made."""
    base = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    taken = {entry.run for entry in runs()}
    for attempt in itertools.count():
        run = f"{base}-{attempt}" if attempt else base
        if run in taken:
            continue
        try:
            (folder / run).mkdir(parents=True)
            (folder / run / "log").mkdir()
        except FileExistsError:
            continue
        except OSError as error:
            raise Refused(f"{folder / run}: {error.strerror}") from None
        return run, folder / f"{run}.mcap"
    raise AssertionError
