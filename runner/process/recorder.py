"""The process that records a run: hears everything, has it written, and echoes what counts from then on."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from runner.contract import Refused
from runner.message.codec import CodecError, Envelope, Journal, LogLine, Step, pack, unpack
from runner.message.packet import RECORDER, Packet, Process
from runner.message.refusals import Refusals
from runner.process.children import die_with_parent, explain_death, is_orphan
from runner.process.health import Heart
from runner.process.tap import Tap
from runner.recording.recording import Verdict
from runner.recording.writer import Kind, Manifest, RecordingWriter
from runner.transport.bus import Bus

TICK_SECONDS = 0.25
"""How often it is seen whether the supervisor is still there."""
ORPHANED = signal.SIGUSR1
"""From the kernel, when the supervisor dies: an end that it asks for comes as SIGTERM."""
ORPHANED_SECONDS = 5.0
"""What stages may take to die with their supervisor before a recorder that outlives it stops waiting for them."""
LAST_RESORT_SECONDS = 30
"""After that the kernel ends a recorder that outlives its supervisor."""
EXIT_INCOMPLETE = 1
EXIT_REFUSED = 2
REST_SECONDS = 0.005
"""What may come together before the recorder looks again."""
ECHO_REST_SECONDS = 0.002
"""What may come together before it is echoed."""
_Echo = Step | Callable[[], None] | None
"""A step, what else is to be done in its turn, or the end."""


class Recorder:
    """The recorder's process: subscribes to all of a run before any stage may speak."""

    def __init__(self, manifest: Manifest) -> None:
        """Creates the recording; raises Refused where that fails."""
        self._ends: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._manifest = manifest
        self._bus = Bus(
            manifest.run,
            connect=manifest.endpoint,
            network=manifest.network,
            secret=manifest.secret,
            process=Process(RECORDER, 0),
        )
        self._writer = RecordingWriter(manifest, self._complain)
        self._tap = Tap(self._bus)
        self._echoes: queue.SimpleQueue[_Echo] = queue.SimpleQueue()
        self._gone: set[Process] = set()
        self._echoer = threading.Thread(target=self._echo_all, name="echo", daemon=True)
        self._refusals = Refusals(self._complain)
        self._door = self._bus.open_door(self._on_delivery, self._refusals.refuse)
        self._reader = threading.Thread(target=self._read_all, name="door", daemon=True)
        self._ended = threading.Event()
        self._present: set[Process] = set()
        """Processes of stages."""
        self._heart = Heart(Process(RECORDER, 0), self._bus, self._vitals)

    def run(self) -> Verdict:
        """Records until it is stopped."""
        self._echoer.start()
        self._reader.start()
        self._bus.subscribe("m/**", self._on_message)
        self._bus.subscribe("s/*", self._on_step)
        self._bus.subscribe("l/*", self._on_log)
        self._bus.watch(self._on_presence, self._refusals.refuse)
        self._bus.answer_flush(self._when_all_is_said)
        self._bus.announce()
        self._heart.start()
        orphaned = self._wait_for_the_end()
        if orphaned:
            self._outlive()
        self._heart.stop()
        self._ended.set()
        self._door.knock()
        self._reader.join()
        self._echoes.put(None)
        self._echoer.join(TICK_SECONDS)
        self._bus.close()
        return self._writer.close()

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

    def _read_all(self) -> None:
        """Takes what processes of this machine send. Between two looks it waits for more: being woken costs most."""
        while not self._ended.is_set():
            self._door.look(wait=True)
            time.sleep(REST_SECONDS)
        self._door.look(wait=False)

    def _on_delivery(self, packet: Packet) -> None:
        (self._on_step if packet.key.startswith("s/") else self._on_message)(packet)

    def _on_message(self, packet: Packet) -> None:
        topic = packet.key.partition("/")[2]
        if not self._manifest.steps_only and self._take(Envelope, packet):
            self._tap.pass_on(packet)
        if packet.genuine and topic in self._manifest.awaited:
            self._echo(f"a/{topic}", bytes(packet.payload))

    def _outlive(self) -> None:
        """The stages die with the supervisor; what they have said until then is recorded."""
        signal.alarm(LAST_RESORT_SECONDS)
        deadline = time.monotonic() + ORPHANED_SECONDS
        while self._present and time.monotonic() < deadline:
            time.sleep(TICK_SECONDS / 5)
        self._writer.note_problem("the supervisor died")

    def _vitals(self) -> dict[str, Any]:
        vitals = self._writer.vitals()
        return {**vitals, "refused": vitals["refused"] + self._refusals.count}

    def _take(self, kind: Kind, packet: Packet) -> bool:
        """Records a packet of the run; what strays in is refused. Whether a record is malformed, the writer sees."""
        if packet.genuine:
            self._writer.put(kind, packet.payload)
        else:
            self._refusals.read(kind, packet)
        return packet.genuine

    def _on_log(self, packet: Packet) -> None:
        self._take(LogLine, packet)

    def _on_step(self, packet: Packet) -> None:
        """Refuses what a process says that was cut off: the others know it as gone, and do its work again."""
        try:
            step = unpack(Step, packet.payload)
        except CodecError:
            self._take(Step, packet)  # and the writer says what is wrong with it
            return
        if step.stage != packet.end:
            wrong = CodecError("Step", "stage", f"expected {packet.end}, got {step.stage[:60]!r}")
            self._refusals.refuse(packet.key, wrong)
        elif Process(step.stage, step.replica, step.incarnation) not in self._gone and self._take(Step, packet):
            self._echoes.put(step)

    def _on_presence(self, process: Process, present: bool) -> None:
        if process.stage != RECORDER:
            (self._present.add if present else self._present.discard)(process)
        if not present:
            self._door.after_all(lambda: self._bury(process))

    def _bury(self, process: Process) -> None:
        """What a process has sent straight to here before it died has been taken by now."""
        self._gone.add(process)
        self._writer.after_flush(lambda: self._echo(f"gone/{process.path}", b""))

    def _when_all_is_said(self, answer: Callable[[], None]) -> None:
        self._door.after_all(lambda: self._echoes.put(answer))

    def _echo(self, key: str, payload: bytes) -> None:
        self._echoes.put(lambda: self._bus.publish(key, payload))

    def _echo_all(self) -> None:
        """Tells the others what is here, on a thread of its own: a link that blocks must not stop the recording."""
        while True:
            first = self._echoes.get()
            time.sleep(ECHO_REST_SECONDS)
            echoes = deque([first, *(self._echoes.get() for _ in range(self._echoes.qsize()))])
            while echoes:
                echo = echoes.popleft()
                if echo is None:
                    return
                if isinstance(echo, Step):
                    journal = Journal((echo, *_steps_after(echo, echoes)))
                    self._bus.publish(f"j/{echo.stage}", pack(journal))
                else:
                    echo()

    def _complain(self, text: str) -> None:
        """Shows a line; it comes back over the bus and is recorded too."""
        self._bus.publish(f"l/{RECORDER}", pack(LogLine(RECORDER, 0, "error", text, time.time_ns())))


def _steps_after(first: Step, echoes: deque[_Echo]) -> Iterator[Step]:
    """Those of the same stage that follow at once: they are echoed together."""
    while echoes and isinstance(step := echoes[0], Step) and step.stage == first.stage:
        echoes.popleft()
        yield step


def main() -> int:
    """Records the run on stdin until SIGTERM; exits 0 when the recording is complete, its last line on stderr says
    what is missing."""
    explain_death()
    die_with_parent(ORPHANED)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # whoever works on a message goes first
    for signum in (signal.SIGINT, signal.SIGHUP):
        signal.signal(signum, signal.SIG_IGN)
    manifest = msgspec.json.decode(sys.stdin.buffer.read(), type=Manifest)
    try:
        recorder = Recorder(manifest)
    except Refused as refusal:
        print(refusal, file=sys.stderr, flush=True)
        return EXIT_REFUSED
    signal.signal(signal.SIGTERM, lambda *_: recorder.stop())
    signal.signal(ORPHANED, lambda *_: recorder.stop(orphaned=True))
    verdict = recorder.run()
    print(f"{manifest.path}: {verdict}", file=sys.stderr, flush=True)
    return 0 if verdict.complete or manifest.steps_only else EXIT_INCOMPLETE


if __name__ == "__main__":
    sys.exit(main())
