"""Looks after the processes of a run: has them started, watches them, replaces what dies and ends them all."""

import contextlib
import signal
import subprocess
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass

from runner.contract import EXIT_REFUSED, Level, Refused, Restarted
from runner.graph.document import suggest
from runner.graph.graph import SUPERVISOR
from runner.hosts.head import Hosts
from runner.message.codec import Step
from runner.message.packet import RECORDER, Process
from runner.process.children import DEVICE_GRACE_SECONDS, DUMP, behind, end_process, last_lines
from runner.process.fork_server import ForkServer
from runner.process.health import Watch
from runner.supervise.child import Child, Progress
from runner.supervise.launch import Launcher, Run
from runner.supervise.status import ProcessStatus, Pulses
from runner.terminal import Terminal

STAGE_GRACE_SECONDS = 2.0
"""What a stage may take to finish its step before it is killed; a device may take longer."""
SEEN_SECONDS = 0.5
"""How long it may take to hear that a process was ready that has died at once."""
END_GRACE_SECONDS = 10.0
"""What a stage that has finished its step may take until the recorder has what it says."""
UNHEARD_SECONDS = 2.0
"""How long a process on another host may be without a link before it is given up and replaced."""
RECORDER_GRACE_SECONDS = 30.0
"""What the recorder may take to write what waits for the disk."""
TICK_SECONDS = 0.05
"""Between two looks at the processes."""
LOOK_SECONDS = 0.01
"""The same at the end, when somebody waits."""
DUMP_SECONDS = 0.5
"""What a hung process gets to print where it hangs before it is killed."""
UNENDING_SECONDS = 15.0
"""How long after it is killed a process may still be there."""
SETTLE_SECONDS = 30.0
"""How long a successor waits at most for the recorder's word that it has all that the dead process has sent."""
RETIRE_SECONDS = 30.0
"""What a process that is asked to restart may take for its step; then it is killed, unless it is a device."""
ASKED = "asked to restart"
SHOWN_LINES = 16


@dataclass(frozen=True, slots=True)
class End:
    """Why the graph ended."""

    code: int
    reason: str


class Guardian:
    """The processes of one run. It is told what is heard of them, from any thread, and looked after by one thread."""

    def __init__(
        self,
        run: Run,
        hosts: Hosts | None,
        terminal: Terminal,
        forks: ForkServer,
        *,
        say: Callable[[str, Level], None],
        announce: Callable[[Restarted], object],
        declare_lost: Callable[[Process, str], None],
        stopping: Callable[[], bool],
    ):
        """``say`` tells people and the recording, ``announce`` tells the graph that a process is replaced, and
        ``declare_lost`` everybody that it is dead. Once the graph is ``stopping`` no stage is started any more."""
        self._run = run
        self._graph = run.graph
        self._hosts = hosts
        self._terminal = terminal
        self._say = say
        self._announce = announce
        self._declare_lost = declare_lost
        self._launch = Launcher(run, hosts, forks, stopping)
        self._children: dict[tuple[str, int], Child] = {}
        self._recorder: Child | None = None
        self._viewer: Child | None = None
        self._progress = {stage: Progress() for stage in (*run.graph.nodes, SUPERVISOR)}
        self.pulses = Pulses()
        """Signs of life; whoever hears one notes it."""
        self.settled: set[Process] = set()
        """Dead processes of which the recorder says that it has all that they have sent."""
        self.quiet: set[Process] = set()
        """Processes that say that they publish no messages any more."""
        self._ended: set[Process] = set()
        """Those that have journalled their end."""
        self._named: set[Process] = set()
        """Those whose bad end a person has been told."""
        self._started: dict[Process, float] = {}
        """When each was begun to be started, monotonic seconds: it may be there before that has come to its end."""
        self._ready: dict[Process, float] = {}
        """Seconds from its start until it was there, of those that have been."""

    # ------------------------------------------------------------------------------------------ from start to end

    def start_recorder(self, *, view: bool) -> None:
        """Starts the recorder and, once there is a recording, the viewer if wanted; raises Refused where one cannot be
        started."""
        process = Process(RECORDER, 0)
        self._started[process] = time.monotonic()
        with _starting(RECORDER):
            self._recorder = self._launch.recorder(process)
        while view and not self._run.recording.exists():
            if self._recorder.handle.poll() is not None:
                return
            time.sleep(TICK_SECONDS)
        if view:
            with _starting("the viewer"):
                self._viewer = self._launch.viewer()
            self._terminal.show(SUPERVISOR, f"the viewer opens; without a display its address is in {self._viewer.log}")

    def start_stages(self) -> None:
        """Starts every process; raises Refused where one cannot be, Interrupted where the graph ends meanwhile."""
        for stage, replica in self._graph.processes():
            self._children[stage, replica] = self._start(Process(stage, replica))

    def look(self) -> End | None:
        """Kills what hangs and replaces what has died; returns why the graph ends where that is not possible.

        Raises Refused where a successor cannot be started.
        """
        if self._recorder is not None:
            self._check(self._recorder)
            if self._recorder.handle.poll() is not None:
                return End(1, f"the recorder {self._recorder.reason()}")
        for child in list(self._children.values()):
            if child.handle.poll() is None:
                self._check(child)
                if time.monotonic() > child.dies_at + UNENDING_SECONDS:
                    name = self._run.name_of(child.process)
                    return End(1, f"{name} cannot be ended: {child.killed_because}; it waits for a device or a disk")
            elif child.process not in self._ready and time.monotonic() < child.dead_since + SEEN_SECONDS:
                child.dead_since = min(child.dead_since, time.monotonic())  # it may have been ready, and not seen yet
            elif child.replaced_because:
                self._start_successor(child)
            elif (end := self._replace(child)) is not None:
                return end
        return None if self._hosts is None else self._look_after_hosts(self._hosts)

    def name_the_dead(self) -> None:
        """Says what died just before the end, and is not replaced."""
        for child in self._children.values():
            if child.handle.poll() and not child.replaced_because and child.process not in self._named:
                self._named.add(child.process)
                reason = child.reason(self.pulses.newest(child.process))
                self._say(f"{self._run.name_of(child.process)} died meanwhile: {reason}", "warning")
                self._show_output(child)

    def wait_for_recorder(self) -> None:
        """Waits until a recorder that has just been started hears what is said of the others."""
        deadline = time.monotonic() + END_GRACE_SECONDS
        while self._recorder is not None and self._recorder.handle.poll() is None and time.monotonic() < deadline:
            if self.pulses.newest(self._recorder.process) is not None:
                return
            time.sleep(LOOK_SECONDS)

    def end(self) -> None:
        """Ends the stages: each says what it leaves once nobody publishes any more. Says which have to be killed, and
        which fail at that."""
        children = list(self._children.values())
        for child in children:
            child.handle.send_signal(signal.SIGTERM)
        for place in self._graph.processes():
            if place not in self._children:
                self._declare_lost(Process(*place), "the graph ended before it was started")
        began, waiting = time.monotonic(), children
        while waiting := list(filter(self._publishes, waiting)):
            for child in waiting.copy():
                device = self._graph.nodes[child.process.stage].type.cls.device
                grace_seconds = DEVICE_GRACE_SECONDS if device else STAGE_GRACE_SECONDS
                if time.monotonic() > began + grace_seconds:
                    self._kill(child, f"killed: not at its end after {grace_seconds:g} s")
                    waiting.remove(child)
            time.sleep(LOOK_SECONDS)
        for child in children:
            self._report_lost(child)
        deadline = time.monotonic() + END_GRACE_SECONDS
        for child in children:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.handle.wait(max(0.0, deadline - time.monotonic()))
            if child.handle.poll() is None:
                self._kill(child, f"killed: not gone {END_GRACE_SECONDS:g} s after its last step")
            self._report_lost(child)
        self.name_the_dead()

    def _kill(self, child: Child, reason: str) -> None:
        if not child.killed_because:
            child.killed_because = reason
            self._named.add(child.process)
            self._say(f"{self._run.name_of(child.process)} is {reason}", "warning")
        end_process(child.handle, 0)

    def _publishes(self, child: Child) -> bool:
        return child.handle.poll() is None and child.process not in self.quiet

    def end_recorder(self) -> str:
        """Ends the recorder and the viewer, then what the stages have left; returns the recorder's verdict."""
        for child, grace_seconds in ((self._recorder, RECORDER_GRACE_SECONDS), (self._viewer, STAGE_GRACE_SECONDS)):
            if child is not None:
                child.handle.signal_group(signal.SIGTERM)
                end_process(child.handle, grace_seconds)
        if left := self._launch.close():
            self._say(f"the stages {behind(left)}", "warning")
        for child in self._children.values():
            child.handle.signal_group(signal.SIGKILL)  # what has cleared its environment
        return "was not begun" if self._recorder is None else self._recorder.reason()

    def _report_lost(self, child: Child) -> None:
        """Says that a process has ended otherwise than in order; where it has, the recorder has its own word, or lacks
        it, and then the recording is not complete. One that was asked to restart leaves the rest to a successor, which
        does not come any more."""
        code, retires = child.handle.poll(), child.retires_by is not None
        in_order = code == 0 and not child.killed_because and child.process in self._ready
        if code is not None and (retires or not (in_order or child.process in self._ended)) and not child.reported:
            self._lose(child, ASKED if retires and in_order else child.reason(self.pulses.newest(child.process)))

    def _lose(self, child: Child, reason: str) -> None:
        child.reported = True
        self._declare_lost(child.process, reason)

    @property
    def complete(self) -> bool:
        """Whether the recorder has ended, and has written everything."""
        return self._recorder is not None and self._recorder.handle.returncode == 0

    # ------------------------------------------------------------------------------------------ what is heard

    def note_step(self, step: Step) -> None:
        """Takes a step that the recorder has."""
        if step.outcome == "ended":
            self._ended.add(step.process)
        self._progress[step.stage].note(step)

    def note_presence(self, process: Process, present: bool) -> None:
        """Takes note of a process that came or went; says when it is ready, and when all are."""
        if not present:
            child = self._children.get(process.place)
            if self._hosts is not None and child is not None and child.process == process:
                child.unheard_since = time.monotonic()
        elif process in self._started and process not in self._ready:
            awaited = self.awaited()
            self._ready[process] = time.monotonic() - self._started[process]
            if process.stage != RECORDER:
                level: Level = "debug" if awaited else "info"  # it is one of many that start, or replaces one
                self._terminal.show(self._run.name_of(process), f"ready after {self._ready[process]:.1f} s", level)
            if awaited and not self.awaited():
                self._terminal.show(SUPERVISOR, f"all {len(self._graph.processes())} processes are ready")

    # ------------------------------------------------------------------------------------------ what is asked

    def awaited(self) -> list[str]:
        """Names of those who must hear what is published and have never been ready, then the recorder; none: ready."""
        if absent := self._absent():
            return sorted(self._run.name_of(Process(*key)) for key in absent)
        return [] if Process(RECORDER, 0) in self._ready else [RECORDER]

    def _absent(self) -> list[tuple[str, int]]:
        """(stage, replica) of which no process has ever been ready."""
        ready = {process.place for process in list(self._ready)}  # which another thread may change
        return [key for key in self._graph.processes() if key not in ready]

    def restart(self, name: str, ended: Callable[[], bool]) -> str:
        """Asks one process to finish and waits for its successor; returns what to tell the user.

        Raises Refused where there is no such process, it would forget what it knows, a device takes too long for its
        step, or the graph has ``ended`` meanwhile.
        """
        found = {self._run.name_of(Process(*key)): key for key in self._graph.processes()}
        if name not in found:
            raise Refused(f"no process {name!r}{suggest(name, found)}")
        old = self._children.get(found[name])
        if old is None or old.process not in self._ready:
            raise Refused(f"{name} is not ready yet")
        if self._run.forgets(old.process.stage):
            raise Refused(f"{name} would forget what it knows: no messages are recorded (--steps-only)")
        deadline, device = time.monotonic() + RETIRE_SECONDS, self._graph.nodes[old.process.stage].type.cls.device
        old.retires_by = float("inf") if device else deadline
        old.handle.send_signal(signal.SIGUSR1)
        while (new := self._children[found[name]]) is old or new.process not in self._ready:
            if ended():
                raise Refused(f"the graph ended before {name} was back")
            if device and old.handle.poll() is None and time.monotonic() > deadline:
                raise Refused(f"{name} is a device, whose step is not cut off; it restarts once that is done")
            time.sleep(TICK_SECONDS)
        return f"{name} is back: process {new.handle.pid}, ready after {self._ready[new.process]:.1f} s"

    def status(self) -> tuple[ProcessStatus, ...]:
        """How every process is, the recorder first."""
        return tuple(map(self._status_of, filter(None, (self._recorder, *self._children.values()))))

    def _status_of(self, child: Child) -> ProcessStatus:
        process, pulse = child.process, self.pulses.newest(child.process)
        if child.handle.poll() is not None:
            state = "ended"
        elif pulse is None or process not in self._ready:
            state = "starting"
        else:
            state = "silent" if child.watch.slow else pulse.state
        return ProcessStatus(
            stage=process.stage,
            name=self._run.name_of(process),
            state=state,
            pid=child.handle.pid,
            restarts=process.incarnation,
            reason=child.restarted_because,
            pulse=pulse,
            **self.pulses.rates(process),
        )

    # ------------------------------------------------------------------------------------------ care

    def _start(self, process: Process) -> Child:
        self._started[process] = time.monotonic()
        with _starting(self._run.name_of(process)):
            return self._launch.stage(process, self._progress[process.stage])

    def _look_after_hosts(self, hosts: Hosts) -> End | None:
        """Says who is waited for; ends the graph where one that is needed stays away."""
        for child in self._children.values():
            if hosts.waits(child.process):
                self._started[child.process] = time.monotonic()
                child.watch = Watch(self._graph.nodes[child.process.stage].limits)
        hosts.remind()
        reason = hosts.overdue(self._graph.hosts_of_stages())
        return None if reason is None else End(1, reason)

    def _check(self, child: Child) -> None:
        """Kills a process that hangs or has grown too large, after it has said where it is."""
        now, name, pulse = time.monotonic(), self._run.name_of(child.process), self.pulses.newest(child.process)
        waits = child is self._recorder and pulse is not None  # for all others, and is ready after them
        change = child.watch.look(now, pulse, ready=child.process in self._ready or waits)
        if change:
            self._say(f"{name} {change}", "warning")
        if not child.killed_because and (fault := child.watch.fault()):
            child.killed_because, child.dies_at = fault, now + DUMP_SECONDS
            self._say(f"{name} is killed: {fault}", "warning")
            child.handle.send_signal(DUMP)
        if not child.killed_because and now > child.unheard_since + UNHEARD_SECONDS:
            child.killed_because, child.dies_at = "cut off: the run does not hear it any more", now
        if now > min(child.dies_at, child.retires_by or child.dies_at):
            child.handle.send_signal(signal.SIGKILL)

    def _replace(self, child: Child) -> End | None:
        """Has a dead process replaced within its budget; otherwise says why the graph ends."""
        process, name = child.process, self._run.name_of(child.process)
        reason = child.reason(self.pulses.newest(process))
        if child.handle.returncode == EXIT_REFUSED:
            self._named.add(process)
            return End(EXIT_REFUSED, f"{name}: {reason}")
        retires = child.retires_by is not None and (child.handle.returncode == 0 or time.monotonic() > child.retires_by)
        if retires and not child.killed_because:
            self._say(f"{name} was {ASKED}", "info")
            self._give_up(child, ASKED)
            return None
        absent = process.place in self._absent()
        budget = 0 if self._run.forgets(process.stage) else self._graph.nodes[process.stage].restarts
        if absent or child.crashes >= budget:
            self._named.add(process)
            self._show_output(child)
            return End(1, f"{name} failed {'at start-up' if absent else f'after {budget} restarts'}: {reason}")
        self._say(f"{name} restarts ({child.crashes + 1} of {budget}): {reason}", "warning")
        self._show_output(child)
        child.crashes += 1
        self._give_up(child, reason)
        return None

    def _give_up(self, child: Child, reason: str) -> None:
        """Tells everybody that a process is dead and will be replaced."""
        child.replaced_because, child.dies_at = reason, time.monotonic()
        self._lose(child, reason)
        self._announce(Restarted(stage=child.process.stage, replica=child.process.replica, reason=reason))
        if left := self._launch.descendants.end(child.process.path):
            self._say(f"{self._run.name_of(child.process)} {behind(left)}", "warning")

    def _start_successor(self, child: Child) -> None:
        """Puts a new process in the place of one that has gone, once the recorder has all that it has sent."""
        process = child.process
        if process not in self.settled and time.monotonic() < child.dies_at + SETTLE_SECONDS:
            return
        successor = self._start(process._replace(incarnation=process.incarnation + 1))
        successor.restarted_because, successor.crashes = child.replaced_because, child.crashes
        self._children[process.place] = successor

    def _show_output(self, child: Child) -> None:
        for line in last_lines(child.log, SHOWN_LINES, child.log_from):
            self._terminal.show(self._run.name_of(child.process), f"| {line}", "error")


@contextlib.contextmanager
def _starting(name: str) -> Generator[None]:
    """Raises Refused where a process cannot be made, or its log: the folder has gone, or its disk is full."""
    try:
        yield
    except OSError as error:
        raise Refused(f"{name} cannot be started: {error}") from None
