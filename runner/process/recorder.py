"""The process that records a run: hears everything, has it written, and says what counts from then on."""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from typing import cast

import msgspec

from runner.contract import EXIT_REFUSED, Refused
from runner.graph.graph import SUPERVISOR
from runner.message.codec import CaughtUp, CodecError, Envelope, Journal, LogLine, Lost, Step, pack
from runner.message.packet import RECORDER, Packet, Process
from runner.message.refusals import Refusals
from runner.process.children import die_with_parent, is_orphan, last_words, print_where_it_crashes
from runner.process.forks import end_with
from runner.process.health import Heartbeat
from runner.process.redelivery import Redelivery
from runner.recording.recording import Completeness
from runner.recording.writer import Manifest, RecordingWriter
from runner.transport.bus import Bus
from runner.transport.presence import Presence

TICK_SECONDS = 0.25
"""How often it is seen whether the supervisor is still there."""
ORPHANED = signal.SIGUSR1
"""From the kernel, when the supervisor dies: an end that it asks for comes as SIGTERM."""
HEAR_OUT_SECONDS = 5.0
"""How long the recorder waits at the end for links of stages to close: all that they have sent has come then."""
LAST_RESORT_SECONDS = 30
"""After that the kernel ends a recorder that outlives its supervisor."""
EXIT_INCOMPLETE = 1
REST_SECONDS = 0.01
"""What may come together before the recorder looks again."""
UNSEEN_SECONDS = 0.5
"""How long it may take to see a process that has died at once."""
_Saying = Step | Callable[[], None]
"""A step, or what else is said in its turn."""


class Recorder:
    """The recorder's process: subscribes to all of a run before any stage may speak."""

    def __init__(self, manifest: Manifest) -> None:
        """Creates the recording; raises Refused where that fails."""
        self._ends: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._manifest = manifest
        own = Process(RECORDER, 0)
        self._bus = Bus(
            manifest.run, manifest.endpoint, gateway=manifest.gateway, network=manifest.network, process=own
        )
        self._writer = RecordingWriter(manifest, self._complain)
        self._refusals = Refusals(self._complain)
        self._redelivery = Redelivery(manifest.destinations, self._say)
        self._to_say: deque[_Saying] = deque()
        """Since the last look, for what comes together is said together."""
        self._said: queue.SimpleQueue[list[_Saying] | None] = queue.SimpleQueue()
        self._speaker = threading.Thread(target=self._or_end, args=(self._say_all,), name="speaker", daemon=True)
        self._taker = threading.Thread(target=self._or_end, args=(self._take_all,), name="taker", daemon=True)
        self._ended = threading.Event()
        self._channels: dict[str, Callable[[], Iterator[Packet]]] = {}
        """By what is heard; each is taken before those that come before it on a link, and worked on after them."""
        self._changing = threading.Lock()
        self._presence = Presence()
        self._lagging: dict[Process, set[tuple[str, int]]] = {}
        """Successors that have not been told yet what they have to do, and the publishers that know them."""
        self._gone: set[Process] = set()
        """Their links have closed: all that they have sent has come."""
        self._lost: dict[Process, float] = {}
        """By the supervisor's word: when it is taken that all has come of those that were never seen; 0 once it has."""
        reading = self._refusals.reading
        self._takers: dict[str, Callable[[Packet], None]] = {
            "m": reading(Envelope, self._on_message),
            "s": reading(Step, self._on_step),
            "l": reading(LogLine, lambda line, packet: self._writer.put(line, packet.payload)),
            "x": reading(Lost, self._on_lost),
            "knows": self._on_knows,
        }
        """By the first part of a key."""
        self._heartbeat = Heartbeat(own, self._bus, lambda: {**self._writer.vitals(), "refused": self._refusals.count})

    def run(self) -> Completeness:
        """Records until it is stopped."""
        self._hear("x/*", "knows/**", "l/*", "s/*", f"m/{SUPERVISOR}/*")
        self._bus.watch(self._on_presence, self._refusals.refuse)
        self._speaker.start()
        self._taker.start()
        self._heartbeat.start()
        if self._presence.wait_for(self._manifest.processes, lambda: is_orphan() or not self._ends.empty()):
            # Zenoh sends to subscribers in the order in which they came: whoever works on a message has it first.
            self._hear(*sorted({f"m/{topic.partition('/')[0]}/*" for topic in self._manifest.topics}))
            self._bus.announce()
        if self._wait_for_the_end():
            signal.alarm(LAST_RESORT_SECONDS)
            self._writer.note_problem("the supervisor died")
        self._hear_out()
        self._heartbeat.stop()
        self._ended.set()
        self._taker.join()
        self._said.put(None)
        self._speaker.join(TICK_SECONDS)
        self._bus.close()
        return self._writer.close()

    def _hear(self, *paths: str) -> None:
        self._channels |= {path: self._bus.channel(path) for path in paths if path not in self._channels}

    def stop(self, *, orphaned: bool = False) -> None:
        """Ends :meth:`run` after what has arrived; ``orphaned`` because the supervisor died. May be called from a
        signal handler."""
        self._ends.put(orphaned)

    def _wait_for_the_end(self) -> bool:
        """Returns whether the supervisor has died. A signal may reach another thread: an endless wait would miss it."""
        while not is_orphan():
            with contextlib.suppress(queue.Empty):
                return self._ends.get(timeout=TICK_SECONDS)
        return True

    def _hear_out(self) -> None:
        """The stages have ended, or die with the supervisor; what they have said until then is recorded."""
        deadline = time.monotonic() + HEAR_OUT_SECONDS
        while self._hears_stages and time.monotonic() < deadline:
            time.sleep(TICK_SECONDS / 5)

    @property
    def _hears_stages(self) -> bool:
        return any(one.place in self._manifest.processes for one in self._presence.living)

    def _or_end(self, work: Callable[[], None]) -> None:
        """Does a thread's work; what it raises ends the recording, which says so: the graph would wait for ever."""
        try:
            work()
        except BaseException as error:
            reason = f"the recorder failed: {type(error).__name__}: {error}".removesuffix(": ")
            self._writer.note_problem(reason)
            self.stop()
            last_words(reason, traceback.format_exc())

    # ------------------------------------------------------------------------------------------ what is heard

    def _take_all(self) -> None:
        """Takes what comes, from time to time: being woken for each costs most."""
        while not self._ended.wait(REST_SECONDS):
            self._look()
        self._look()

    def _look(self) -> None:
        """Takes what is there; what a process has sent that was seen to go is among it."""
        with self._changing:
            gone = [process for process in self._lost if self._has_all_of(process)]
        heard = [list(take()) for take in list(self._channels.values())]
        for packet in itertools.chain(*reversed(heard)):
            self._takers[packet.key.partition("/")[0]](packet)
        for process in gone:
            self._settle(process)
        with self._changing:
            ready = [process for process in self._lagging if self._is_known(process)]
        for process in ready:
            self._catch_up(process)
        self._redelivery.offer_latest()
        if said := [self._to_say.popleft() for _ in range(len(self._to_say))]:
            self._said.put(said)

    def _has_all_of(self, process: Process) -> bool:
        """Whether a lost process has just come to where nothing more can come of it."""
        due = self._lost[process]
        unseen = process not in self._presence.living and time.monotonic() > due
        return due > 0 and (process in self._gone or unseen)

    def _is_known(self, process: Process) -> bool:
        """Whether a process is there and all who publish what it consumes send that to it from now on."""
        if process not in self._presence.living:
            return False
        sources = self._redelivery.sources_of(process.stage)
        publishers = {one.place for one in self._presence.living if one.stage in sources}
        publishers |= {(SUPERVISOR, 0)} & {(source, 0) for source in sources}
        return publishers <= self._lagging[process]

    def _catch_up(self, process: Process) -> None:
        with self._changing:
            del self._lagging[process]
        self._redelivery.catch_up(process)
        undone, numbers = tuple(self._redelivery.undone(process.stage)), self._redelivery.numbers(process.stage)
        self._say(f"ready/{process.path}", pack(CaughtUp(undone, numbers)))

    def _on_message(self, envelope: Envelope, packet: Packet) -> None:
        topic = packet.key.partition("/")[2]
        if not self._manifest.steps_only:
            self._writer.put(envelope, packet.payload)
        for consumer, taker, port in self._redelivery.note_message(topic, envelope, packet.payload):
            self._say(f"j/{consumer}", pack(Journal(answered=((taker, port, envelope.id),))))

    def _on_step(self, step: Step, packet: Packet) -> None:
        """Refuses what a process says that is dead: the others know it as lost, and do its work again."""
        if step.stage != packet.end:
            wrong = CodecError("Step", "stage", f"expected {packet.end}, got {step.stage[:60]!r}")
            self._refusals.refuse(packet.key, wrong)
        elif self._lost.get(step.process) != 0:
            self._writer.put(step, packet.payload)
            self._redelivery.note_step(step)
            self._to_say.append(step)

    def _on_lost(self, lost: Lost, packet: Packet) -> None:
        self._writer.put(lost, packet.payload)
        with self._changing:
            self._lost.setdefault(lost.process, time.monotonic() + UNSEEN_SECONDS)

    def _on_knows(self, packet: Packet) -> None:
        """A publisher sends to a successor from now on; what it has sent before is here."""
        try:
            publisher, process = Process.of(packet.payload.decode()), Process.of(packet.key)
        except (Refused, UnicodeDecodeError) as error:
            self._refusals.refuse(packet.key, error)
            return
        with self._changing:
            lagging = process in self._lagging
            self._lagging.setdefault(process, set()).add(publisher.place)
        if not lagging and process in self._presence.living:
            self._catch_up(process)  # once more, for what this one has sent meanwhile

    def _on_presence(self, process: Process, present: bool) -> None:
        with self._changing:
            if present and process.incarnation and process not in self._presence.living:
                self._lagging.setdefault(process, set())
            if not present:
                self._gone.add(process)
        self._presence.update(process, present)

    def _settle(self, process: Process) -> None:
        """All that a dead process has sent is here: once it is on the disk too, another one may take its place."""
        with self._changing:
            self._lost[process] = 0
        self._redelivery.lost(process, self._presence.living)
        self._writer.after_flush(lambda: self._say(f"settled/{process.path}", b""))

    # ------------------------------------------------------------------------------------------ what is said

    def _say(self, key: str, payload: bytes, may_be_dropped: bool = False) -> None:
        self._to_say.append(lambda: self._bus.publish(key, payload, may_be_dropped=may_be_dropped))

    def _say_all(self) -> None:
        """Tells the others what is here, on a thread of its own: a link that blocks must not stop the recording."""
        while (said := self._said.get()) is not None:
            for stage, together in itertools.groupby(said, lambda one: one.stage if isinstance(one, Step) else ""):
                if stage:
                    self._bus.publish(f"j/{stage}", pack(Journal(tuple(cast("Iterator[Step]", together)))))
                else:
                    for say in cast("Iterator[Callable[[], None]]", together):
                        say()

    def _complain(self, text: str) -> None:
        """Shows and records a line."""
        line = self._bus.log(text, "error")
        self._writer.put(line, pack(line))


def main() -> int:
    """Records the run on stdin until SIGTERM; exits 0 when the recording is complete, its last line on stderr says
    what is missing."""
    print_where_it_crashes()
    die_with_parent(ORPHANED)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # whoever works on a message goes first
    for signum in (signal.SIGINT, signal.SIGHUP):
        signal.signal(signum, signal.SIG_IGN)
    manifest = msgspec.json.decode(sys.stdin.buffer.read(), type=Manifest)
    try:
        recorder = Recorder(manifest)
    except Refused as refusal:
        last_words(str(refusal))
        return EXIT_REFUSED
    signal.signal(signal.SIGTERM, lambda *_: recorder.stop())
    signal.signal(ORPHANED, lambda *_: recorder.stop(orphaned=True))
    verdict = recorder.run()
    last_words(f"{manifest.path}: {verdict}")
    return 0 if verdict.complete or manifest.steps_only else EXIT_INCOMPLETE


if __name__ == "__main__":
    end_with(main)
