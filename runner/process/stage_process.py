"""The process of one stage: takes messages in, runs steps, sends what they emit and journals them."""

import contextlib
import gc
import itertools
import os
import signal
import sys
import threading
import time
import traceback
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from runner.contract import Level, Refused
from runner.graph.graph import Route, node_from_entry
from runner.graph.placement import Network
from runner.graph.ports import Handler
from runner.message import codec
from runner.message.codec import CodecError, Draft, Envelope, Journal, LogLine, Outcome, Receipt, Step
from runner.message.packet import RECORDER, Packet, Process
from runner.message.refusals import Refusals, admit, require_genuine
from runner.process.children import die_with_parent, explain_death, volunteer_for_oom
from runner.process.delivery import Delivery, Stopped
from runner.process.health import Heart
from runner.process.inbox import Inbox, Mailbox, Mismatched, Ready
from runner.process.past import past_of, relive
from runner.process.step import Executor, receive, step_time
from runner.recording.recording import Recording
from runner.transport.bus import Bus, Presence

SWITCH_SECONDS = 0.0005
"""How long one thread may keep the interpreter: a message waits for it on its way to the handler."""
REMEMBERED = 10_000
"""Ids a process remembers per process to recognise what it is sent twice."""
EXIT_FAILED = 1
EXIT_REFUSED = 2


class Assignment(msgspec.Struct, frozen=True):
    """What a process is told by the supervisor."""

    run: str
    endpoint: str
    directory: str
    stage: str
    entry: dict[str, Any]
    """The stage's part of the graph, as :func:`runner.graph.graph.node_entry` writes it."""
    seed: int
    routes: tuple[Route, ...]
    processes: tuple[tuple[str, int], ...]
    """(stage, replica) of every process that must be there before anything is sent."""
    replica: int = 0
    incarnation: int = 0
    network: Network | None = None
    """None on loopback."""
    secret: str = ""
    """Of the run's bus."""
    past: str = ""
    """Recording from which a stateful stage gets back what its earlier processes knew; empty for others."""
    numbers: dict[str, int] = {}
    """Next sequence number by output port, where an earlier process has emitted some."""
    started: bool = False
    """True where an earlier process has run the start handlers."""
    recorded: frozenset[str] = frozenset()
    """Output ports that the recorder is sent."""
    consumed: tuple[tuple[str, str], ...] = ()
    """(port, id) of the newest that earlier processes have consumed: it may be sent again, and is not worked on."""


class Host:
    """One stage (or replica) between its bus and its handlers."""

    def __init__(self, assignment: Assignment):
        """Constructs the stage; raises Refused where its settings do not hold."""
        self._task = assignment
        self._node = node_from_entry(assignment.stage, assignment.entry)
        self._stage = self._node.construct()
        if assignment.past:
            recording = Recording(Path(assignment.past))
            steps = past_of(recording, assignment.stage, assignment.incarnation)
            relive(self._node, self._stage, assignment.seed, recording, steps)
        self._process = Process(assignment.stage, assignment.replica, assignment.incarnation)
        self._bus = Bus(
            assignment.run,
            connect=assignment.endpoint,
            network=assignment.network,
            secret=assignment.secret,
            process=self._process,
        )
        self._presence = Presence()
        self._stopping = threading.Event()
        self._retiring = threading.Event()
        self._delivery = Delivery(assignment.routes, self._bus.deliver, self._warn, self._stopping.is_set)
        self._inbox = Inbox(self._node)
        self._executor = Executor(
            self._node,
            self._stage,
            seed=assignment.seed,
            directory=Path(assignment.directory),
            log=self._log,
            numbers=assignment.numbers,
        )
        self._receipts: deque[Receipt] = deque()
        self._arrived: OrderedDict[tuple[str, str], bool] = OrderedDict()
        """(port, id) of what has arrived, and whether it is consumed."""
        self._remember(one for one in assignment.consumed if not self._node.keeps(one[0]))
        self._refusals = Refusals(lambda text: self._log(text, "error"))
        self._mailbox = Mailbox(self._node)
        self._door = self._bus.open_door(self._mailbox.put, self._refusals.refuse)
        self._steps = 0
        self._present: _Record | None = None
        """The step that runs."""
        self._sent: dict[str, tuple[int, int]] = dict.fromkeys(self._node.type.outputs, (0, 0))
        self._heart = Heart(self._process, self._bus, self._vitals)

    def run(self) -> None:
        """Serves until it is stopped; raises what a handler raises."""
        self._connect()
        expected = {*self._task.processes, (RECORDER, 0)}
        gc.freeze()  # what set-up has made stays: no collection need look at it again
        if self._presence.wait_for(expected, self._stopping.is_set):
            self._start()
            self._serve()

    def stop(self) -> None:
        """Ends :meth:`run` after the present step. May be called from a signal handler."""
        self._stopping.set()
        self._door.knock()

    def retire(self) -> None:
        """Ends :meth:`run` after the whole present step; a successor does the rest. May be called from a signal
        handler.
        """
        self._retiring.set()
        self._door.knock()

    def close(self) -> None:
        """Lets the recorder catch up, then releases the stage and the bus."""
        if self._retiring.is_set():
            self._delivery.drain(self._stopping.is_set)
        else:
            self._say_what_is_left()
        self._delivery.close()
        self._heart.stop()
        self._bus.flush()
        self._stage.close()
        self._bus.close()

    # ------------------------------------------------------------------------------------------ inputs

    def _connect(self) -> None:
        """Subscribes to everything first and announces this process last: who sees it may send."""
        for consumer in {route.consumer for route in self._task.routes}:
            self._bus.subscribe(f"j/{consumer}", self._on_journal)
            self._bus.subscribe(f"r/{consumer}", self._on_receipt)
        self._bus.subscribe(
            f"d/{self._process.stage}/{self._process.replica}/*", self._on_delivery, first=self._hand_over
        )
        self._bus.watch(self._on_presence)
        self._heart.start()
        self._bus.announce()

    def _vitals(self) -> dict[str, Any]:
        """What the pulse says beyond what holds for any process. Runs on the pulse's thread and waits for nobody."""
        record, queued = self._present, self._inbox.waiting
        working = record is not None and record.computing
        return {
            "state": "waiting" if record is None else "working" if working else "held back",
            "handler": "" if record is None else record.handler,
            "busy_ns": 0 if record is None else record.busy_ns,
            "steps": self._steps,
            "refused": self._refusals.count,
            "queued": {port: waiting + self._mailbox.waiting(port) for port, waiting in queued.items()},
            "skipped": self._skipped(),
            "unanswered": self._delivery.unanswered(),
            "sent": dict(self._sent),
        }

    def _on_presence(self, process: Process, present: bool) -> None:
        own = self._process
        if present and process > own and (process.stage, process.replica) == (own.stage, own.replica):
            print(f"cut off meanwhile, and replaced by incarnation {process.incarnation}", file=sys.stderr, flush=True)
            os._exit(EXIT_FAILED)
        self._presence.update(process, present)
        self._delivery.update(process, present)

    def _on_journal(self, packet: Packet) -> None:
        """A step that was done acknowledges what it consumed; one that failed will be tried again."""
        journal = self._refusals.read(Journal, packet)
        for step in journal.steps if journal is not None else ():
            if step.outcome == "done":
                self._delivery.acknowledge(step.stage, step.consumed)

    def _on_receipt(self, packet: Packet) -> None:
        receipt, consumer = self._refusals.read(Receipt, packet), packet.end
        if receipt is not None and receipt.consumed:
            self._delivery.acknowledge(consumer, [(receipt.port, receipt.id)])
        elif receipt is not None:
            self._delivery.receive(consumer, receipt.port, receipt.id)

    def _hand_over(self, packet: Packet) -> None:
        """To the thread that runs steps, before anything else is done about it; then comes :meth:`_on_delivery`."""
        port = packet.end
        with contextlib.suppress(CodecError):  # what is malformed is refused by who takes it
            id = admit(Envelope, packet).id
            self._receipts.append(Receipt(port, id, consumed=self._arrived.get((port, id), False)))
        self._mailbox.put(packet)
        self._door.knock()

    def _on_delivery(self, _: Packet) -> None:
        """Gives receipts at once, however long the present step takes."""
        while self._receipts:
            self._give_receipt(self._receipts.popleft())

    def _give_receipt(self, receipt: Receipt) -> None:
        self._bus.publish(f"r/{self._process.stage}", codec.pack(receipt))

    def _take(self, packet: Packet) -> None:
        """Decodes one message into the inbox, unless it has been here before."""
        name = packet.end
        try:
            envelope = codec.unpack(Envelope, packet.payload)
            if packet.genuine and (name, envelope.id) in self._arrived:
                if packet.near and self._arrived[name, envelope.id]:
                    self._give_receipt(Receipt(name, envelope.id, consumed=True))
                return
            port = self._node.type.inputs.get(name)
            if port is None:
                raise CodecError("key", "", f"no such input; valid: {', '.join(self._node.type.inputs)}")
            travelled = packet.arrived_ns - packet.sent_ns if packet.sent_ns else 0
            arrival = receive(port, envelope, arrived_ns=packet.arrived_ns, travelled_ns=travelled)
            require_genuine(packet)
            self._inbox.add(arrival)
            self._arrived[name, envelope.id] = False
        except (CodecError, Mismatched) as error:
            self._refusals.refuse(packet.key, error)

    # ------------------------------------------------------------------------------------------ steps

    def _start(self) -> None:
        for handler in self._node.type.handlers:
            if not handler.inputs and not self._task.started:
                self._step(Ready(handler, ()))

    def _serve(self) -> None:
        """Works off inputs as they come; a source is advanced in between."""
        source = None if self._node.type.source is None else self._advance(self._node.type.source)
        while not (self._stopping.is_set() or self._retiring.is_set()):
            self._take_all(wait=source is None)
            ready = self._inbox.pop()
            if ready is not None:
                self._step(ready)
            if source is not None and not next(source, False):
                source = None

    def _take_all(self, *, wait: bool) -> None:
        """Takes every packet that is there; waits for one if there is nothing else to do."""
        self._door.look(wait=wait and self._mailbox.empty and not self._inbox.has_ready)
        for packet in self._mailbox.take():
            self._take(packet)

    def _step(self, ready: Ready) -> None:
        """Runs one handler to its end and journals it."""
        time_ns = step_time(self._node, ready.arrivals, time.time_ns())
        emissions = self._executor.drafts(ready.handler, ready.arrivals, time_ns)
        self._present = record = _Record(ready, time_ns)
        try:
            for draft in record.timed(emissions):
                self._emit(draft)
                if self._stopping.is_set():
                    raise Stopped
        except Stopped:
            record.outcome = "stopped"
        except Refused as refusal:
            self._refuse_command(record, ready.handler, refusal)
        except Exception as error:
            record.outcome, record.error = "failed", _summary(error)
            raise
        finally:
            self._present = None
            self._journal(record)

    def _refuse_command(self, record: "_Record", handler: Handler, refusal: Refused) -> None:
        """What a person called and the stage refuses is done with; any other refusal ends the graph."""
        record.error = f"Refused: {refusal}"
        if not handler.is_command:
            record.outcome = "failed"
            raise refusal
        self._log(str(refusal), "warning")

    def _advance(self, handler: Handler) -> Iterator[bool]:
        """Sends the next message of the source each time it is advanced; every message is a step."""
        emissions = self._executor.advance(handler, time.time_ns)
        while True:
            self._present = record = _Record(Ready(handler, ()), time.time_ns())
            for draft in record.timed(itertools.islice(emissions, 1)):
                record.time_ns = draft.cover.time_ns
                with contextlib.suppress(Stopped):
                    self._emit(draft)
            self._present = None
            if not record.emitted:
                return
            self._journal(record)
            yield True

    def _emit(self, draft: Draft) -> None:
        """Sends a message: to those who wait for it, then to the recorder, also where the graph ends meanwhile."""
        envelope, payload = draft.cover, self._bus.load(draft.parts())
        port = envelope.id.partition("#")[0].rpartition(".")[2]
        messages, size = self._sent[port]
        self._sent[port] = messages + 1, size + len(payload)
        try:
            self._delivery.publish(port, envelope, payload)
            os.sched_yield()  # to a consumer that was woken on this processor
        finally:
            if port in self._task.recorded:
                self._bus.deliver((RECORDER, 0), f"m/{self._process.stage}/{port}", payload)

    def _journal(self, record: "_Record") -> None:
        step = record.step(self._process, self._steps)
        self._steps += 1
        if step.outcome == "done":
            self._remember(step.consumed)
        payload = codec.pack(step)
        key = f"s/{self._process.stage}"

        def journal() -> None:
            self._bus.deliver((RECORDER, 0), key, payload)

        self._delivery.after_arrival(step.emitted, journal)

    def _say_what_is_left(self) -> None:
        """Records what was never worked on."""
        for handler, lineage, lacking in self._inbox.incomplete():
            self._log(f"{handler.name} of {lineage} still lacks {', '.join(lacking)}", "debug")
        for port, skipped in self._skipped().items():
            if skipped:
                self._log(f"{port}: {skipped} messages were replaced by newer ones before they were read", "debug")

    def _skipped(self) -> dict[str, int]:
        return {port: skipped + self._mailbox.replaced[port] for port, skipped in self._inbox.skipped.items()}

    def _remember(self, consumed: Iterable[tuple[str, str]]) -> None:
        for key in consumed:
            self._arrived[key] = True
        while len(self._arrived) > REMEMBERED:
            self._arrived.popitem(last=False)

    def _warn(self, text: str) -> None:
        self._log(text, "warning")

    def _log(self, text: str, level: Level) -> None:
        line = LogLine(self._process.stage, self._process.replica, level, text, time.time_ns())
        self._bus.publish(f"l/{self._process.stage}", codec.pack(line))


class _Record:
    """What will be journalled of a step while it runs."""

    def __init__(self, ready: Ready, time_ns: int):
        self._ready = ready
        self._started_ns = time.monotonic_ns()
        self._computed_ns = 0
        self._begun_ns = 0
        """When the handler went on; 0 while it is held back."""
        self.time_ns = time_ns
        self.emitted: list[str] = []
        self.outcome: Outcome = "done"
        self.error = ""

    @property
    def handler(self) -> str:
        """What runs."""
        return self._ready.handler.name

    @property
    def computing(self) -> bool:
        """Whether the handler runs, rather than what it emitted being sent."""
        return self._begun_ns > 0

    @property
    def busy_ns(self) -> int:
        """Time inside the handler so far. May be read from any thread."""
        begun = self._begun_ns
        return self._computed_ns + (time.monotonic_ns() - begun if begun else 0)

    def timed(self, emissions: Iterator[Draft]) -> Iterator[Draft]:
        """Passes emissions on, noting their ids and the time the handler took for them."""
        while True:
            self._begun_ns = time.monotonic_ns()
            try:
                draft = next(emissions, None)
            finally:
                self._computed_ns, self._begun_ns = self.busy_ns, 0
            if draft is None:
                return
            self.emitted.append(draft.cover.id)
            yield draft

    def step(self, process: Process, number: int) -> Step:
        """The journal's record."""
        arrivals = self._ready.arrivals
        last = max(arrivals, key=lambda arrival: arrival.arrived_ns, default=None)
        return Step(
            stage=process.stage,
            replica=process.replica,
            incarnation=process.incarnation,
            number=number,
            handler=self._ready.handler.name,
            consumed=tuple((arrival.port.name, arrival.envelope.id) for arrival in arrivals),
            emitted=tuple(self.emitted),
            time_ns=self.time_ns,
            waited_ns=self._started_ns - last.arrived_ns if last else 0,
            travelled_ns=last.travelled_ns if last else 0,
            computed_ns=self._computed_ns,
            outcome=self.outcome,
            error=self.error,
        )


def _summary(error: Exception) -> str:
    """An exception in one line: its type, its text and where it was raised."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = os.path.relpath(frame.filename)
    return f"{type(error).__name__}: {error} ({place}:{frame.lineno} in {frame.name})"


def prepare(task: bytes) -> None:
    """Imports and computes what the process that this is assigned to shares with others, before it is forked."""
    assignment = msgspec.json.decode(task, type=Assignment)
    node_from_entry(assignment.stage, assignment.entry).prepare()


def main() -> int:
    """Runs the stage that stdin assigns; the last line on stderr says why it ended with an error."""
    explain_death()
    die_with_parent()
    volunteer_for_oom()
    sys.setswitchinterval(SWITCH_SECONDS)
    for signum in (signal.SIGINT, signal.SIGHUP):
        signal.signal(signum, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    assignment = msgspec.json.decode(sys.stdin.buffer.read(), type=Assignment)
    try:
        host = Host(assignment)
    except Refused as refusal:
        return _fail(str(refusal), EXIT_REFUSED)
    except Exception as error:
        traceback.print_exc()
        return _fail(_summary(error), EXIT_FAILED)
    signal.signal(signal.SIGTERM, lambda *_: host.stop())
    signal.signal(signal.SIGUSR1, lambda *_: host.retire())
    return _serve(host)


def _serve(host: Host) -> int:
    code = 0
    try:
        host.run()
    except Refused as refusal:
        code = _fail(str(refusal), EXIT_REFUSED)
    except Exception as error:
        traceback.print_exc()
        code = _fail(_summary(error), EXIT_FAILED)
    host.close()
    return code


def _leave(*_: object) -> None:
    """Before the stage is there, there is nothing to finish."""
    os._exit(0)


def _fail(reason: str, code: int) -> int:
    print(reason, file=sys.stderr, flush=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
