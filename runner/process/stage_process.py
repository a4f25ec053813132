"""The process of one stage: takes messages in, runs steps, sends what they emit and journals them."""

import contextlib
import gc
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any, NoReturn

import msgspec

from runner.contract import EXIT_REFUSED, Refused
from runner.graph.graph import Route
from runner.graph.placement import Network
from runner.graph.ports import Handler
from runner.graph.reading import node_from_entry
from runner.message import codec
from runner.message.codec import CaughtUp, Deal, Draft, Journal, Lost, Outcome, Step
from runner.message.ids import MessageId
from runner.message.packet import GATEWAY, RECORDER, Packet, Process
from runner.message.refusals import Refusals
from runner.process.children import die_with_parent, last_words, prefer_for_oom_kill, print_where_it_crashes
from runner.process.delivery import Delivery, Stopped
from runner.process.forks import EXIT_FAILED, end_with
from runner.process.health import Heartbeat
from runner.process.inbox import Ready
from runner.process.intake import Consumed, Intake
from runner.process.past import bring_back, past_of
from runner.process.step import Executor, step_time
from runner.recording.recording import Recording
from runner.transport.bus import Bus
from runner.transport.presence import Presence
from runner.transport.vital import vital_thread

SWITCH_SECONDS = 0.0005
"""How long one thread may keep the interpreter: a message waits for it on its way to the handler."""
CATCH_UP_SECONDS = 0.005
RECORDED_SECONDS = 1.0
"""How long it may take at the end until the recorder says that it has a step."""

LOOK_SECONDS = 0.25
STANDSTILL_SECONDS = 1.0
"""Between two looks, or the process has stood still."""
CUT_OFF_SECONDS = 10.0
"""How long the supervisor may take to say that a process is dead that has gone: links to a machine that is cut off are
not given up at the same moment."""
FIRST_SECONDS = 2.0
"""The same for who has stood still itself."""


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
    gateway: str = ""
    """Where listeners meet the run; empty on other hosts."""
    network: Network | None = None
    """None on one machine."""
    past: str = ""
    """Recording from which a stateful stage gets back what its earlier processes knew; empty for others."""
    done: int = 0
    """Steps that its earlier processes have done."""
    numbers: dict[str, int] = {}
    """Next sequence number by output port, where an earlier process has emitted some."""
    started: bool = False
    """True where an earlier process has run the start handlers."""
    consumed: tuple[Consumed, ...] = ()
    """What earlier processes have consumed: it may be sent again, and is not worked on."""


class StageProcess:
    """One stage (or replica) between its bus and its handlers."""

    def __init__(self, assignment: Assignment):
        """Constructs the stage; raises Refused where its settings do not hold."""
        self._task = task = assignment
        self._node = node_from_entry(task.stage, task.entry)
        self._stage = self._node.construct()
        if task.past:
            recording = Recording(Path(task.past))
            steps = past_of(recording, task.stage, task.incarnation, done=task.done)
            bring_back(self._node, self._stage, task.seed, recording, steps)
        self._process = Process(task.stage, task.replica, task.incarnation)
        self._bus = Bus(task.run, task.endpoint, gateway=task.gateway, network=task.network, process=self._process)
        self._presence = Presence()
        self._stopping = threading.Event()
        self._retiring = threading.Event()
        self._delivery = Delivery(
            task.stage,
            task.routes,
            self._bus.publish,
            partial(self._bus.log, level="warning"),
            stopping=self._stopping.is_set,
        )
        self._refusals = Refusals(partial(self._bus.log, level="error"))
        self._intake = Intake(self._node, self._refusals, consumed=task.consumed, is_new=task.incarnation == 0)
        self._executor = Executor(
            self._node,
            self._stage,
            seed=task.seed,
            directory=Path(task.directory),
            log=self._bus.log,
            numbers=task.numbers,
        )
        self._steps = 0
        self._recorded = threading.Condition()
        self._recorded_steps = 0
        self._present: _Record | None = None
        """The step that runs."""
        self._busy: list[str] = []
        """Names of the handlers that run, the innermost last."""
        self._sent: dict[str, tuple[int, int]] = dict.fromkeys(self._node.type.outputs, (0, 0))
        self._heartbeat = Heartbeat(self._process, self._bus, self._vitals)

    def run(self) -> None:
        """Serves until it is stopped; raises what a handler raises."""
        self._connect()
        expected = {*self._task.processes, (RECORDER, 0), (GATEWAY, 0)}
        gc.freeze()  # what set-up has made stays: no collection need look at it again
        if self._presence.wait_for(expected, self._stopping.is_set):
            while self._intake.is_behind and not self._stopping.is_set():
                time.sleep(CATCH_UP_SECONDS)
            if not self.is_behind:
                self._start()
                self._serve()

    @property
    def is_behind(self) -> bool:
        """Whether it has not been told yet all that its predecessor has left: it cannot even say that this is left."""
        return self._intake.is_behind

    def stop(self) -> None:
        """Ends :meth:`run` after the present step. May be called from a signal handler."""
        self._stopping.set()
        self._intake.wake()

    def retire(self) -> None:
        """Ends :meth:`run` after the whole present step; a successor does the rest. May be called from a signal
        handler.
        """
        self._retiring.set()
        self._intake.wake()

    def close(self, *, failed: bool = False) -> None:
        """Journals the end, unless the process has ``failed``, and releases the stage and the bus."""
        if not failed:
            self._journal_end()
        with self._recorded:
            self._recorded.wait_for(lambda: self._recorded_steps >= self._steps, RECORDED_SECONDS)
        self._heartbeat.stop()
        try:
            self._stage.close()
        finally:
            self._bus.close()

    # ------------------------------------------------------------------------------------------ inputs

    def _connect(self) -> None:
        """Subscribes to everything first and announces this process last: who sees it may send."""
        own = f"{self._process.stage}/{self._process.replica}"
        for consumer in {self._process.stage, *(route.consumer for route in self._task.routes)}:
            self._bus.subscribe(f"j/{consumer}", self._refusals.reading(Journal, self._on_journal))
        for port, edge in self._node.inputs.items():
            listen = self._bus.overhear if edge.policy == "latest" else self._bus.hand_over
            listen(f"m/{edge.stage}/{edge.port}", partial(self._intake.came, port))
        self._bus.hand_over(f"again/{own}/*", lambda packet: self._intake.came_again(packet.end, packet))
        self._bus.hand_over(f"ready/{self._process.path}", self._refusals.reading(CaughtUp, self._on_caught_up))
        self._bus.hand_over(f"d/{own}/*", self._refusals.reading(Deal, self._intake.deal))
        self._bus.hand_over("e/**", self._refusals.naming(self._presence.ended))
        self._bus.subscribe("x/*", self._refusals.reading(Lost, self._on_lost))
        self._bus.watch(self._on_presence)
        if self._may_be_cut_off:
            vital_thread("cut off", self._end_when_cut_off).start()
        self._heartbeat.start()
        self._bus.announce()

    def _vitals(self) -> dict[str, Any]:
        """What the pulse says beyond what holds for any process. Runs on the pulse's thread and waits for nobody."""
        record = self._present
        return {
            **(record.vitals() if record is not None else {}),
            "steps": self._steps,
            "refused": self._refusals.count,
            "queued": self._intake.waiting,
            "sent": dict(self._sent),
        }

    def _on_presence(self, process: Process, present: bool) -> None:
        own = self._process
        if present and process > own and process.place == own.place:
            _end_at_once(f"cut off meanwhile, and replaced by incarnation {process.incarnation}")
        if not present and process.stage == RECORDER and self._may_be_cut_off and not self._stopping.is_set():
            _end_at_once("cut off from the recorder")  # before it has a step and lacks the one before
        self._presence.update(process, present)
        if present:
            self._delivery.appeared(process)
            if process.incarnation and any(route.consumer == process.stage for route in self._task.routes):
                self._bus.publish(f"knows/{process.path}", own.path.encode())

    @property
    def _may_be_cut_off(self) -> bool:
        """Whether links are given up while both ends live."""
        return self._task.network is not None and self._task.network.credentials is not None

    def _end_when_cut_off(self) -> None:
        """Ends this process where another that it hears or feeds has gone for it alone: what was sent meanwhile is lost
        until one of the two is replaced. Who has stood still goes first, who is not replaced last."""
        others = {edge.stage for edge in self._node.inputs.values()} | {route.consumer for route in self._task.routes}
        looked, stood_still = time.monotonic(), -math.inf
        while not self._stopping.wait(LOOK_SECONDS):
            before, looked = looked, time.monotonic()
            if looked - before > STANDSTILL_SECONDS:
                stood_still = looked
            first = looked - stood_still < CUT_OFF_SECONDS
            patience = 2 * CUT_OFF_SECONDS if not self._node.restarts else FIRST_SECONDS if first else CUT_OFF_SECONDS
            if cut_off := self._presence.cut_off(others, patience):
                _end_at_once(f"cut off from {', '.join(f'{one.stage}.{one.replica}' for one in cut_off)}")

    def _on_caught_up(self, caught_up: CaughtUp, _: Packet) -> None:
        self._delivery.take_over(caught_up.undone)
        if self._node.type.cls.device and self._intake.is_behind:  # what it does again is another thing in the world
            self._executor.number_on(caught_up.numbers)
        self._intake.caught_up()

    def _on_lost(self, lost: Lost, _: Packet) -> None:
        self._presence.ended(lost.process)
        self._delivery.lost(lost.process)

    def _on_journal(self, journal: Journal, packet: Packet) -> None:
        """What a step has done with is acknowledged by it, once the recorder has the step."""
        consumer = packet.end
        for replica, done in journal.done():
            self._delivery.answered(consumer, replica, done)
            if consumer == self._process.stage:
                self._intake.forget(done)
        own = [step for step in journal.steps if step.process == self._process]
        if own:
            with self._recorded:
                self._recorded_steps = own[-1].number + 1
                self._recorded.notify_all()

    # ------------------------------------------------------------------------------------------ steps

    def _start(self) -> None:
        for handler in self._node.type.handlers:
            if not handler.inputs and not self._task.started:
                self._step(Ready(handler, ()))

    def _serve(self) -> None:
        """Works off inputs as they come; a source is advanced in between."""
        source = None if self._node.type.source is None else self._advance(self._node.type.source)
        while not (self._stopping.is_set() or self._retiring.is_set()):
            self._intake.take(wait=source is None)
            ready = self._intake.inbox.pop()
            if ready is not None:
                self._step(ready)
            if source is not None and not next(source, False):
                source = None

    def _step(self, ready: Ready) -> None:
        """Runs one handler to its end and journals it."""
        time_ns = step_time(self._node, ready.arrivals, time.time_ns())
        emissions = self._executor.drafts(ready.handler, ready.arrivals, time_ns)
        outer, record = self._present, _Record(ready, time_ns)
        self._present = record
        self._busy.append(ready.handler.name)
        try:
            with contextlib.closing(emissions):  # a handler that is stopped may fail at that
                while not record.ended:
                    for draft in record.timed(emissions):
                        self._emit(draft)
                        if self._stopping.is_set():
                            raise Stopped
                    if not record.ended:
                        self._let_others_in()
        except Stopped:
            record.outcome = "stopped"
        except Refused as refusal:
            self._refuse_command(record, ready.handler, refusal)
        except BaseException as error:  # also who calls sys.exit() in a handler has failed
            record.outcome = "failed"
            record.error = _summary(error)
            raise
        finally:
            self._busy.pop()
            self._present = outer
            self._journal(record)

    def _let_others_in(self) -> None:
        """Runs the steps of other handlers, before one that has yielded None goes on."""
        self._intake.take(wait=False)
        while not self._stopping.is_set():
            ready = self._intake.inbox.pop(self._busy)
            if ready is None:
                return
            self._step(ready)
        raise Stopped

    def _refuse_command(self, record: "_Record", handler: Handler, refusal: Refused) -> None:
        """What a person called and the stage refuses is done with; any other refusal ends the graph."""
        record.error = f"Refused: {refusal}"
        if not handler.is_command:
            record.outcome = "failed"
            raise refusal
        self._bus.log(str(refusal), "warning")

    def _advance(self, handler: Handler) -> Iterator[bool]:
        """Sends the next message of the source each time it is advanced, if it has one; every message is a step."""
        emissions = self._executor.advance(handler, time.time_ns)
        while True:
            self._present = record = _Record(Ready(handler, ()), time.time_ns())
            for draft in record.timed(emissions):
                record.time_ns = draft.envelope.time_ns
                with contextlib.suppress(Stopped):
                    self._emit(draft)
                break
            self._present = None
            if record.ended:
                return
            if record.emitted:
                self._journal(record)
            yield True

    def _emit(self, draft: Draft) -> None:
        """Sends a message once its consumers have room."""
        envelope, payload = draft.envelope, draft.payload
        port = MessageId.of(envelope.id).port
        messages, size = self._sent[port]
        self._sent[port] = messages + 1, size + len(payload)
        self._delivery.publish(port, envelope, payload)

    def _journal(self, record: "_Record") -> None:
        self._publish_step(record.step(self._process, self._steps, self._intake.take_left()))

    def _publish_step(self, step: Step) -> None:
        self._steps += 1
        self._bus.publish(f"s/{self._process.stage}", codec.pack(step))

    def _journal_end(self) -> None:
        """Says what has come and is left. At the end of the graph that is known once nobody publishes any more."""
        left: Iterable[tuple[str, str]] = ()
        self._bus.publish(f"e/{self._process.path}", b"")
        if not self._retiring.is_set():
            self._presence.wait_for_the_end({edge.stage for edge in self._node.inputs.values()}, self._task.processes)
            self._intake.take(wait=False)
            self._say_what_is_left()
            left = self._intake.left()
        left = (*self._intake.take_left(), *left)
        end = Step(*self._process, self._steps, "", (), (), time.time_ns(), 0, 0, 0, outcome="ended", left=left)
        self._publish_step(end)

    def _say_what_is_left(self) -> None:
        """Records what was never worked on."""
        for handler, lineage, lacking in self._intake.inbox.incomplete():
            self._bus.log(f"{handler.name} of {lineage} still lacks {', '.join(lacking)}", "debug")


class _Record:
    """What will be journalled of a step while it runs."""

    def __init__(self, ready: Ready, time_ns: int):
        self._ready = ready
        self._started_ns = time.monotonic_ns()
        self._computed_ns = 0
        self._begun_ns = 0
        """When the handler went on; 0 while it is held back."""
        self.time_ns = time_ns
        self.ended = False
        """The handler emits no more."""
        self.emitted: list[str] = []
        self.outcome: Outcome = "done"
        self.error = ""

    def vitals(self) -> dict[str, Any]:
        """What the pulse says of it. May be asked from any thread."""
        computed, begun = self._computed_ns, self._begun_ns
        return {
            "state": "working" if begun else "held back",
            "handler": self._ready.handler.name,
            "busy_ns": computed + (time.monotonic_ns() - begun if begun else 0),
        }

    def timed(self, emissions: Iterator[Draft | None]) -> Iterator[Draft]:
        """Passes emissions on up to a None, noting their ids and the time the handler took for them."""
        while True:
            self._begun_ns = time.monotonic_ns()
            try:
                draft = next(emissions)
            except StopIteration:
                self.ended = True
                return
            finally:
                begun, self._begun_ns = self._begun_ns, 0
                self._computed_ns += time.monotonic_ns() - begun
            if draft is None:
                return
            self.emitted.append(draft.envelope.id)
            yield draft

    def step(self, process: Process, number: int, left: tuple[tuple[str, str], ...]) -> Step:
        """The journal's record."""
        arrivals = self._ready.arrivals
        last = max(arrivals, key=lambda arrival: arrival.arrived_ns, default=None)
        return Step(
            *process,
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
            left=left,
        )


def _end_at_once(reason: str) -> NoReturn:
    """Ends this process from any of its threads; another takes its place."""
    last_words(reason)
    os._exit(EXIT_FAILED)


def _summary(error: BaseException) -> str:
    """An exception in one line: its type, its text and where it was raised. Raises nothing, whatever the exception."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    text, place = "", frame.filename
    with contextlib.suppress(Exception):
        text = str(error)
    with contextlib.suppress(OSError):  # the working folder may be gone
        place = os.path.relpath(place)
    return f"{type(error).__name__}: {text} ({place}:{frame.lineno} in {frame.name})"


def prepare(task: bytes) -> None:
    """Imports and computes what the process that this is assigned to shares with others, before it is forked."""
    assignment = msgspec.json.decode(task, type=Assignment)
    _prepare(assignment.stage, msgspec.json.encode(assignment.entry))


@cache
def _prepare(stage: str, entry: bytes) -> None:
    """Once for all replicas."""
    node_from_entry(stage, msgspec.json.decode(entry)).prepare()


def main() -> int:
    """Runs the stage that stdin assigns; its last words say why it ended with an error."""
    print_where_it_crashes()
    die_with_parent()
    prefer_for_oom_kill()
    sys.setswitchinterval(SWITCH_SECONDS)
    for signum in (signal.SIGINT, signal.SIGHUP):
        signal.signal(signum, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))  # there is nothing to finish before the stage is there
    assignment = msgspec.json.decode(sys.stdin.buffer.read(), type=Assignment)
    process, code, reason = None, 0, ""
    try:
        process = StageProcess(assignment)
        signal.signal(signal.SIGTERM, lambda *_: process.stop())
        signal.signal(signal.SIGUSR1, lambda *_: process.retire())
        process.run()
        if process.is_behind:
            code, reason = EXIT_FAILED, "ended before it knew what its predecessor had left"
            last_words(reason)
    except Refused as refusal:
        code, reason = EXIT_REFUSED, str(refusal)
        last_words(reason)
    except BaseException as error:
        code, reason = EXIT_FAILED, _summary(error)
        last_words(reason, traceback.format_exc())
    if process is not None:
        try:
            process.close(failed=code != 0)
        except BaseException as error:
            code = code or EXIT_FAILED
            last_words(reason or _summary(error), traceback.format_exc())
    return code


if __name__ == "__main__":
    end_with(main)
